#include "common/bus/sample_intake.h"

#include <gtest/gtest.h>
#include <unistd.h>

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <numeric>
#include <optional>
#include <random>

#include "common/bus/event_log.h"

namespace bodyschema {
namespace {

sample_t sample(std::int64_t index) {
  sample_t message{};
  message.utime = 1000 * index;
  message.sample_index = index;
  message.source = "motor_babbler";
  return message;
}

class SampleIntakeTest : public testing::Test {
 protected:
  SampleIntakeTest() {
    const auto* test = testing::UnitTest::GetInstance()->current_test_info();
    file_ = std::filesystem::path(testing::TempDir()) /
            ("sample_intake_" + std::to_string(getpid()) + test->name() + ".lcmlog");
    std::filesystem::remove(file_);
  }
  ~SampleIntakeTest() override { std::filesystem::remove(file_); }

  void record(const std::vector<std::int64_t>& indices) const {
    LogAppender log(file_, LogAppender::Mode::kAppend, LogAppender::Durability::kToKernel);
    for (const std::int64_t index : indices) log.append(kSample, sample(index));
  }
  SampleIntake& start(bool with_log = true) {
    intake_.emplace(with_log ? file_.string() : "", [this](const sample_t& message) {
      EXPECT_EQ(message.utime, 1000 * message.sample_index);
      heard_.push_back(message.sample_index);
    });
    return *intake_;
  }
  void hear(const std::vector<std::int64_t>& indices) {
    for (const std::int64_t index : indices) intake_->on_sample(sample(index));
  }

  using Indices = std::vector<std::int64_t>;
  std::filesystem::path file_;
  std::optional<SampleIntake> intake_;
  Indices heard_;
};

TEST_F(SampleIntakeTest, WithoutALogLiveSamplesAreAllThereIs) {
  start(false);
  hear({2, 3, 6});
  EXPECT_EQ(heard_, (Indices{2, 3, 6}));
  EXPECT_EQ(intake_->num_lost(), 4);
}

TEST_F(SampleIntakeTest, ALogThatDoesNotExistYetIsNoError) {
  start();
  hear({0, 1});
  record({0, 1, 2, 3});
  hear({4});
  EXPECT_EQ(heard_, (Indices{0, 1, 2, 3, 4}));
  EXPECT_EQ(intake_->num_lost(), 0);
}

TEST_F(SampleIntakeTest, AnEmptyLogIsNoError) {
  std::ofstream(file_).close();
  start();
  hear({0});
  EXPECT_EQ(heard_, (Indices{0}));
}

TEST_F(SampleIntakeTest, WhatWasRecordedBeforeIsHandedOnAtStart) {
  record({0, 1, 2});
  start();
  EXPECT_EQ(heard_, (Indices{0, 1, 2}));
  hear({1, 2, 3});
  EXPECT_EQ(heard_, (Indices{0, 1, 2, 3}));
}

TEST_F(SampleIntakeTest, ALostDatagramIsReadFromTheLog) {
  start();
  hear({0});
  record({0, 1, 2, 3});
  hear({3, 4});
  EXPECT_EQ(heard_, (Indices{0, 1, 2, 3, 4}));
  EXPECT_EQ(intake_->num_lost(), 0);
}

TEST_F(SampleIntakeTest, TheLogMayBeAheadOfTheBus) {
  start();
  record({0, 1, 2, 3, 4, 5});
  hear({2});
  EXPECT_EQ(heard_, (Indices{0, 1, 2, 3, 4, 5}));
  hear({3, 4, 5});
  EXPECT_EQ(heard_.size(), 6U);
}

TEST_F(SampleIntakeTest, TheLogMayBeBehindTheBus) {
  record({0, 1});
  start();
  hear({4});
  EXPECT_EQ(heard_, (Indices{0, 1, 4}));
  EXPECT_EQ(intake_->num_lost(), 2);
}

// A sample that nobody recorded must not hide those that were recorded after it.
TEST_F(SampleIntakeTest, AHoleInTheLogCostsOnlyWhatIsMissing) {
  record({0, 1, 3, 4, 7});
  start();
  EXPECT_EQ(heard_, (Indices{0, 1, 3, 4, 7}));
  EXPECT_EQ(intake_->num_lost(), 3);
  record({9, 10});
  hear({10, 11});
  EXPECT_EQ(heard_, (Indices{0, 1, 3, 4, 7, 9, 10, 11}));
  EXPECT_EQ(intake_->num_lost(), 4);
}

TEST_F(SampleIntakeTest, TheLastSampleOfARunIsFoundInTheLogWhenNoMoreComes) {
  constexpr std::int64_t kSecond = 1'000'000;
  start();
  intake_->on_tick(10 * kSecond);  // there is no log yet
  intake_->on_tick(20 * kSecond);
  record({0, 1});
  hear({0});
  intake_->on_tick(30 * kSecond);
  intake_->on_tick(32 * kSecond - 1);
  EXPECT_EQ(heard_, (Indices{0}));
  intake_->on_tick(32 * kSecond);
  EXPECT_EQ(heard_, (Indices{0, 1}));
  record({2});
  hear({1});  // the bus is alive: no need to look
  intake_->on_tick(40 * kSecond);
  intake_->on_tick(41 * kSecond);
  EXPECT_EQ(heard_, (Indices{0, 1}));
  intake_->on_tick(42 * kSecond);
  EXPECT_EQ(heard_, (Indices{0, 1, 2}));

  start(false);
  intake_->on_tick(50 * kSecond);
  EXPECT_NO_THROW(intake_->on_tick(60 * kSecond));
}

TEST_F(SampleIntakeTest, ASampleIsHandedOnOnce) {
  record({0, 0, 1, 1, 0, 2});
  start();
  hear({2, 2, 1, 3, 3, 0, 3});
  EXPECT_EQ(heard_, (Indices{0, 1, 2, 3}));
  EXPECT_EQ(intake_->num_lost(), 0);
}

TEST_F(SampleIntakeTest, OtherChannelsInTheLogAreSkipped) {
  {
    LogAppender log(file_);
    log.append(kSample, sample(0));
    process_info_t info{};
    info.process_name = "observer";
    info.pid = 1;
    info.seed = -1;
    log.append(kProcessInfo, info);
    log.append(kSample, sample(1));
  }
  start();
  EXPECT_EQ(heard_, (Indices{0, 1}));
}

TEST_F(SampleIntakeTest, ATornTailIsLeftOutUntilItIsWhole) {
  record({0, 1, 2});
  const auto size = std::filesystem::file_size(file_);
  record({3});
  const auto whole = std::filesystem::file_size(file_);
  for (auto torn = whole - 1; torn > size; --torn) {
    std::filesystem::resize_file(file_, torn);
    heard_.clear();
    start();
    EXPECT_EQ(heard_, (Indices{0, 1, 2})) << torn - size << " bytes of the last event";
  }
  // The observer comes back, cuts off the tail and records the sample again.
  record({3, 4});
  hear({4, 5});
  EXPECT_EQ(heard_, (Indices{0, 1, 2, 3, 4, 5}));
}

// Whatever is lost, repeated or delayed: in order, each once, and what the log has is never
// missing.
TEST_F(SampleIntakeTest, AnyHistoryIsHandedOnInOrderEachOnce) {
  std::mt19937_64 rng(3);
  for (int run = 0; run < 50; ++run) {
    std::filesystem::remove(file_);
    heard_.clear();
    std::vector<bool> available(40, false);
    Indices recorded;
    for (std::int64_t i = 0; i < 15; ++i) {
      if (rng() % 8 == 0) continue;
      recorded.push_back(i);
      available[i] = true;
    }
    record(recorded);
    start();
    std::int64_t last_heard = -1;
    for (std::int64_t i = 5; i < 40; ++i) {
      const bool is_recorded = i >= 15 && rng() % 8 != 0;
      if (is_recorded) record({i});
      if (rng() % 3 == 0) continue;  // the datagram is lost
      if (is_recorded || i >= 15) available[i] = true;
      last_heard = i;
      hear(rng() % 4 ? Indices{i} : Indices{i, i - 1, i});
    }
    EXPECT_TRUE(std::is_sorted(heard_.begin(), heard_.end()));
    EXPECT_EQ(std::adjacent_find(heard_.begin(), heard_.end()), heard_.end());
    for (std::int64_t i = 0; i <= last_heard; ++i) {
      if (available[i]) {
        EXPECT_TRUE(std::binary_search(heard_.begin(), heard_.end(), i)) << run << ": " << i;
      }
    }
    const auto missing = heard_.back() + 1 - static_cast<std::int64_t>(heard_.size());
    EXPECT_EQ(intake_->num_lost(), missing);
  }
}

}  // namespace
}  // namespace bodyschema
