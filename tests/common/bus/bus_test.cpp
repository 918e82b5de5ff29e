#include "common/bus/bus.h"

#include <fcntl.h>
#include <gtest/gtest.h>
#include <signal.h>
#include <sys/time.h>
#include <unistd.h>

#include <chrono>
#include <cstdlib>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include "common/bus/event_log.h"
#include "tests/common/bus/bus_test_support.h"
#include "tests/lcmtypes/example_messages.h"

namespace bodyschema::test {
namespace {

using std::chrono::milliseconds;

motion_status_t status(std::int64_t utime) {
  motion_status_t message = example_motion_status();
  message.utime = utime;
  return message;
}

std::string reason_to_refuse(const std::string& in, const std::string& out) {
  try {
    const Bus bus(in, out);
  } catch (const std::runtime_error& error) {
    return error.what();
  }
  return "";
}

TEST(BusInMemory, DeliversEveryMessageInOrderToEverySubscriber) {
  Bus bus("memq://", "memq://");
  std::vector<std::int64_t> first;
  std::vector<std::int64_t> second;
  bus.subscribe(kMotionStatus, [&](const motion_status_t& m) { first.push_back(m.utime); });
  bus.subscribe(kMotionStatus, [&](const motion_status_t& m) { second.push_back(m.utime); });
  std::vector<std::int64_t> sent;
  for (int n = 0; n < 500; ++n) {
    sent.push_back(n);
    bus.publish(kMotionStatus, status(n));
  }
  ASSERT_TRUE(handle_until(bus, [&] { return second.size() == 500; }));
  EXPECT_EQ(first, sent);
  EXPECT_EQ(second, sent);
  EXPECT_EQ(bus.counters().at("received MOTION_STATUS"), 500);
  EXPECT_EQ(bus.counters().at("published MOTION_STATUS"), 500);
  EXPECT_EQ(bus.last_utime(), 499);
}

TEST(BusInMemory, GivesALatestOnlySubscriberTheNewestAndCountsTheRest) {
  Bus bus("memq://", "memq://");
  std::vector<std::int64_t> all;
  std::vector<std::int64_t> latest;
  bus.subscribe_latest(kMotionStatus, [&](const motion_status_t& m) {
    EXPECT_EQ(all.size(), 100U) << "latest-only handlers come last";
    latest.push_back(m.utime);
  });
  bus.subscribe(kMotionStatus, [&](const motion_status_t& m) { all.push_back(m.utime); });
  for (int n = 0; n < 100; ++n) bus.publish(kMotionStatus, status(n));
  ASSERT_TRUE(handle_until(bus, [&] { return !latest.empty(); }));
  EXPECT_EQ(latest, std::vector<std::int64_t>{99});
  EXPECT_EQ(bus.counters().at("skipped MOTION_STATUS"), 99);
  bus.handle(milliseconds(0));
  EXPECT_EQ(latest.size(), 1U);
}

TEST(BusInMemory, AHandlerMayPublishAndSubscribe) {
  Bus bus("memq://", "memq://");
  bool answered = false;
  bus.subscribe(kSample, [&](const sample_t&) {
    bus.subscribe(kMotionStatus, [&](const motion_status_t&) { answered = true; });
    bus.publish(kMotionStatus, status(1));
  });
  bus.publish(kSample, example_sample());
  EXPECT_TRUE(handle_until(bus, [&] { return answered; }));
}

TEST(BusInMemory, AMessageThatANewHandlersOwnHandlerAddsIsNotLost) {
  Bus bus("memq://", "memq://");
  int num_calls = 0;
  bus.subscribe(kSample, [&](const sample_t&) {
    if (num_calls++ == 0) bus.subscribe(kSample, [&](const sample_t&) { num_calls += 10; });
  });
  bus.publish(kSample, example_sample());
  ASSERT_TRUE(handle_until(bus, [&] { return num_calls > 0; }));
  EXPECT_EQ(num_calls, 11);
}

// Trap (a): LCM aborts at the handle() after one that an exception left.
TEST(BusTraps, AHandlersExceptionLeavesHandleAndTheBusLivesOn) {
  Bus bus("memq://", "memq://");
  std::vector<std::int64_t> handled;
  bus.subscribe(kMotionStatus, [&](const motion_status_t& m) {
    if (m.utime == 1) throw std::domain_error("one");
    handled.push_back(m.utime);
  });
  for (int n = 0; n < 4; ++n) bus.publish(kMotionStatus, status(n));
  int num_thrown = 0;
  ASSERT_TRUE(ask_until(
      [&] {
        try {
          bus.handle(milliseconds(20));
        } catch (const std::domain_error&) {
          ++num_thrown;
        }
      },
      [&] { return handled.size() == 3; }));
  EXPECT_EQ(num_thrown, 1);
  EXPECT_EQ(handled, (std::vector<std::int64_t>{0, 2, 3}));
}

TEST(BusTraps, TheExceptionOfALatestOnlyHandlerIsThrownOnce) {
  Bus bus("memq://", "memq://");
  int num_calls = 0;
  bus.subscribe_latest(kMotionStatus, [&](const motion_status_t&) {
    ++num_calls;
    throw std::domain_error("always");
  });
  bus.publish(kMotionStatus, status(1));
  EXPECT_THROW(handle_until(bus, [&] { return num_calls > 1; }), std::domain_error);
  EXPECT_NO_THROW(bus.handle(milliseconds(0)));
  EXPECT_EQ(num_calls, 1);
}

// Trap (b), the decoder's half of which is in mutation_test.
TEST(BusTraps, MalformedAndSenselessMessagesAreDroppedAndCountedApart) {
  const TemporaryFolder folder;
  const std::filesystem::path file = folder / "bad.lcmlog";
  {
    LogAppender log(file);
    std::vector<std::uint8_t> bytes = encode(kSample, example_sample());
    log.append_bytes("SAMPLE", {}, 1);
    log.append_bytes("SAMPLE", std::span(bytes).first(20), 2);
    bytes.push_back(0);
    log.append_bytes("SAMPLE", bytes, 3);
    log.append_bytes("SAMPLE", encode(kMotionStatus, status(4)), 4);
    sample_t senseless = example_sample();
    senseless.utime = -5;
    bytes.resize(static_cast<std::size_t>(senseless.getEncodedSize()));
    senseless.encode(bytes.data(), 0, static_cast<int>(bytes.size()));
    log.append_bytes("SAMPLE", bytes, 5);
    log.append(kSample, example_sample());
  }
  Bus bus("file://" + file.string() + "?speed=0", "");
  int num_handled = 0;
  bus.subscribe(kSample, [&](const sample_t&) { ++num_handled; });
  while (bus.handle(milliseconds(0))) {
  }
  EXPECT_EQ(num_handled, 1);
  EXPECT_EQ(bus.counters().at("received SAMPLE"), 6);
  EXPECT_EQ(bus.counters().at("malformed SAMPLE"), 4);
  EXPECT_EQ(bus.counters().at("senseless SAMPLE"), 1);
}

// Trap (c): the generated encoder reads beyond an array whose count is too large.
TEST(BusTraps, AMessageWithACountAboveItsArrayIsNotPublished) {
  Bus bus("memq://", "memq://");
  sample_t sample = example_sample();
  sample.num_parts = 1'000;
  EXPECT_THROW(bus.publish(kSample, sample), std::logic_error);
  EXPECT_FALSE(bus.counters().contains("published SAMPLE"));
}

TEST(BusTraps, PublishingASenselessMessageIsABugAndNamesTheField) {
  Bus bus("memq://", "memq://");
  sample_t sample = example_sample();
  sample.parts[1].X_CB.rotation_wxyz[0] = 5;
  try {
    bus.publish(kSample, sample);
    FAIL() << "was published";
  } catch (const std::logic_error& error) {
    EXPECT_NE(
        std::string(error.what()).find("SAMPLE must not be sent: parts[1].X_CB.rotation_wxyz"),
        std::string::npos)
        << error.what();
  }
}

// Trap (d): a signal makes LCM's wait fail with EINTR, and on memq:// its handle() crash.
TEST(BusTraps, ASignalEndsTheWaitAndIsNoError) {
  struct sigaction action {};
  struct sigaction before {};
  static volatile sig_atomic_t num_signals = 0;
  action.sa_handler = [](int) { num_signals = num_signals + 1; };
  ::sigaction(SIGALRM, &action, &before);
  Bus bus("memq://", "memq://");
  int num_handled = 0;
  bus.subscribe(kSample, [&](const sample_t&) { ++num_handled; });
  const itimerval every_ms{{0, 1000}, {0, 1000}};
  ::setitimer(ITIMER_REAL, &every_ms, nullptr);
  for (int n = 0; n < 100; ++n) {
    bus.publish(kSample, example_sample());
    ASSERT_NO_THROW(bus.handle(milliseconds(50)));
    ASSERT_NO_THROW(bus.handle(milliseconds(2)));
  }
  EXPECT_TRUE(handle_until(bus, [&] { return num_handled == 100 && num_signals > 10; }));
  const itimerval never{};
  ::setitimer(ITIMER_REAL, &never, nullptr);
  ::sigaction(SIGALRM, &before, nullptr);
}

// Trap (e): LCM gives out broken subscriptions on a dead URL and aborts later.
TEST(BusTraps, ADeadTcpRelayIsFoundAtConstruction) {
  const std::string reason = reason_to_refuse("tcpq://127.0.0.1:1", "");
  EXPECT_NE(reason.find("TCPService"), std::string::npos) << reason;
}

// Trap (f): publish() is called by workers as well.
TEST(BusTraps, SeveralThreadsMayPublishWhileOneHandles) {
  Bus bus("memq://", "memq://");
  int num_handled = 0;
  bus.subscribe(kSample, [&](const sample_t&) { ++num_handled; });
  std::vector<std::thread> workers;
  for (int t = 0; t < 4; ++t) {
    workers.emplace_back([&] {
      for (int n = 0; n < 250; ++n) {
        bus.publish(kSample, example_sample());
        (void)bus.counters();
      }
    });
  }
  EXPECT_TRUE(handle_until(bus, [&] { return num_handled == 1000; }));
  for (std::thread& worker : workers) worker.join();
  EXPECT_EQ(bus.counters().at("published SAMPLE"), 1000);
}

// Trap (g): lcm::LCM can be copied by accident.
static_assert(!std::is_copy_constructible_v<Bus> && !std::is_copy_assignable_v<Bus>);

// Trap (h).
TEST(BusTraps, DescriptorsDoNotSurviveAnExec) {
  const auto leaks = [] {
    int count = 0;
    for (const auto& entry : std::filesystem::directory_iterator("/proc/self/fd")) {
      const int flags = ::fcntl(std::stoi(entry.path().filename()), F_GETFD);
      if (flags >= 0 && (flags & FD_CLOEXEC) == 0) ++count;
    }
    return count;
  };
  const TemporaryFolder folder;
  const int before = leaks();
  const Bus bus("memq://", "file://" + (folder / "out.lcmlog").string() + "?mode=w");
  EXPECT_EQ(leaks(), before);
}

TEST(BusTraps, AChannelNameIsLiteralNotARegularExpression) {
  Bus bus("memq://", "memq://");
  int num_any = 0;
  int num_dotted = 0;
  int num_alternative = 0;
  bus.subscribe(Channel<sample_t>{".*"}, [&](const sample_t&) { ++num_any; });
  bus.subscribe(Channel<sample_t>{"A.B"}, [&](const sample_t&) { ++num_dotted; });
  bus.subscribe(Channel<sample_t>{"SAM|PLE"}, [&](const sample_t&) { ++num_alternative; });
  bus.publish(Channel<sample_t>{"AxB"}, example_sample());
  bus.publish(kSample, example_sample());
  bus.publish(Channel<sample_t>{"A.B"}, example_sample());
  ASSERT_TRUE(handle_until(bus, [&] { return num_dotted > 0; }));
  EXPECT_EQ(num_dotted, 1);
  EXPECT_EQ(num_any + num_alternative, 0);
}

TEST(BusTraps, OneChannelHasOneType) {
  Bus bus("memq://", "memq://");
  bus.subscribe(kSample, [](const sample_t&) {});
  EXPECT_THROW(bus.subscribe(Channel<motion_status_t>{"SAMPLE"}, [](const motion_status_t&) {}),
               std::logic_error);
}

TEST(BusUrls, ThatCannotWorkAreRefusedWithWhatToType) {
  const TemporaryFolder folder;
  const std::string missing = (folder / "no.lcmlog").string();
  EXPECT_NE(reason_to_refuse("upd://239.255.76.67:7667", "").find("Type one of udpm://"),
            std::string::npos);
  EXPECT_NE(reason_to_refuse("239.255.76.67:7667", "").find("Type one of"), std::string::npos);
  EXPECT_NE(
      reason_to_refuse("udpm://239.255.76.67:7667?tll=0", "").find("unknown option \"tll=0\""),
      std::string::npos);
  EXPECT_NE(reason_to_refuse("udpm://10.0.0.1:7667", "").find("multicast address"),
            std::string::npos);
  EXPECT_NE(reason_to_refuse("udpm://239.255.76.67:76670", "").find("is not a port"),
            std::string::npos);
  EXPECT_NE(reason_to_refuse("file://" + missing, "").find("No such file"), std::string::npos);
  EXPECT_NE(reason_to_refuse("file://", "").find("names no file"), std::string::npos);
  EXPECT_NE(reason_to_refuse("file://" + missing + "?speed=fast", "").find("not a number"),
            std::string::npos);
  EXPECT_NE(reason_to_refuse("file://" + missing + "?mode=w", "").find("belongs to --out"),
            std::string::npos);
  EXPECT_NE(reason_to_refuse("", "file://" + missing).find("?mode=w"), std::string::npos);
  EXPECT_NE(reason_to_refuse("", "file:///no/such/folder/x?mode=w").find("No such file"),
            std::string::npos);
  EXPECT_NE(reason_to_refuse("", "memq://").find("heard by nobody"), std::string::npos);
  write_bytes(folder / "text", {'h', 'e', 'l', 'l', 'o'});
  EXPECT_NE(reason_to_refuse("file://" + (folder / "text").string(), "").find("not an LCM log"),
            std::string::npos);
  EXPECT_NE(reason_to_refuse("file://" + folder.path().string(), "").find("is a folder"),
            std::string::npos);
}

TEST(BusUrls, TheLogThatIsReadIsNotOverwritten) {
  const TemporaryFolder folder;
  const std::string log = (folder / "log").string();
  write_one_event_log(log, kSample, example_sample());
  EXPECT_NE(reason_to_refuse("file://" + log, "file://" + log + "?mode=w"), "");
  EXPECT_EQ(read_log(log, kSample).size(), 1U);
}

TEST(BusUrls, AnEmptyInputHearsNothingAndAnEmptyOutputPublishesNowhere) {
  Bus bus("", "");
  bus.subscribe(kSample, [](const sample_t&) { FAIL(); });
  bus.publish(kSample, example_sample());
  EXPECT_TRUE(bus.handle(milliseconds(1)));
  EXPECT_FALSE(bus.counters().contains("published SAMPLE"));
}

TEST(BusUrls, TheDefaultIsTheEnvironmentsOrStaysOnThisMachine) {
  ::setenv("LCM_DEFAULT_URL", "memq://", 1);
  EXPECT_EQ(default_url(), "memq://");
  ::unsetenv("LCM_DEFAULT_URL");
  EXPECT_EQ(default_url(), "udpm://239.255.76.67:7667?ttl=0");
}

TEST(BusReplay, HandsOutOneEventAHandleAndSkipsNothingForLatestOnly) {
  const TemporaryFolder folder;
  const std::filesystem::path file = folder / "a log.lcmlog";
  {
    LogAppender log(file);
    for (int n = 0; n < 50; ++n) {
      log.append(kMotionStatus, status(n));
      log.append(kSample, example_sample());
    }
  }
  Bus bus("file://" + file.string() + "?speed=0", "");
  EXPECT_TRUE(bus.is_replay());
  std::vector<std::int64_t> latest;
  bus.subscribe_latest(kMotionStatus, [&](const motion_status_t& m) { latest.push_back(m.utime); });
  for (int n = 0; n < 50; ++n) {
    ASSERT_TRUE(bus.handle(milliseconds(0)));
    ASSERT_EQ(bus.last_utime(), n);
    ASSERT_EQ(bus.event_utime(), n);
  }
  EXPECT_FALSE(bus.handle(milliseconds(0)));
  EXPECT_EQ(latest.size(), 50U);
}

TEST(BusReplay, ARelativePathWithSpacesWorks) {
  const TemporaryFolder folder;
  const auto before = std::filesystem::current_path();
  std::filesystem::current_path(folder.path());
  {
    Bus bus("", "file://my run.lcmlog?mode=w");
    EXPECT_TRUE(bus.is_recording());
    bus.publish(kSample, example_sample());
  }
  Bus bus("file://my run.lcmlog?speed=0", "");
  int num_handled = 0;
  bus.subscribe(kSample, [&](const sample_t&) { ++num_handled; });
  while (bus.handle(milliseconds(0))) {
  }
  EXPECT_EQ(num_handled, 1);
  std::filesystem::current_path(before);
}

TEST(BusReplay, AnEmptyLogEndsAtOnce) {
  const TemporaryFolder folder;
  write_bytes(folder / "empty", {});
  Bus bus("file://" + (folder / "empty").string(), "");
  EXPECT_FALSE(bus.handle(milliseconds(0)));
}

TEST(BusReplay, ATruncatedOrDamagedLogIsReplayedAsFarAsItIsGoodAndCounted) {
  const TemporaryFolder folder;
  const std::filesystem::path file = folder / "log";
  {
    LogAppender log(file);
    for (int n = 0; n < 3; ++n) log.append(kMotionStatus, status(n));
  }
  const std::vector<std::uint8_t> good = read_bytes(file);
  for (const bool is_cut : {true, false}) {
    std::vector<std::uint8_t> bad = good;
    if (is_cut) {
      bad.resize(good.size() - 1);
    } else {
      bad[good.size() / 3 * 2] ^= 0xFF;
    }
    write_bytes(file, bad);
    Bus bus("file://" + file.string() + "?speed=0", "");
    int num_handled = 0;
    bus.subscribe(kMotionStatus, [&](const motion_status_t&) { ++num_handled; });
    while (bus.handle(milliseconds(0))) {
    }
    EXPECT_EQ(num_handled, 2);
    EXPECT_EQ(bus.counters().at("truncated log"), 1);
  }
}

TEST(BusReplay, AHandlersExceptionDoesNotBringTheSameEventAgain) {
  const TemporaryFolder folder;
  const std::filesystem::path file = folder / "log";
  {
    LogAppender log(file);
    for (int n = 0; n < 3; ++n) log.append(kMotionStatus, status(n));
  }
  Bus bus("file://" + file.string() + "?speed=0", "");
  std::vector<std::int64_t> seen;
  bus.subscribe(kMotionStatus, [&](const motion_status_t& m) {
    seen.push_back(m.utime);
    if (m.utime == 1) throw std::domain_error("one");
  });
  EXPECT_TRUE(bus.handle(milliseconds(0)));
  EXPECT_THROW(bus.handle(milliseconds(0)), std::domain_error);
  EXPECT_TRUE(bus.handle(milliseconds(0)));
  EXPECT_FALSE(bus.handle(milliseconds(0)));
  EXPECT_EQ(seen, (std::vector<std::int64_t>{0, 1, 2}));
}

TEST(BusReplay, AtSpeedTenALogTakesATenthOfItsTime) {
  const TemporaryFolder folder;
  const std::filesystem::path file = folder / "log";
  {
    LogAppender log(file);
    for (int n = 0; n < 3; ++n) log.append(kMotionStatus, status(1'000'000 * n));
  }
  Bus bus("file://" + file.string() + "?speed=10", "");
  bus.subscribe(kMotionStatus, [](const motion_status_t&) {});
  const auto begin = std::chrono::steady_clock::now();
  while (bus.handle(milliseconds(30))) {
  }
  const std::chrono::duration<double> took = std::chrono::steady_clock::now() - begin;
  EXPECT_GE(took.count(), 0.19);
  EXPECT_LT(took.count(), 2.0);
}

TEST(BusReplay, WritesTheSameBytesAgainWithTheInputsEventTimes) {
  const TemporaryFolder folder;
  const std::filesystem::path file = folder / "in";
  {
    LogAppender log(file);
    for (int n = 0; n < 5; ++n) log.append(kMotionStatus, status(10 * n));
  }
  const auto copy = [&](const std::string& name) {
    Bus bus("file://" + file.string() + "?speed=0",
            "file://" + (folder / name).string() + "?mode=w");
    bus.subscribe(kMotionStatus, [&](const motion_status_t& m) { bus.publish(kMotionStatus, m); });
    while (bus.handle(milliseconds(0))) {
    }
    return read_bytes(folder / name);
  };
  EXPECT_EQ(copy("out"), read_bytes(file));
  EXPECT_EQ(copy("again"), read_bytes(file));
}

TEST(BusRecording, ModeAExtendsALogAndModeWReplacesIt) {
  const TemporaryFolder folder;
  const std::string log = (folder / "log").string();
  for (const auto& [mode, events] :
       std::vector<std::pair<std::string, std::size_t>>{{"w", 1}, {"a", 2}, {"a", 3}, {"w", 1}}) {
    {
      Bus bus("", "file://" + log + "?mode=" + mode);
      bus.publish(kSample, example_sample());
    }
    EXPECT_EQ(read_log(log, kSample).size(), events);
  }
}

TEST(BusRecording, AFullDiskIsAnError) {
  Bus bus("", "file:///dev/full?mode=w");
  EXPECT_THROW(bus.publish(kSample, example_sample()), std::runtime_error);
}

TEST(BusReplay, ProcessInfoDoesNotSetTheTimeOfAReplay) {
  const TemporaryFolder folder;
  const std::filesystem::path file = folder / "log";
  {
    LogAppender log(file);
    log.append(kProcessInfo, example_process_info());
    log.append(kMotionStatus, status(7));
    log.append(kMotionStatus, status(6));
  }
  Bus bus("file://" + file.string() + "?speed=0", "");
  bus.subscribe(kProcessInfo, [](const process_info_t&) {});
  bus.subscribe(kMotionStatus, [](const motion_status_t&) {});
  while (bus.handle(milliseconds(0))) {
  }
  EXPECT_EQ(bus.last_utime(), 7);
}

}  // namespace
}  // namespace bodyschema::test
