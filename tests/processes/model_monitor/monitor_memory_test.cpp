#include "processes/model_monitor/monitor_memory.h"

#include <gtest/gtest.h>

#include <filesystem>
#include <string>
#include <vector>

#include "common/bus/event_log.h"
#include "tests/common/bus/bus_test_support.h"
#include "tests/lcmtypes/example_messages.h"

namespace bodyschema::test {
namespace {

sample_t sample(std::int64_t index, std::int64_t epoch = 1) {
  sample_t message = example_sample();
  message.sample_index = index;
  message.epoch = epoch;
  return message;
}

class MonitorMemoryTest : public testing::Test {
 protected:
  MonitorMemoryTest() {
    memory_.schemas = {example_body_schema()};
    memory_.at_base = memory_.verdicts = example_model_health();
    memory_.verdicts.judged_sample = 9;
  }
  static std::vector<sample_t> samples(std::int64_t count, std::int64_t epoch = 1) {
    std::vector<sample_t> all;
    for (std::int64_t i = 0; i < count; ++i) all.push_back(sample(i, epoch));
    return all;
  }
  void record(const std::vector<sample_t>& all) const {
    LogAppender log(samples_, LogAppender::Mode::kOverwrite, LogAppender::Durability::kToKernel);
    for (const sample_t& message : all) log.append(kSample, message);
  }
  void save_after(const std::vector<sample_t>& all) const {
    SampleTrail trail;
    for (const sample_t& message : all) EXPECT_EQ(trail.add(message), "");
    EXPECT_EQ(MemoryFile(file_).save(memory_, trail.marks()), "");
  }
  std::optional<MonitorMemory> load() const {
    return MemoryFile(file_).load([](const body_schema_t&) { return ""; }, samples_);
  }
  /// Whether it is taken at the next start; set aside otherwise.
  bool is_taken() const {
    const bool is_loaded = load().has_value();
    EXPECT_NE(std::filesystem::exists(file_), std::filesystem::exists(file_.string() + ".bad-1"));
    EXPECT_EQ(std::filesystem::exists(file_), is_loaded);
    return is_loaded;
  }

  TemporaryFolder folder_;
  std::filesystem::path file_ = folder_ / "history.lcmlog", samples_ = folder_ / "samples.lcmlog";
  MonitorMemory memory_;
};

TEST_F(MonitorMemoryTest, WhatIsSavedIsLoaded) {
  save_after(samples(10));
  const auto loaded = load();
  ASSERT_TRUE(loaded);
  EXPECT_EQ(*loaded, memory_);
}

TEST_F(MonitorMemoryTest, AFlippedBitIsNoticedWhicheverItIs) {
  save_after(samples(10));
  const auto good = read_bytes(file_);
  for (std::size_t bit = 0; bit < 8 * good.size(); bit += 7) {
    auto bytes = good;
    bytes[bit / 8] ^= static_cast<std::uint8_t>(1U << bit % 8);
    write_bytes(file_, bytes);
    ASSERT_FALSE(load()) << "bit " << bit;
    std::filesystem::remove(file_.string() + ".bad-1");
  }
}

TEST_F(MonitorMemoryTest, TheSamplesItRestsOnAndLaterOnesAreRight) {
  save_after(samples(10));
  for (const int count : {10, 11, 30}) {
    record(samples(count));
    EXPECT_TRUE(is_taken()) << count;
  }
  // On another machine than the observer's they come by the bus.
  std::filesystem::remove(samples_);
  EXPECT_TRUE(is_taken());
}

TEST_F(MonitorMemoryTest, FewerSamplesThanItRestsOnAreNotItsOwn) {
  save_after(samples(10));
  record(samples(9));
  EXPECT_FALSE(is_taken());
}

TEST_F(MonitorMemoryTest, NoSamplesAreFewer) {
  save_after(samples(10));
  record({});
  EXPECT_FALSE(is_taken());
}

TEST_F(MonitorMemoryTest, AnotherRunsSamplesAreNotItsOwn) {
  save_after(samples(10));
  record(samples(30, 2));
  EXPECT_FALSE(is_taken());
}

TEST_F(MonitorMemoryTest, ASampleThatIsMissingOrOtherInTheMiddleIsNoticed) {
  auto all = samples(30);
  save_after(samples(10));
  all.erase(all.begin() + 4);
  record(all);
  EXPECT_FALSE(is_taken());
  std::filesystem::remove(file_.string() + ".bad-1");
  save_after(samples(10));
  all = samples(30);
  all[4].action[0] += 1e-12;
  record(all);
  EXPECT_FALSE(is_taken());
}

TEST_F(MonitorMemoryTest, ASchemaAloneClaimsNoMoreSamplesThanThereAre) {
  record(samples(10));
  EXPECT_EQ(contradiction(samples_, 9, {}), "");
  EXPECT_NE(contradiction(samples_, 10, {}), "");
  EXPECT_EQ(contradiction(samples_, -1, {}), "");
}

TEST_F(MonitorMemoryTest, ByTheBusAnotherRunIsNoticedAtItsFirstSample) {
  SampleTrail before;
  for (const sample_t& message : samples(10)) before.add(message);
  ASSERT_EQ(before.marks().size(), 2U);
  SampleTrail same(before.marks());
  // What is claimed is not forgotten by who is killed again before the samples came so far.
  EXPECT_EQ(same.add(sample(0)), "");
  EXPECT_EQ(same.marks(), before.marks());
  for (std::int64_t i = 1; i < 10; ++i) EXPECT_EQ(same.add(sample(i)), "");
  EXPECT_EQ(same.marks(), before.marks());
  EXPECT_EQ(same.add(sample(10)), "");
  EXPECT_NE(same.marks(), before.marks());
  SampleTrail other(before.marks());
  EXPECT_NE(other.add(sample(0, 2)), "");
}

}  // namespace
}  // namespace bodyschema::test
