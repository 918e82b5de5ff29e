#include "common/bus/log_summary.h"

#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>
#include <stdexcept>
#include <string>
#include <vector>

#include "common/bus/event_log.h"
#include "tests/common/bus/bus_test_support.h"
#include "tests/lcmtypes/example_messages.h"

namespace bodyschema::test {
namespace {

/// Two SAMPLEs, a MOTION_STATUS and an event of somebody else, 1 s apart.
void write_log(const std::filesystem::path& file) {
  LogAppender log(file);
  const auto bytes = encode(kSample, example_sample());
  log.append_bytes("SAMPLE", bytes, 1'000'000);
  log.append_bytes("SAMPLE", bytes, 2'000'000);
  log.append_bytes("MOTION_STATUS", encode(kMotionStatus, example_motion_status()), 3'000'000);
  log.append_bytes("SOMEBODY_ELSES", std::vector<std::uint8_t>{1, 2, 3}, 4'000'000);
}

TEST(LogSummary, CountsEventsPerChannelAndReadsWhoeversChannels) {
  const TemporaryFolder folder;
  write_log(folder / "log");
  const LogSummary summary = summarize_log(folder / "log");
  EXPECT_EQ(summary.num_events, 4);
  EXPECT_DOUBLE_EQ(summary.duration_s, 3);
  EXPECT_EQ(summary.ending, "");
  ASSERT_EQ(summary.channels.size(), 3U);
  EXPECT_EQ(summary.channels.at("SAMPLE").num_events, 2);
  for (const auto& [name, channel] : summary.channels) {
    EXPECT_EQ(channel.num_unreadable, 0) << name << ": " << channel.problem;
    EXPECT_TRUE(summary.has_readable(name));
  }
  EXPECT_FALSE(summary.has_readable("MARKER_POSES"));
}

TEST(LogSummary, ALogThatIsCutOffAnywhereSaysSoAndCountsWhatIsWhole) {
  const TemporaryFolder folder;
  write_log(folder / "log");
  std::vector<std::int64_t> event_ends;
  {
    LogReader reader(folder / "log");
    while (reader.next()) event_ends.push_back(reader.position());
  }
  const auto size = static_cast<std::int64_t>(std::filesystem::file_size(folder / "log"));
  ASSERT_EQ(event_ends.back(), size);
  for (std::int64_t cut = 0; cut < size; cut += cut < 40 ? 1 : 7) {
    std::filesystem::copy_file(folder / "log", folder / "cut",
                               std::filesystem::copy_options::overwrite_existing);
    std::filesystem::resize_file(folder / "cut", static_cast<std::uintmax_t>(cut));
    std::int64_t whole = 0, last_end = 0;
    for (const std::int64_t end : event_ends) {
      if (end > cut) continue;
      ++whole;
      last_end = end;
    }
    const LogSummary summary = summarize_log(folder / "cut");
    EXPECT_EQ(summary.num_events, whole) << cut;
    const std::string expected =
        last_end == cut ? ""
                        : (folder / "cut").string() + ": is cut off in the event at byte " +
                              std::to_string(last_end) + "; the " + std::to_string(whole) +
                              " events before it are good";
    EXPECT_EQ(summary.ending, expected) << cut;
  }
}

TEST(LogSummary, DamageInTheMiddleIsFoundWhereItIs) {
  const TemporaryFolder folder;
  write_log(folder / "log");
  std::int64_t second = 0;
  {
    LogReader reader(folder / "log");
    reader.next();
    second = reader.position();
  }
  std::fstream file(folder / "log", std::ios::binary | std::ios::in | std::ios::out);
  file.seekp(second);
  file << "xxxx";
  file.close();
  const LogSummary summary = summarize_log(folder / "log");
  EXPECT_EQ(summary.num_events, 1);
  EXPECT_EQ(summary.ending, (folder / "log").string() + ": is damaged: no event begins at byte " +
                                std::to_string(second) + "; the 1 events before it are good");
}

TEST(LogSummary, MessagesOfAnOlderVersionAreCountedAndTheFirstIsExplained) {
  const TemporaryFolder folder;
  {
    LogAppender log(folder / "log");
    std::vector<std::uint8_t> older = encode(kSample, example_sample());
    older[7] ^= 1;  // the fingerprint's last byte
    log.append_bytes("SAMPLE", older, 1);
    log.append_bytes("SAMPLE", older, 2);
    log.append_bytes("MOTION_STATUS", encode(kMotionStatus, example_motion_status()), 3);
  }
  const LogSummary summary = summarize_log(folder / "log");
  const LogSummary::Channel& samples = summary.channels.at("SAMPLE");
  EXPECT_EQ(samples.num_events, 2);
  EXPECT_EQ(samples.num_unreadable, 2);
  EXPECT_NE(samples.problem.find("is not sample_t's"), std::string::npos) << samples.problem;
  EXPECT_FALSE(summary.has_readable("SAMPLE"));
  EXPECT_TRUE(summary.has_readable("MOTION_STATUS"));
}

TEST(LogSummary, WhatIsNoLogIsRefused) {
  const TemporaryFolder folder;
  std::ofstream(folder / "text") << "t,q1,part,x,y,z,qw,qx,qy,qz and so on, more than a header\n";
  EXPECT_THROW(summarize_log(folder / "text"), std::runtime_error);
  EXPECT_THROW(summarize_log(folder / "nothing"), std::runtime_error);
}

}  // namespace
}  // namespace bodyschema::test
