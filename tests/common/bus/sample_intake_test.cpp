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
#include "tests/support/temporary_folder.h"

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

  SampleIntake& start_asking() {
    intake_.emplace(
        file_.string(), [this](const sample_t& message) { heard_.push_back(message.sample_index); },
        [this](const sample_request_t& request) {
          asked_.emplace_back(request.first_missing, request.last_missing);
        });
    return *intake_;
  }

  using Indices = std::vector<std::int64_t>;
  using Requests = std::vector<std::pair<std::int64_t, std::int64_t>>;
  Requests asked_;
  test::TemporaryFolder folder_;
  std::filesystem::path file_ = folder_ / "samples.lcmlog";
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

// An unrecorded sample must not hide the recorded ones after it.
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

constexpr std::int64_t kSecond = 1'000'000;

TEST_F(SampleIntakeTest, SaysWhichSamplesNobodyHas) {
  record({5, 6, 8});
  start();
  EXPECT_EQ(heard_, (Indices{5, 6, 8}));
  EXPECT_EQ(intake_->lost(), (Requests{{0, 4}, {7, 7}}));
  EXPECT_EQ(intake_->num_lost(), 6);
}

TEST_F(SampleIntakeTest, BehindAGapItWaitsAndAsksTwiceASecond) {
  start_asking();
  hear({0, 1, 4, 7});
  EXPECT_EQ(heard_, (Indices{0, 1}));
  for (std::int64_t t = 10 * kSecond; t < 12 * kSecond; t += kSecond / 10) intake_->on_tick(t);
  EXPECT_EQ(asked_, (Requests{{2, 3}, {2, 3}, {2, 3}, {2, 3}}));
  EXPECT_NE(intake_->activity().find("SAMPLE 2 to 3"), std::string::npos);
  hear({2, 3});
  EXPECT_EQ(heard_, (Indices{0, 1, 2, 3, 4}));
  asked_.clear();
  intake_->on_tick(13 * kSecond);
  EXPECT_EQ(asked_, (Requests{{5, 6}}));
  hear({6, 5});
  EXPECT_EQ(heard_, (Indices{0, 1, 2, 3, 4, 5, 6, 7}));
  asked_.clear();
  intake_->on_tick(20 * kSecond);
  EXPECT_TRUE(asked_.empty());
  EXPECT_EQ(intake_->activity(), "");
  EXPECT_EQ(intake_->num_lost(), 0);
}

TEST_F(SampleIntakeTest, AGapIsGivenUpOnlyWhenTheObserverIsThereAndDoesNotFillIt) {
  start_asking();
  hear({0, 3});
  std::int64_t t = 0;
  // A silent observer may come back with the missing samples.
  for (; t < 600 * kSecond; t += kSecond / 2) intake_->on_tick(t);
  EXPECT_EQ(heard_, (Indices{0}));
  for (int n = 0; heard_.size() == 1; ++n, t += kSecond / 2) {
    ASSERT_LT(n, 60) << "it never gives up";
    if (n % 2 == 0) hear({3});  // the newest, at 1 Hz
    intake_->on_tick(t);
    if (n < 18) {
      ASSERT_EQ(heard_, (Indices{0})) << "given up after " << n / 2 << " s";
    }
  }
  EXPECT_EQ(heard_, (Indices{0, 3}));
  EXPECT_EQ(intake_->num_lost(), 2);
  EXPECT_EQ(intake_->counters().at("lost SAMPLE"), 2);
  hear({4});
  EXPECT_EQ(heard_, (Indices{0, 3, 4}));
}

TEST_F(SampleIntakeTest, WhoJoinsLateWithoutALogGetsAllSamplesInOrder) {
  start_asking();
  hear({120});
  std::int64_t t = 0;
  while (heard_.size() < 121 && t < 600 * kSecond) {
    asked_.clear();
    intake_->on_tick(t += kSecond / 2);
    if (asked_.empty()) continue;
    // The observer answers with 50 at most, and every third datagram is lost.
    for (std::int64_t i = asked_[0].first; i <= asked_[0].second && i < asked_[0].first + 50; ++i) {
      if ((i + t / kSecond) % 3 != 0) hear({i});
    }
    hear({120});
  }
  Indices all(121);
  std::iota(all.begin(), all.end(), 0);
  EXPECT_EQ(heard_, all);
  EXPECT_EQ(intake_->num_lost(), 0);
}

TEST_F(SampleIntakeTest, ASampleFromNowhereDoesNotEndTheRun) {
  start_asking();
  hear({0, 1});
  std::int64_t t = 0;
  for (int n = 0; n < 100; ++n) {
    hear({1'000'000});
    if (n % 2 == 0) hear({1});  // the observer says what its newest is
    intake_->on_tick(t += kSecond / 2);
  }
  hear({2, 3});
  EXPECT_EQ(heard_, (Indices{0, 1, 2, 3}));
  EXPECT_GT(intake_->counters().at("conflicting SAMPLE"), 0);
}

TEST_F(SampleIntakeTest, TheFirstContentOfAnIndexCounts) {
  start_asking();
  hear({0, 1});
  sample_t other = sample(1);
  other.epoch = 77;
  intake_->on_sample(other);
  EXPECT_EQ(heard_, (Indices{0, 1}));
  EXPECT_EQ(intake_->counters().at("conflicting SAMPLE"), 1);
  EXPECT_NE(intake_->activity().find("begun anew"), std::string::npos);
  hear({1, 0});  // repeats are no conflict
  EXPECT_EQ(intake_->counters().at("conflicting SAMPLE"), 1);
}

// On the observer's machine a sample that was not written cannot be the observer's: whatever index
// a stranger chooses, no process waits for it and no sample of the observer is displaced.
TEST_F(SampleIntakeTest, WhatTheObserverDidNotWriteIsRefused) {
  record({0, 1});
  start_asking();
  sample_t forged = sample(2);
  forged.epoch = 77;
  for (const std::int64_t index : {2, 3, 1'000'000}) {
    forged.sample_index = index;
    EXPECT_FALSE(intake_->on_sample(forged));
    EXPECT_EQ(intake_->activity(), "");
  }
  EXPECT_EQ(intake_->counters().at("unrecorded SAMPLE"), 3);
  // Nor one that comes with the observer's own index, before or after it.
  record({2});
  forged.sample_index = 2;
  EXPECT_FALSE(intake_->on_sample(forged));
  EXPECT_TRUE(intake_->on_sample(sample(2)));
  EXPECT_FALSE(intake_->on_sample(forged));
  EXPECT_EQ(intake_->counters().at("conflicting SAMPLE"), 2);
  EXPECT_EQ(intake_->activity(), "") << "the observer has not begun anew";
  EXPECT_EQ(heard_, (Indices{0, 1, 2}));
  intake_->on_tick(kSecond);
  EXPECT_TRUE(asked_.empty());
}

TEST_F(SampleIntakeTest, AnObserverThatBeganAnewIsNoticedInItsFile) {
  record({0, 1, 2});
  start_asking();
  std::filesystem::remove(file_);
  {
    LogAppender log(file_);
    sample_t other = sample(0);
    other.epoch = 77;
    log.append(kSample, other);
    intake_->on_sample(sample(3));
  }
  EXPECT_NE(intake_->activity().find("begun anew"), std::string::npos);
}

TEST_F(SampleIntakeTest, OfADamagedLogWhatCanBeReadIsUsedAndTheRestAskedFor) {
  record({0, 1, 2, 3});
  const auto size = std::filesystem::file_size(file_) / 4;
  std::fstream(file_, std::ios::in | std::ios::out | std::ios::binary)
      .seekp(static_cast<std::streamoff>(size + 1))
      .write("damage", 6);
  start_asking();
  EXPECT_EQ(heard_, (Indices{0}));
  intake_->on_tick(kSecond);
  EXPECT_EQ(asked_, (Requests{{1, 1}}));
  hear({1});
  EXPECT_EQ(heard_, (Indices{0, 1, 2, 3}));
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

// Samples are lost, repeated and delayed: they come in order, each once, and none of the log is
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
