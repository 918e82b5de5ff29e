#include "processes/console/log_follower.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <string>
#include <vector>

#include "tests/common/bus/bus_test_support.h"
#include "tests/lcmtypes/example_messages.h"

namespace bodyschema::test {
namespace {

/// Events that a follower was shown.
struct Shown {
  std::vector<std::string> channels;
  LogFollower follower;

  bool read(const std::filesystem::path& file) {
    return follower.read(
        file, [&](const LogEvent& event, const std::filesystem::path& from, std::int64_t byte) {
          EXPECT_EQ(from, file);
          // The event can be found again.
          LogReader reader(file, OnDamage::kThrow, byte);
          EXPECT_TRUE(reader.next());
          EXPECT_EQ(reader.event().data, event.data);
          channels.push_back(event.channel);
        });
  }
};

TEST(LogFollower, ShowsEveryEventOnceWhileTheLogGrows) {
  const TemporaryFolder folder;
  Shown shown;
  EXPECT_FALSE(shown.read(folder / "log"));  // not there yet
  LogAppender log(folder / "log");
  EXPECT_FALSE(shown.read(folder / "log"));
  log.append(kSample, example_sample());
  log.append(kSimState, example_sim_state());
  EXPECT_TRUE(shown.read(folder / "log"));
  EXPECT_FALSE(shown.read(folder / "log"));
  log.append(kMotionStatus, example_motion_status());
  EXPECT_TRUE(shown.read(folder / "log"));
  EXPECT_EQ(shown.channels, (std::vector<std::string>{"SAMPLE", "SIM_STATE", "MOTION_STATUS"}));
  EXPECT_EQ(shown.follower.summaries().at(folder / "log").events, 3);
  EXPECT_TRUE(shown.follower.summaries().at(folder / "log").is_sound());
}

TEST(LogFollower, AnEventIsShownWhenItIsWhole) {
  const TemporaryFolder folder;
  {
    LogAppender log(folder / "whole");
    log.append(kSample, example_sample());
    log.append(kSample, example_sample());
  }
  const auto bytes = read_bytes(folder / "whole");
  Shown shown;
  std::vector<std::size_t> sizes = {bytes.size() / 2, bytes.size()};
  for (std::size_t size = 1; size < bytes.size(); size += 29) sizes.push_back(size);
  std::sort(sizes.begin(), sizes.end());
  for (const std::size_t size : sizes) {
    write_bytes(folder / "log", {bytes.begin(), bytes.begin() + static_cast<std::ptrdiff_t>(size)});
    shown.read(folder / "log");
    EXPECT_EQ(shown.channels.size(), size / (bytes.size() / 2)) << size;
    const bool is_whole = size % (bytes.size() / 2) == 0;
    EXPECT_EQ(shown.follower.summaries().at(folder / "log").damage.empty(), is_whole) << size;
  }
}

TEST(LogFollower, ADamagedLogIsReadUpToThereAndSaysSo) {
  const TemporaryFolder folder;
  {
    LogAppender log(folder / "log");
    for (int i = 0; i < 3; ++i) log.append(kSample, example_sample());
  }
  auto bytes = read_bytes(folder / "log");
  bytes[bytes.size() / 3] ^= 0xFF;
  write_bytes(folder / "log", bytes);
  Shown shown;
  EXPECT_TRUE(shown.read(folder / "log"));
  EXPECT_EQ(shown.channels.size(), 1U);
  EXPECT_NE(shown.follower.summaries().at(folder / "log").damage.find("damaged"),
            std::string::npos);
  // It stays so, however it grows.
  bytes.push_back(0);
  write_bytes(folder / "log", bytes);
  EXPECT_FALSE(shown.read(folder / "log"));
  EXPECT_EQ(shown.channels.size(), 1U);

  write_bytes(folder / "text", {'n', 'o', ' ', 'l', 'o', 'g'});
  EXPECT_FALSE(shown.read(folder / "text"));
  EXPECT_EQ(shown.follower.summaries().at(folder / "text").damage,
            "is not an LCM log (its first bytes are no event)");
}

}  // namespace
}  // namespace bodyschema::test
