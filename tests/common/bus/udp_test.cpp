// The bus over real multicast. Runs in tests/private_bus.sh.

#include <fcntl.h>
#include <gtest/gtest.h>
#include <lcm/lcm.h>
#include <signal.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <map>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "common/bus/bus.h"
#include "common/bus/event_log.h"
#include "tests/common/bus/bus_test_support.h"
#include "tests/lcmtypes/example_messages.h"

namespace bodyschema::test {
namespace {

using std::chrono::milliseconds;

const char* const kUrl = "udpm://239.255.76.67:7667?ttl=0";

motion_status_t status(std::int64_t utime) {
  motion_status_t message = example_motion_status();
  message.utime = utime;
  return message;
}

struct RawLcm {
  RawLcm() : lcm(lcm_create(kUrl), &lcm_destroy) {}
  void publish(const std::string& channel, const std::vector<std::uint8_t>& bytes) {
    ASSERT_EQ(
        lcm_publish(lcm.get(), channel.c_str(), bytes.data(), static_cast<unsigned>(bytes.size())),
        0);
  }
  std::unique_ptr<lcm_t, void (*)(lcm_t*)> lcm;
};

TEST(BusOverUdp, TwoBusesHearEachOther) {
  Bus one(kUrl, kUrl);
  Bus two(kUrl, kUrl);
  std::int64_t heard_by_one = -1;
  std::int64_t heard_by_two = -1;
  one.subscribe(kSample, [&](const sample_t& m) { heard_by_one = m.sample_index; });
  two.subscribe(kMotionStatus, [&](const motion_status_t& m) {
    heard_by_two = m.utime;
    two.publish(kSample, example_sample());
  });
  one.publish(kMotionStatus, status(5));
  ASSERT_TRUE(handle_until(two, [&] { return heard_by_two == 5; }));
  ASSERT_TRUE(handle_until(one, [&] { return heard_by_one == example_sample().sample_index; }));
}

TEST(BusOverUdp, ASchemaOfTwoHundredPartsIsHeardWholeFromTwoSendersAtOnce) {
  Bus one("", kUrl), two("", kUrl), receiver(kUrl, "");
  const RawLcm raw;
  std::map<std::int64_t, int> heard;
  const body_schema_t schema = large_schema(200);
  receiver.subscribe(kBodySchema, [&](const body_schema_t& m) {
    body_schema_t again = m;
    again.schema_version = schema.schema_version;
    EXPECT_EQ(encode(kBodySchema, again), encode(kBodySchema, schema));
    ++heard[m.schema_version];
  });
  // LCM does not split these: every datagram is one message of its own.
  int num_datagrams = 0;
  std::size_t largest = 0;
  const auto count = [&](const lcm_recv_buf_t* buffer) {
    ++num_datagrams;
    largest = std::max<std::size_t>(largest, buffer->data_size);
  };
  using Count = decltype(count);
  lcm_subscribe(
      raw.lcm.get(), "BODY_SCHEMA",
      [](const lcm_recv_buf_t* buffer, const char*, void* user) {
        (*static_cast<Count*>(user))(buffer);
      },
      const_cast<std::remove_const_t<Count>*>(&count));
  constexpr int kRounds = 20;
  for (int round = 0; round < kRounds; ++round) {
    body_schema_t message = schema;
    message.schema_version = 2 * round;
    one.publish(kBodySchema, message);
    ++message.schema_version;
    std::thread other([&] { two.publish(kBodySchema, message); });
    one.publish(kBodySchema, message);
    other.join();
    ASSERT_TRUE(handle_until(receiver, [&] { return heard[2 * round + 1] == 2; }));
  }
  EXPECT_EQ(heard.size(), 2U * kRounds);
  EXPECT_FALSE(receiver.counters().contains("incomplete BODY_SCHEMA"));
  const auto num_pieces =
      static_cast<int>((encode(kBodySchema, schema).size() + kPieceBytes - 1) / kPieceBytes);
  while (lcm_handle_timeout(raw.lcm.get(), 0) > 0) {
  }
  EXPECT_GT(num_datagrams, 2 * num_pieces);
  EXPECT_LE(largest, kLargestDatagram);
}

TEST(BusOverUdp, PiecesAreRecordedByLcmLoggerAndPlayedByLcmLogplayer) {
  const TemporaryFolder folder;
  const std::string file = (folder / "run").string();
  const body_schema_t schema = large_schema(200);
  const std::vector<std::uint8_t> bytes = encode(kBodySchema, schema);
  {
    Bus sender("", kUrl);
    Program logger(
        {"lcm-logger", std::string("--lcm-url=") + kUrl + "&recv_buf_size=4194304", file});
    std::error_code none;
    ASSERT_TRUE(ask_until(
        [&] {
          sender.publish(kBodySchema, schema);
          std::this_thread::sleep_for(milliseconds(20));
        },
        [&] { return std::filesystem::file_size(file, none) > 3 * bytes.size() && !none; }));
    logger.send_signal(SIGTERM);
    EXPECT_EQ(logger.wait(), 0) << logger.err();
  }
  LogReader pieces(file, OnDamage::kThrow, 0, Pieces::kAsRecorded);
  ASSERT_TRUE(pieces.next());
  EXPECT_TRUE(is_piece(pieces.event().data));
  const auto recorded = read_log(file, kBodySchema);
  ASSERT_GE(recorded.size(), 2U);
  for (const body_schema_t& message : recorded) EXPECT_EQ(encode(kBodySchema, message), bytes);

  Bus receiver(kUrl, "");
  std::size_t num_heard = 0;
  receiver.subscribe(kBodySchema, [&](const body_schema_t& message) {
    EXPECT_EQ(encode(kBodySchema, message), bytes);
    ++num_heard;
  });
  Program player({"lcm-logplayer", std::string("--lcm-url=") + kUrl, file});
  EXPECT_TRUE(handle_until(receiver, [&] { return num_heard == recorded.size(); }));
  EXPECT_EQ(player.wait(), 0) << player.err();
}

TEST(BusOverUdp, ABurstOfAThousandMessagesIsNotLost) {
  Bus sender("", kUrl);
  Bus receiver(kUrl, "");
  std::vector<std::int64_t> all;
  std::vector<std::int64_t> latest;
  receiver.subscribe(kMotionStatus, [&](const motion_status_t& m) { all.push_back(m.utime); });
  receiver.subscribe_latest(kMotionStatus,
                            [&](const motion_status_t& m) { latest.push_back(m.utime); });
  // Nobody handles meanwhile: LCM's own queue of 30 would keep the oldest 30.
  for (int n = 0; n < 1000; ++n) sender.publish(kMotionStatus, status(n));
  ASSERT_TRUE(handle_until(receiver, [&] { return !latest.empty() && latest.back() == 999; }));
  EXPECT_EQ(all.size(), 1000U);
  EXPECT_LT(latest.size(), 1000U);
  EXPECT_EQ(receiver.counters().at("skipped MOTION_STATUS"),
            1000 - static_cast<std::int64_t>(latest.size()));
}

TEST(BusOverUdp, ImagesOfAMegabyteArrive) {
  Bus sender("", kUrl);
  Bus receiver(kUrl, "");
  camera_image_t image = example_camera_image();
  image.width = 1280;
  image.height = 960;
  image.data.assign(1280 * 960, 100);
  image.num_bytes = 1280 * 960;
  int num_images = 0;
  receiver.subscribe(kCameraImage, [&](const camera_image_t& m) {
    num_images += m.data.size() == image.data.size() ? 1 : 0;
  });
  // With the kernel's default receive buffer 99 of 100 are lost.
  std::ifstream limit("/proc/sys/net/core/rmem_max");
  long rmem_max = 0;
  limit >> rmem_max;
  if (rmem_max < 2'097'152) {
    GTEST_SKIP() << "needs sysctl net.core.rmem_max=2097152 or more; it is " << rmem_max;
  }
  for (int n = 1; n <= 5; ++n) {
    sender.publish(kCameraImage, image);
    ASSERT_TRUE(handle_until(receiver, [&] { return num_images == n; }));
  }
}

TEST(BusOverUdp, InjectedRubbishIsDroppedCountedAndHarmless) {
  RawLcm raw;
  Bus bus(kUrl, "");
  int num_samples = 0;
  bus.subscribe(kSample, [&](const sample_t&) { ++num_samples; });
  const std::vector<std::uint8_t> good = encode(kSample, example_sample());
  raw.publish("SAMPLE", {});
  raw.publish("SAMPLE", {1, 2, 3});
  raw.publish("SAMPLE", {good.begin(), good.begin() + 40});
  std::vector<std::uint8_t> huge(good.begin(), good.begin() + 8);
  huge.resize(20, 0x7F);
  raw.publish("SAMPLE", huge);
  raw.publish("SAMPLE", encode(kMotionStatus, status(1)));
  sample_t senseless = example_sample();
  senseless.parts[0].covariance[0] = -1;
  std::vector<std::uint8_t> bytes(good.size());
  senseless.encode(bytes.data(), 0, static_cast<int>(bytes.size()));
  raw.publish("SAMPLE", bytes);
  raw.publish("SAMPLE", good);
  ASSERT_TRUE(handle_until(bus, [&] { return num_samples == 1; }));
  EXPECT_EQ(bus.counters().at("received SAMPLE"), 7);
  EXPECT_EQ(bus.counters().at("malformed SAMPLE"), 5);
  EXPECT_EQ(bus.counters().at("senseless SAMPLE"), 1);
}

TEST(BusOverUdp, ASignalDoesNotEndTheBus) {
  struct sigaction action {};
  action.sa_handler = [](int) {};
  ::sigaction(SIGUSR1, &action, nullptr);
  Bus bus(kUrl, kUrl);
  int num_samples = 0;
  bus.subscribe(kSample, [&](const sample_t&) { ++num_samples; });
  const pthread_t self = ::pthread_self();
  std::thread disturber([&] {
    for (int n = 0; n < 200; ++n) {
      ::pthread_kill(self, SIGUSR1);
      std::this_thread::yield();
    }
  });
  for (int n = 0; n < 200; ++n) {
    bus.publish(kSample, example_sample());
    ASSERT_NO_THROW(bus.handle(milliseconds(5)));
  }
  disturber.join();
  EXPECT_TRUE(handle_until(bus, [&] { return num_samples == 200; }));
}

TEST(BusOverUdp, DescriptorsDoNotSurviveAnExec) {
  const auto leaks = [] {
    int count = 0;
    for (const auto& entry : std::filesystem::directory_iterator("/proc/self/fd")) {
      const int flags = ::fcntl(std::stoi(entry.path().filename()), F_GETFD);
      if (flags >= 0 && (flags & FD_CLOEXEC) == 0) ++count;
    }
    return count;
  };
  const int before = leaks();
  Bus bus(kUrl, kUrl);
  bus.subscribe(kSample, [](const sample_t&) {});
  EXPECT_EQ(leaks(), before);
}

TEST(BusOverUdp, AProcessAnswersSaysWhoItIsAndEndsOnSigterm) {
  const TemporaryFolder folder;
  std::ofstream(folder / "relay.yaml") << "a: 1\n";
  Bus bus(kUrl, kUrl);
  std::vector<process_info_t> infos;
  int num_answers = 0;
  bus.subscribe(kProcessInfo, [&](const process_info_t& m) { infos.push_back(m); });
  bus.subscribe(kMotionStatus, [&](const motion_status_t&) { ++num_answers; });
  // It would answer its own MOTION_STATUS for ever; its input is a port of its own, so it publishes
  // to the bus only what it hears as SAMPLE.
  const std::string in = "udpm://239.255.76.67:7668?ttl=0";
  Bus to_relay("", in);
  Program relay({RELAY, "--config", (folder / "relay.yaml").string(), "--in", in, "--out", kUrl});
  ASSERT_TRUE(relay.wait_for_output("ready"));
  ASSERT_TRUE(ask_until(
      [&] {
        to_relay.publish(kSample, example_sample());
        bus.handle(milliseconds(20));
      },
      [&] { return num_answers > 0; }));
  // Repeated at 1 Hz.
  const std::size_t num_infos = infos.size();
  ASSERT_TRUE(handle_until(bus, [&] { return infos.size() > num_infos + 1; }));
  EXPECT_EQ(infos.back().process_name, "relay");
  EXPECT_EQ(infos.back().configuration, "a: 1\n");
  relay.send_signal(SIGTERM);
  EXPECT_EQ(relay.wait(), 0);
  EXPECT_TRUE(handle_until(bus, [&] { return infos.back().phase == process_info_t::PHASE_ENDED; }));
}

TEST(BusOverUdp, AnInterfaceThatIsDownCostsMessagesNotTheProcess) {
  Bus sender("", kUrl);
  Bus receiver(kUrl, "");
  std::int64_t heard = -1;
  receiver.subscribe(kMotionStatus, [&](const motion_status_t& m) { heard = m.utime; });
  ASSERT_EQ(std::system("ip link set lo down"), 0);
  for (std::int64_t utime = 1; utime <= 3; ++utime) {
    EXPECT_NO_THROW(sender.publish(kMotionStatus, status(utime)));
  }
  EXPECT_EQ(sender.counters()["send failed MOTION_STATUS"], 3);
  EXPECT_EQ(sender.counters()["published MOTION_STATUS"], 0);
  ASSERT_EQ(std::system("ip link set lo up && ip route replace 224.0.0.0/4 dev lo"), 0);
  EXPECT_TRUE(ask_until(
      [&] {
        sender.publish(kMotionStatus, status(4));
        receiver.handle(milliseconds(20));
      },
      [&] { return heard == 4; }));
}

}  // namespace
}  // namespace bodyschema::test
