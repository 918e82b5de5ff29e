#include "common/bus/event_log.h"

#include <gtest/gtest.h>
#include <lcm/lcm.h>
#include <signal.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <cstring>
#include <filesystem>
#include <random>
#include <stdexcept>
#include <string>
#include <vector>

#include "tests/common/bus/bus_test_support.h"
#include "tests/lcmtypes/example_messages.h"

namespace bodyschema::test {
namespace {

sample_t sample(std::int64_t index) {
  sample_t message = example_sample();
  message.sample_index = index;
  message.utime = message.rest_end_utime = message.rest_begin_utime + index;
  return message;
}

void write_samples(const std::filesystem::path& file, int count) {
  LogAppender log(file);
  for (int n = 0; n < count; ++n) log.append(kSample, sample(n));
}

std::string reason_to_refuse(const std::filesystem::path& file) {
  try {
    read_log(file, kSample);
  } catch (const std::runtime_error& error) {
    return error.what();
  }
  return "";
}

TEST(EventLog, WhatIsAppendedIsReadBackInOrder) {
  const TemporaryFolder folder;
  write_samples(folder / "log", 3);
  {
    LogAppender log(folder / "log");
    EXPECT_EQ(log.found().events, 3);
    log.append(kMotionStatus, example_motion_status());
    log.append(kSample, sample(3));
  }
  LogReport report;
  const std::vector<sample_t> samples = read_log(folder / "log", kSample, &report);
  ASSERT_EQ(samples.size(), 4U);
  for (int n = 0; n < 4; ++n) EXPECT_EQ(samples[static_cast<std::size_t>(n)].sample_index, n);
  EXPECT_EQ(report.events, 5);
  EXPECT_FALSE(report.truncated_at_byte);
}

TEST(EventLog, EventsCarryTheMessagesTimeAndAscendingNumbersAcrossReopening) {
  const TemporaryFolder folder;
  write_samples(folder / "log", 2);
  { LogAppender(folder / "log").append(kSample, sample(2)); }
  std::int64_t number = 0;
  for_each_event(folder / "log", [&](const LogEvent& event) {
    EXPECT_EQ(event.event_number, number);
    EXPECT_EQ(event.event_utime, sample(number).utime);
    EXPECT_EQ(event.channel, "SAMPLE");
    ++number;
  });
  EXPECT_EQ(number, 3);
}

TEST(EventLog, LcmReadsWhatWeWrite) {
  const TemporaryFolder folder;
  write_samples(folder / "log", 3);
  lcm_eventlog_t* log = lcm_eventlog_create((folder / "log").c_str(), "r");
  ASSERT_NE(log, nullptr);
  for (int n = 0; n < 3; ++n) {
    lcm_eventlog_event_t* event = lcm_eventlog_read_next_event(log);
    ASSERT_NE(event, nullptr);
    EXPECT_EQ(event->eventnum & 0xFFFFFFFF, n);
    EXPECT_NE(event->eventnum >> 32, 0) << "no checksum";
    EXPECT_EQ(event->timestamp, sample(n).utime);
    EXPECT_STREQ(event->channel, "SAMPLE");
    const auto* bytes = static_cast<const std::uint8_t*>(event->data);
    EXPECT_EQ(std::vector<std::uint8_t>(bytes, bytes + event->datalen), encode(kSample, sample(n)));
    lcm_eventlog_free_event(event);
  }
  EXPECT_EQ(lcm_eventlog_read_next_event(log), nullptr);
  lcm_eventlog_destroy(log);
}

TEST(EventLog, WeReadWhatLcmWrites) {
  const TemporaryFolder folder;
  lcm_eventlog_t* log = lcm_eventlog_create((folder / "log").c_str(), "w");
  ASSERT_NE(log, nullptr);
  for (int n = 0; n < 3; ++n) {
    std::vector<std::uint8_t> bytes = encode(kSample, sample(n));
    std::string channel = "SAMPLE";
    lcm_eventlog_event_t event{};
    event.timestamp = 100 + n;
    event.channellen = static_cast<std::int32_t>(channel.size());
    event.channel = channel.data();
    event.datalen = static_cast<std::int32_t>(bytes.size());
    event.data = bytes.data();
    ASSERT_EQ(lcm_eventlog_write_event(log, &event), 0);
  }
  lcm_eventlog_destroy(log);
  EXPECT_EQ(read_log(folder / "log", kSample).size(), 3U);
}

TEST(EventLog, TheChecksumIsCrc32c) {
  const std::string digits = "123456789";
  EXPECT_EQ(crc32c({reinterpret_cast<const std::uint8_t*>(digits.data()), digits.size()}),
            0xE3069283U);  // the check value of the catalogues
  const std::vector<std::uint8_t> event =
      encode_event("SAMPLE", std::vector<std::uint8_t>{1}, 2, 3);
  const std::uint32_t stored =
      static_cast<std::uint32_t>(event[4]) << 24 | event[5] << 16 | event[6] << 8 | event[7];
  EXPECT_EQ(stored, crc32c({event.data() + 8, event.size() - 8}));
}

// A disk or a memory loses one bit. Whichever: the log never gives another sample than was written,
// and reports every missing one.
TEST(EventLog, AFlippedBitIsNeverReadAsASample) {
  const TemporaryFolder folder;
  write_samples(folder / "log", 3);
  const std::vector<std::uint8_t> good = read_bytes(folder / "log");
  const auto originals = read_log(folder / "log", kSample);
  std::size_t num_damaged = 0, num_truncated = 0;
  for (std::size_t bit = 0; bit < 8 * good.size(); bit += 3) {
    std::vector<std::uint8_t> bytes = good;
    bytes[bit / 8] ^= static_cast<std::uint8_t>(1U << bit % 8);
    write_bytes(folder / "log", bytes);
    LogReport report;
    std::vector<sample_t> samples = read_log(folder / "log", kSample, &report, OnDamage::kSkip);
    num_damaged += report.damaged_at_byte.has_value();
    num_truncated += report.truncated_at_byte.has_value();
    ASSERT_TRUE(report.damaged_at_byte || report.truncated_at_byte) << "bit " << bit;
    ASSERT_EQ(samples.size(), 2U) << "bit " << bit;
    for (const sample_t& message : samples) {
      const auto index = static_cast<std::size_t>(message.sample_index);
      ASSERT_EQ(encode(kSample, message), encode(kSample, originals.at(index))) << "bit " << bit;
    }
    if (!report.damaged_at_byte) continue;
    ASSERT_EQ(*report.damaged_at_byte,
              static_cast<std::int64_t>(bit / 8 / (good.size() / 3) * (good.size() / 3)));
    ASSERT_EQ(report.damaged_bytes, static_cast<std::int64_t>(good.size() / 3));
    ASSERT_NE(
        reason_to_refuse(folder / "log").find("byte " + std::to_string(*report.damaged_at_byte)),
        std::string::npos)
        << reason_to_refuse(folder / "log");
    ASSERT_THROW(LogAppender(folder / "log"), std::runtime_error);
  }
  // Only a length of the last event can look like a tail that was torn.
  EXPECT_GT(num_damaged, 2 * good.size());
  EXPECT_LE(num_truncated, 64U);
}

TEST(EventLog, ALogWithoutChecksumsIsReadAndExtended) {
  const TemporaryFolder folder;
  write_samples(folder / "log", 2);
  std::vector<std::uint8_t> bytes = read_bytes(folder / "log");
  for (const std::size_t event : {std::size_t{0}, bytes.size() / 2})
    std::fill_n(bytes.begin() + static_cast<std::ptrdiff_t>(event) + 4, 4, std::uint8_t{0});
  write_bytes(folder / "log", bytes);
  { LogAppender(folder / "log").append(kSample, sample(2)); }
  EXPECT_EQ(read_log(folder / "log", kSample).size(), 3U);
  std::vector<std::uint8_t> extended = read_bytes(folder / "log");
  EXPECT_TRUE(std::equal(bytes.begin(), bytes.end(), extended.begin()));
  extended.back() ^= 1;
  write_bytes(folder / "log", extended);
  EXPECT_NE(reason_to_refuse(folder / "log").find("not what was written"), std::string::npos);
}

TEST(EventLog, ALogOfOneDamagedEventIsALogAllTheSame) {
  const TemporaryFolder folder;
  write_samples(folder / "log", 1);
  std::vector<std::uint8_t> bytes = read_bytes(folder / "log");
  bytes[bytes.size() / 2] ^= 0x10;
  write_bytes(folder / "log", bytes);
  LogReport report;
  EXPECT_TRUE(read_log(folder / "log", kSample, &report, OnDamage::kSkip).empty());
  EXPECT_EQ(report.damaged_bytes, static_cast<std::int64_t>(bytes.size()));
  EXPECT_NE(report.damage.find("event at byte 0"), std::string::npos) << report.damage;
}

TEST(EventLog, ErrorsSayWhatIsWrongAndWhere) {
  const TemporaryFolder folder;
  EXPECT_NE(reason_to_refuse(folder / "none").find("No such file"), std::string::npos);
  EXPECT_NE(reason_to_refuse(folder.path()).find("is a folder"), std::string::npos);
  EXPECT_NE(reason_to_refuse("/dev/zero").find("a device or a pipe"), std::string::npos);
  write_bytes(folder / "text", {'h', 'e', 'l', 'l', 'o', ',', ' ', 'w', 'o', 'r', 'l', 'd'});
  EXPECT_NE(reason_to_refuse(folder / "text").find("is not an LCM log"), std::string::npos);
  write_bytes(folder / "zeros", std::vector<std::uint8_t>(1000, 0));
  EXPECT_NE(reason_to_refuse(folder / "zeros").find("is not an LCM log"), std::string::npos);

  write_samples(folder / "log", 3);
  std::vector<std::uint8_t> bytes = read_bytes(folder / "log");
  const std::size_t second = bytes.size() / 3;
  bytes[second + 1] ^= 0xFF;
  write_bytes(folder / "log", bytes);
  EXPECT_NE(reason_to_refuse(folder / "log").find("byte " + std::to_string(second)),
            std::string::npos)
      << reason_to_refuse(folder / "log");
}

TEST(EventLog, AMessageThatMakesNoSenseIsAnErrorThatNamesTheEvent) {
  const TemporaryFolder folder;
  {
    LogAppender log(folder / "log");
    log.append(kSample, sample(0));
    log.append_bytes("SAMPLE", encode(kMotionStatus, example_motion_status()), 1);
  }
  const std::string reason = reason_to_refuse(folder / "log");
  EXPECT_NE(reason.find("event 1 (SAMPLE): fingerprint"), std::string::npos) << reason;
}

TEST(EventLog, AnEmptyLogHasNoEvents) {
  const TemporaryFolder folder;
  write_bytes(folder / "log", {});
  LogReport report;
  EXPECT_TRUE(read_log(folder / "log", kSample, &report).empty());
  EXPECT_FALSE(report.truncated_at_byte);
}

TEST(EventLog, WhereverATailIsTornTheWholeEventsAreReadAndTheNextOnesToo) {
  const TemporaryFolder folder;
  write_samples(folder / "log", 3);
  const std::vector<std::uint8_t> whole = read_bytes(folder / "log");
  const std::size_t third = whole.size() / 3 * 2;
  for (std::size_t size = third + 1; size < whole.size(); size += 13) {
    write_bytes(folder / "log", {whole.begin(), whole.begin() + static_cast<std::ptrdiff_t>(size)});
    LogReport report;
    EXPECT_EQ(read_log(folder / "log", kSample, &report).size(), 2U);
    ASSERT_EQ(report.truncated_at_byte, static_cast<std::int64_t>(third));
    {
      LogAppender log(folder / "log", LogAppender::Mode::kAppend,
                      LogAppender::Durability::kToKernel);
      EXPECT_EQ(log.found().truncated_at_byte, static_cast<std::int64_t>(third));
      log.append(kSample, sample(2));
    }
    ASSERT_EQ(read_bytes(folder / "log"), whole);
  }
}

TEST(EventLog, ATailOfZerosIsATornTail) {
  const TemporaryFolder folder;
  write_samples(folder / "log", 2);
  std::vector<std::uint8_t> bytes = read_bytes(folder / "log");
  const std::size_t good = bytes.size();
  bytes.resize(good + 5000);
  write_bytes(folder / "log", bytes);
  LogReport report;
  EXPECT_EQ(read_log(folder / "log", kSample, &report).size(), 2U);
  EXPECT_EQ(report.truncated_at_byte, static_cast<std::int64_t>(good));
}

TEST(EventLog, ALogDamagedInTheMiddleIsNotCutOff) {
  const TemporaryFolder folder;
  write_samples(folder / "log", 3);
  std::vector<std::uint8_t> bytes = read_bytes(folder / "log");
  bytes[bytes.size() / 3] ^= 0xFF;
  write_bytes(folder / "log", bytes);
  EXPECT_THROW(LogAppender(folder / "log"), std::runtime_error);
  EXPECT_EQ(read_bytes(folder / "log"), bytes);
}

TEST(EventLog, WhateverIsDamagedInTheMiddleTheOtherEventsCanBeRead) {
  const TemporaryFolder folder;
  write_samples(folder / "log", 4);
  const std::vector<std::uint8_t> good = read_bytes(folder / "log");
  const std::size_t size = good.size() / 4;
  // Every byte of the second event's header, among them its lengths: a length beyond the file would
  // look like a torn tail, and the events after it would be cut off.
  for (std::size_t at = size; at < size + 28 + 6; ++at) {
    std::vector<std::uint8_t> bytes = good;
    bytes[at] ^= 0xFF;
    write_bytes(folder / "log", bytes);
    LogReport report;
    const auto samples = read_log(folder / "log", kSample, &report, OnDamage::kSkip);
    ASSERT_GE(samples.size(), 3U) << "byte " << at - size;
    EXPECT_EQ(samples.front().sample_index, 0);
    EXPECT_EQ(samples[samples.size() - 2].sample_index, 2);
    EXPECT_EQ(samples.back().sample_index, 3);
    EXPECT_FALSE(report.truncated_at_byte);
    if (samples.size() == 3 && at < size + 28) {
      EXPECT_GT(report.damaged_bytes, 0);
      EXPECT_LE(report.damaged_bytes, static_cast<std::int64_t>(size));
      EXPECT_THROW(LogAppender(folder / "log"), std::runtime_error);
      EXPECT_EQ(read_bytes(folder / "log"), bytes);
    }
  }
}

TEST(EventLog, AnEventThatIsNoMessageIsSkippedAndCounted) {
  const TemporaryFolder folder;
  {
    LogAppender log(folder / "log");
    log.append(kSample, sample(0));
    log.append_bytes("SAMPLE", std::vector<std::uint8_t>(50, 7), 1);
    log.append(kSample, sample(1));
  }
  LogReport report;
  EXPECT_EQ(read_log(folder / "log", kSample, &report, OnDamage::kSkip).size(), 2U);
  EXPECT_EQ(report.damaged_bytes, 50);
}

TEST(EventLog, AFileThatIsNoLogIsNoneHoweverMuchIsForgiven) {
  const TemporaryFolder folder;
  write_bytes(folder / "text", {'h', 'e', 'l', 'l', 'o', ',', ' ', 'w', 'o', 'r', 'l', 'd'});
  EXPECT_THROW(read_log(folder / "text", kSample, nullptr, OnDamage::kSkip), std::runtime_error);
}

TEST(EventLog, AFileIsCopiedAsideUnderTheFirstFreeName) {
  const TemporaryFolder folder;
  write_bytes(folder / "log", {1});
  EXPECT_EQ(copy_aside(folder / "log"), folder / "log.bad-1");
  write_bytes(folder / "log", {2});
  EXPECT_EQ(copy_aside(folder / "log"), folder / "log.bad-2");
  EXPECT_EQ(read_bytes(folder / "log.bad-1"), (std::vector<std::uint8_t>{1}));
  EXPECT_EQ(read_bytes(folder / "log.bad-2"), (std::vector<std::uint8_t>{2}));
  EXPECT_THROW(copy_aside(folder / "none"), std::runtime_error);
}

TEST(EventLog, ALogHasOneWriter) {
  const TemporaryFolder folder;
  LogAppender log(folder / "log");
  EXPECT_THROW(LogAppender(folder / "log"), std::runtime_error);
  log.append(kSample, sample(0));
  EXPECT_EQ(read_log(folder / "log", kSample).size(), 1U);
}

TEST(EventLog, DamagedLogsNeverCrashTheReader) {
  const TemporaryFolder folder;
  write_samples(folder / "log", 4);
  const std::vector<std::uint8_t> good = read_bytes(folder / "log");
  std::mt19937_64 rng(7);
  for (int n = 0; n < 2000; ++n) {
    std::vector<std::uint8_t> bytes = good;
    for (int k = 0; k < 3; ++k) bytes[rng() % bytes.size()] = static_cast<std::uint8_t>(rng());
    if (rng() % 3 == 0) bytes.resize(rng() % bytes.size());
    write_bytes(folder / "log", bytes);
    try {
      LogReader reader(folder / "log");
      while (reader.next()) {
      }
      ASSERT_LE(reader.position(), static_cast<std::int64_t>(bytes.size()));
    } catch (const std::runtime_error&) {
    }
  }
}

// Learner and monitor rely on this: the observer's appended samples survive kill -9.
TEST(EventLog, EveryAppendedEventSurvivesAKill) {
  const TemporaryFolder folder;
  for (int round = 0; round < 5; ++round) {
    int said[2];
    ASSERT_EQ(::pipe(said), 0);
    const pid_t child = ::fork();
    if (child == 0) {
      LogAppender log(folder / "log");
      for (std::int64_t n = log.found().events;; ++n) {
        log.append(kSample, sample(n));
        if (::write(said[1], &n, sizeof n) != sizeof n) ::_exit(1);
      }
    }
    ::close(said[1]);
    std::int64_t last = -1;
    for (int n = 0; n < 20; ++n) {
      ASSERT_EQ(::read(said[0], &last, sizeof last), static_cast<ssize_t>(sizeof last));
    }
    ::kill(child, SIGKILL);
    ::waitpid(child, nullptr, 0);
    std::int64_t more = 0;
    while (::read(said[0], &more, sizeof more) == sizeof more) last = more;
    ::close(said[0]);
    const std::vector<sample_t> samples = read_log(folder / "log", kSample);
    ASSERT_GE(static_cast<std::int64_t>(samples.size()), last + 1);
    for (std::size_t n = 0; n < samples.size(); ++n) {
      ASSERT_EQ(samples[n].sample_index, static_cast<std::int64_t>(n));
    }
  }
}

TEST(OneEventLog, EqualMessagesMakeEqualFilesAndNothingElseStaysInTheFolder) {
  const TemporaryFolder folder;
  write_one_event_log(folder / "a", kBodySchema, example_body_schema());
  write_one_event_log(folder / "b", kBodySchema, example_body_schema());
  write_one_event_log(folder / "b", kBodySchema, example_body_schema());
  EXPECT_EQ(read_bytes(folder / "a"), read_bytes(folder / "b"));
  EXPECT_EQ(read_log(folder / "a", kBodySchema).size(), 1U);
  std::size_t num_files = 0;
  for ([[maybe_unused]] const auto& entry : std::filesystem::directory_iterator(folder.path())) {
    ++num_files;
  }
  EXPECT_EQ(num_files, 2U);
}

TEST(OneEventLog, AFileThatCannotBeWrittenIsLeftAsItWas) {
  const TemporaryFolder folder;
  write_one_event_log(folder / "schema", kBodySchema, example_body_schema());
  const std::vector<std::uint8_t> before = read_bytes(folder / "schema");
  body_schema_t senseless = example_body_schema();
  senseless.root_part = 77;
  EXPECT_THROW(write_one_event_log(folder / "schema", kBodySchema, senseless), std::logic_error);
  EXPECT_EQ(read_bytes(folder / "schema"), before);
  EXPECT_THROW(write_file_atomically(folder / "none" / "x", "text"), std::runtime_error);
}

TEST(AtomicFile, OfALinkIsWhatItLeadsToAndNoDevice) {
  const TemporaryFolder folder;
  std::filesystem::create_symlink("middle", folder / "link");
  std::filesystem::create_symlink(folder / "text", folder / "middle");
  for (const char* const text : {"first", "second"}) {
    write_file_atomically(folder / "link", text);
    EXPECT_TRUE(std::filesystem::is_symlink(folder / "link"));
    EXPECT_TRUE(std::filesystem::is_symlink(folder / "middle"));
    EXPECT_EQ(read_bytes(folder / "text").size(), std::strlen(text));
  }
  ASSERT_EQ(::mkfifo((folder / "pipe").c_str(), 0600), 0);
  EXPECT_THROW(write_file_atomically(folder / "pipe", "text"), std::runtime_error);
  EXPECT_TRUE(std::filesystem::is_fifo(folder / "pipe"));
}

TEST(AtomicFile, IsReplacedAsAWholeAndReadableByOthers) {
  const TemporaryFolder folder;
  write_file_atomically(folder / "text", "old");
  write_file_atomically(folder / "text", "new\n");
  EXPECT_EQ(read_bytes(folder / "text"), (std::vector<std::uint8_t>{'n', 'e', 'w', '\n'}));
  struct stat status {};
  ASSERT_EQ(::stat((folder / "text").c_str(), &status), 0);
  const mode_t mask = ::umask(0);
  ::umask(mask);
  EXPECT_EQ(status.st_mode & 0777U, 0666U & ~mask);
}

}  // namespace
}  // namespace bodyschema::test
