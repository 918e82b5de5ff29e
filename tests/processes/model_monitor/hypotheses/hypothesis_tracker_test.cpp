#include "processes/model_monitor/hypotheses/hypothesis_tracker.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <vector>

#include "tests/support/broken_arm.h"

namespace bodyschema {
namespace {

using Kind = AdaptationEvent::Kind;
using test::BrokenArm;
using test::Fault;
using test::Regime;

constexpr int kBlock = 60;

/// A tracker alone: nothing cleans its samples, its noise is told.
class HypothesisTrackerTest : public testing::Test {
 protected:
  void watch(const test::Scenario& scenario, int num_samples, Regime regime = Regime::kTagIso) {
    arm_.emplace(scenario, regime, kBlock, 3);
    const AdaptationOptions options = test::adaptation_options(regime);
    tracker_.emplace(arm_->engineered(), options.measurement, options, false);
    go_on(num_samples);
  }
  void go_on(int num_samples) {
    for (int n = 0; n < num_samples; ++n, ++now_)
      tracker_->on_sample(arm_->observe(now_), &events_);
  }
  static ElementId edge(int part) { return {ElementId::Kind::kJoint, part}; }
  std::ptrdiff_t count(Kind kind) const {
    return std::count_if(events_.begin(), events_.end(),
                         [kind](const AdaptationEvent& e) { return e.kind == kind; });
  }

  std::optional<BrokenArm> arm_;
  std::optional<HypothesisTracker> tracker_;
  std::vector<AdaptationEvent> events_;
  int now_ = 0;
};

TEST_F(HypothesisTrackerTest, NothingChangesWhereNothingChanged) {
  watch({Fault::kNone, "", 0.85}, 4 * kBlock);
  EXPECT_TRUE(events_.empty());
  EXPECT_TRUE(tracker_->changes().empty());
  EXPECT_EQ(tracker_->log_odds(), 0);
  EXPECT_EQ(tracker_->most_log_odds(), 0);
}

TEST_F(HypothesisTrackerTest, AChangeStandsAndSettlesAfterFortySamples) {
  watch({Fault::kBend, "", 0.85}, kBlock + 5);
  ASSERT_EQ(tracker_->changes().size(), 1U);
  EXPECT_EQ(tracker_->changes()[0].what.element, edge(5));
  EXPECT_EQ(tracker_->changes()[0].since, kBlock);
  EXPECT_GT(tracker_->log_odds(), test::adaptation_options(Regime::kTagIso).acceptance);
  EXPECT_EQ(arm_->error(tracker_->settled(), 0), arm_->error(arm_->engineered(), 0));
  EXPECT_EQ(count(Kind::kMismatch), 1);
  EXPECT_EQ(count(Kind::kCandidate), 1);
  EXPECT_EQ(count(Kind::kRecovered), 0);
  go_on(45);
  EXPECT_TRUE(tracker_->changes().empty());
  EXPECT_EQ(tracker_->log_odds(), 0);
  EXPECT_EQ(count(Kind::kRecovered), 1);
  EXPECT_EQ(tracker_->history().size(), 2U);
  EXPECT_LT(arm_->error(tracker_->settled(), now_ - 1), 0.01);
}

// The stuck joint is found first, alone or in a form that takes the tool's part; both in the end.
TEST_F(HypothesisTrackerTest, TwoChangesAtOnceStandBesideEachOther) {
  watch({Fault::kTwo, "", 0.85}, kBlock + 12);
  std::vector<int> parts;
  for (const auto& change : tracker_->changes()) parts.push_back(change.what.element.id);
  std::sort(parts.begin(), parts.end());
  EXPECT_EQ(parts, (std::vector<int>{3, 7}));
  EXPECT_LT(arm_->error(tracker_->schema(), now_ - 1), 0.02);
}

// Before it has settled the body changes back: the newer change of a place holds from its own
// first sample on, the older one until then.
TEST_F(HypothesisTrackerTest, ANewerChangeOfAPlaceTakesThePlaceOfAnOlderOne) {
  BrokenArm arm({Fault::kOffset, "", 0.85}, Regime::kTagIso, 15, 3);
  const AdaptationOptions options = test::adaptation_options(Regime::kTagIso);
  tracker_.emplace(arm.engineered(), options.measurement, options, false);
  for (int t = 0; t < 4 * 15; ++t) tracker_->on_sample(arm.observe(t), &events_);
  for (const auto& change : tracker_->changes()) EXPECT_EQ(change.what.element, edge(4));
  EXPECT_LT(arm.error(tracker_->schema(), 4 * 15 - 1), 0.015);
  EXPECT_EQ(tracker_->trouble_since(), 15);
  // The way back is told as what it is, so that the body holds since then.
  const auto is_back = [](const AdaptationEvent& e) {
    return e.kind == Kind::kRestored && e.sample_index >= 30 && e.sample_index < 35 &&
           e.since >= 30;
  };
  EXPECT_TRUE(std::any_of(events_.begin(), events_.end(), is_back));
  const auto is_broken_again = [](const AdaptationEvent& e) {
    return (e.kind == Kind::kRestored || e.kind == Kind::kCandidate) && e.since >= 45;
  };
  EXPECT_TRUE(std::any_of(events_.begin(), events_.end(), is_broken_again));
}

TEST_F(HypothesisTrackerTest, WhatIsTakenBackIsToldAndGone) {
  watch({Fault::kBend, "", 0.85}, kBlock + 5);
  std::vector<AdaptationEvent> told;
  const auto is_it = [](const ElementId& element) { return element == edge(5); };
  int num_cleaned = 0;
  const auto clean = [&](ActionPoseSample* sample) {
    sample->parts.clear();
    ++num_cleaned;
  };
  // What began before is none of it.
  tracker_->take_back(is_it, kBlock + 1, clean, now_, &told);
  EXPECT_TRUE(told.empty());
  EXPECT_EQ(num_cleaned, 4);
  EXPECT_EQ(tracker_->changes().size(), 1U);
  tracker_->take_back(is_it, kBlock, clean, now_, &told);
  ASSERT_EQ(told.size(), 1U);
  EXPECT_EQ(told[0].kind, Kind::kReverted);
  EXPECT_EQ(told[0].to, 5);
  EXPECT_TRUE(tracker_->changes().empty());
  EXPECT_TRUE(tracker_->suspects().empty());
}

// What is seen no more is no evidence against: an explanation stays while nothing speaks.
TEST_F(HypothesisTrackerTest, SamplesThatShowNothingChangeNoOdds) {
  watch({Fault::kBend, "", 0.85}, kBlock + 5);
  const double odds = tracker_->log_odds();
  ActionPoseSample nothing = arm_->observe(now_);
  nothing.parts.clear();
  tracker_->on_sample(nothing, &events_);
  ASSERT_EQ(tracker_->changes().size(), 1U);
  EXPECT_NEAR(tracker_->log_odds(), odds, 1);
}

}  // namespace
}  // namespace bodyschema
