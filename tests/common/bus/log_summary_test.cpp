#include "common/bus/log_summary.h"

#include <gtest/gtest.h>

#include <set>
#include <stdexcept>
#include <string>
#include <vector>

#include "common/bus/all_channels.h"
#include "tests/common/bus/bus_test_support.h"
#include "tests/lcmtypes/example_messages.h"

namespace bodyschema::test {
namespace {

void write_every_channel(const std::filesystem::path& file) {
  LogAppender log(file);
  process_info_t info = example_process_info();
  info.program_version = program_version();
  log.append(kProcessInfo, info);
  for_each_channel([&](const auto& channel, const auto& message) {
    if constexpr (!std::is_same_v<decltype(message), const process_info_t&>)
      log.append(channel, message);
  });
}

TEST(LogSummary, AllChannelsAreThoseOfTheContract) {
  std::set<std::string> visited, contract;
  bodyschema::for_each_channel([&](const auto& channel) { visited.insert(channel.name); });
  test::for_each_channel([&](const auto& channel, const auto&) { contract.insert(channel.name); });
  EXPECT_EQ(visited, contract);
}

TEST(LogSummary, AWholeLogIsSound) {
  const TemporaryFolder folder;
  write_every_channel(folder / "log");
  const LogSummary summary = summarize_log(folder / "log");
  EXPECT_TRUE(summary.is_sound()) << flaws_text(summary);
  EXPECT_EQ(flaws_text(summary), "");
  EXPECT_EQ(summary.events, 16);
  EXPECT_EQ(summary.channels.size(), 16U);
  EXPECT_EQ(summary.channels.at("SAMPLE").events, 1);
  EXPECT_EQ(summary.unread_bytes, 0);
  EXPECT_EQ(summary.file_bytes,
            static_cast<std::int64_t>(std::filesystem::file_size(folder / "log")));
  EXPECT_EQ(summary.versions, std::set<std::string>{program_version()});
}

TEST(LogSummary, ALogThatIsCutOffAnywhereSaysWhere) {
  const TemporaryFolder folder;
  write_every_channel(folder / "log");
  const auto bytes = read_bytes(folder / "log");
  std::set<std::size_t> boundaries;
  {
    LogReader reader(folder / "log");
    do boundaries.insert(static_cast<std::size_t>(reader.position()));
    while (reader.next());
  }
  for (std::size_t size = 1; size < bytes.size(); size += 13) {
    write_bytes(folder / "cut", {bytes.begin(), bytes.begin() + static_cast<std::ptrdiff_t>(size)});
    const LogSummary summary = summarize_log(folder / "cut");
    const std::size_t whole = *std::prev(boundaries.upper_bound(size));
    EXPECT_EQ(summary.unread_bytes, static_cast<std::int64_t>(size - whole)) << size;
    if (size == whole) continue;
    EXPECT_FALSE(summary.is_sound());
    EXPECT_NE(flaws_text(summary).find("cut off in the middle of an event at byte " +
                                       std::to_string(whole)),
              std::string::npos)
        << flaws_text(summary);
  }
}

TEST(LogSummary, ADamagedLogSaysWhereAndCountsWhatComesBefore) {
  const TemporaryFolder folder;
  write_every_channel(folder / "log");
  auto bytes = read_bytes(folder / "log");
  LogReader reader(folder / "log");
  reader.next();
  reader.next();
  const auto third = static_cast<std::size_t>(reader.position());
  bytes[third] ^= 0xFF;
  write_bytes(folder / "log", bytes);
  const LogSummary summary = summarize_log(folder / "log");
  EXPECT_EQ(summary.events, 2);
  EXPECT_EQ(summary.unread_bytes, static_cast<std::int64_t>(bytes.size() - third));
  EXPECT_NE(flaws_text(summary).find("no event begins at byte " + std::to_string(third)),
            std::string::npos);
}

// The fingerprint is the first thing in a message; any change of a type changes it.
TEST(LogSummary, MessagesOfAnotherVersionAreCountedAndNamed) {
  const TemporaryFolder folder;
  {
    LogAppender log(folder / "log");
    process_info_t info = example_process_info();
    info.program_version = "0.0.7";
    log.append(kProcessInfo, info);
    auto bytes = encode(kSample, example_sample());
    log.append_bytes(kSample.name, bytes, 1);
    bytes[3] ^= 1;
    log.append_bytes(kSample.name, bytes, 2);
    log.append_bytes(kSample.name, bytes, 3);
  }
  const LogSummary summary = summarize_log(folder / "log");
  EXPECT_EQ(summary.channels.at("SAMPLE").events, 3);
  EXPECT_EQ(summary.channels.at("SAMPLE").unreadable, 2);
  EXPECT_FALSE(summary.is_sound());
  const std::string flaws = flaws_text(summary);
  EXPECT_NE(flaws.find("SAMPLE: 2 of 3 messages cannot be read: fingerprint"), std::string::npos)
      << flaws;
  EXPECT_NE(flaws.find("recorded with version 0.0.7, this is " + program_version()),
            std::string::npos)
      << flaws;
}

TEST(LogSummary, SenselessMessagesAreCounted) {
  const TemporaryFolder folder;
  sample_t sample = example_sample();
  sample.action[0] = std::numeric_limits<double>::quiet_NaN();
  std::vector<std::uint8_t> bytes(static_cast<std::size_t>(sample.getEncodedSize()));
  sample.encode(bytes.data(), 0, static_cast<int>(bytes.size()));
  LogAppender(folder / "log").append_bytes(kSample.name, bytes, 1);
  EXPECT_EQ(summarize_log(folder / "log").unreadable(), 1);
}

TEST(LogSummary, ChannelsOfOthersAreNoFlaw) {
  const TemporaryFolder folder;
  write_every_channel(folder / "log");
  LogAppender(folder / "log").append_bytes("OTHER\xFF", std::vector<std::uint8_t>{1, 2, 3}, 1);
  const LogSummary summary = summarize_log(folder / "log");
  EXPECT_TRUE(summary.is_sound());
  ASSERT_TRUE(summary.channels.contains("OTHER?"));
  EXPECT_FALSE(summary.channels.at("OTHER?").is_known);
}

TEST(LogSummary, AnEmptyLogIsNotSoundAndWhatIsNoLogAnError) {
  const TemporaryFolder folder;
  write_bytes(folder / "empty", {});
  EXPECT_FALSE(summarize_log(folder / "empty").is_sound());
  EXPECT_EQ(flaws_text(summarize_log(folder / "empty")), "holds no event\n");
  write_bytes(folder / "text", {'h', 'e', 'l', 'l', 'o'});
  EXPECT_THROW(summarize_log(folder / "text"), std::runtime_error);
  EXPECT_THROW(summarize_log(folder / "none"), std::runtime_error);
}

TEST(LogReader, ReadsOnWhereAnotherOneStopped) {
  const TemporaryFolder folder;
  write_every_channel(folder / "log");
  LogReader first(folder / "log");
  for (int i = 0; i < 4; ++i) ASSERT_TRUE(first.next());
  LogReader second(folder / "log", OnDamage::kThrow, first.position());
  EXPECT_EQ(second.position(), first.position());
  for (int i = 4; i < 16; ++i) {
    ASSERT_TRUE(first.next());
    ASSERT_TRUE(second.next());
    EXPECT_EQ(second.event().event_number, first.event().event_number);
    EXPECT_EQ(second.event().data, first.event().data);
    EXPECT_EQ(second.position(), first.position());
  }
  EXPECT_FALSE(second.next());
}

}  // namespace
}  // namespace bodyschema::test
