#include "processes/model_monitor/baseline/chapter_adaptation.h"

#include <gtest/gtest.h>

#include <stdexcept>

#include "processes/model_monitor/changes/learned.h"
#include "tests/support/broken_arm.h"

namespace bodyschema {
namespace {

using test::BrokenArm;
using test::Fault;
using test::Regime;

/// A stand-in for the learner: a rigid edge is the newest pose seen, any other one is useless.
Edge newest_pose(int from, int to, const std::vector<int>& signals,
                 const std::vector<const ActionPoseSample*>& samples) {
  Edge edge;
  edge.from = from;
  edge.to = to;
  const ActionPoseSample& newest = *samples.back();
  edge.left = signals.empty() ? newest.find(from)->X_CB.inverse() * newest.find(to)->X_CB
                              : Pose(Eigen::Translation3d(9, 9, 9));
  return edge;
}

ChapterAdaptationOptions options() { return {.sigma_position_m = 0.02, .sigma_rotation_rad = 0.1}; }

TEST(ChapterAdaptationTest, ProximityIsTheShareOfCommonNodes) {
  EXPECT_DOUBLE_EQ(structural_proximity({3}, {3}), 1);
  EXPECT_DOUBLE_EQ(structural_proximity({3}, {}), 2.0 / 3);
  EXPECT_DOUBLE_EQ(structural_proximity({3}, {4}), 2.0 / 4);
  EXPECT_DOUBLE_EQ(structural_proximity({3, 4}, {4, 5}), 3.0 / 5);
}

TEST(ChapterAdaptationTest, WaitsThenSamplesOneModelAndRemembersBothBodies) {
  constexpr int kLength = 60;
  BrokenArm arm({Fault::kStuck, "", 1}, Regime::kFree, kLength, 2);
  ChapterAdaptation adaptation(arm.engineered(), options(), newest_pose);
  int invalid[4] = {};
  std::vector<AdaptationEvent::Kind> told;
  for (int t = 0; t < arm.num_samples(); ++t) {
    for (const AdaptationEvent& event : adaptation.on_sample(arm.observe(t))) {
      EXPECT_EQ(event.sample_index, t);
      EXPECT_EQ(event.to, adaptation.schema().edges[3].to);
      told.push_back(event.kind);
    }
    invalid[t / kLength] += !adaptation.has_valid_tree();
    if (t == kLength + 13) {
      EXPECT_EQ(adaptation.num_sampled(), 0);
    }
  }
  EXPECT_EQ(adaptation.num_sampled(), 1);
  EXPECT_EQ(invalid[0], 0);
  // The wait, the window that has to become bad before it, and the new model's two samples.
  EXPECT_GE(invalid[1], 15);
  EXPECT_LE(invalid[1], 30);
  EXPECT_LE(invalid[2], 15);
  EXPECT_LE(invalid[3], 15);
  using Kind = AdaptationEvent::Kind;
  std::erase(told, Kind::kMismatch);
  EXPECT_EQ(told, (std::vector{Kind::kCandidate, Kind::kRestored, Kind::kRestored}));
  EXPECT_LT(arm.error(adaptation.schema(), arm.num_samples() - 1), 0.02);
  EXPECT_EQ(adaptation.schema().edges[3].joints.size(), 0);
}

TEST(ChapterAdaptationTest, TriesFewerSignalsFirstAndTheOldOneFirstAmongThem) {
  constexpr int kLength = 150;
  BrokenArm arm({Fault::kTool, "", 1}, Regime::kFree, kLength, 2);
  std::vector<std::vector<int>> tried;
  ChapterAdaptation adaptation(arm.engineered(), options(),
                               [&](int from, int to, const std::vector<int>& signals,
                                   const std::vector<const ActionPoseSample*>& samples) {
                                 if (tried.empty() || tried.back() != signals)
                                   tried.push_back(signals);
                                 EXPECT_LE(samples.size(), 30U);
                                 EXPECT_EQ(from, 6);
                                 EXPECT_EQ(to, 7);
                                 Edge edge = newest_pose(from, to, {}, samples);
                                 if (!signals.empty())
                                   edge.left = Pose(Eigen::Translation3d(9, 9, 9));
                                 return edge;
                               });
  for (int t = 0; t < kLength + 30; ++t) adaptation.on_sample(arm.observe(t));
  std::vector<std::vector<int>> order;
  for (const auto& signals : tried)
    if (std::find(order.begin(), order.end(), signals) == order.end()) order.push_back(signals);
  ASSERT_GE(order.size(), 3U);
  EXPECT_EQ(order[0], std::vector<int>{});
  EXPECT_EQ(order[1], std::vector<int>{5});
  EXPECT_EQ(order[2].size(), 1U);
  EXPECT_FALSE(adaptation.has_valid_tree());
  EXPECT_EQ(adaptation.schema().edges[5].state, EdgeState::kInvalid);
  EXPECT_EQ(adaptation.schema().edges[5].confidence, 0);
}

TEST(ChapterAdaptationTest, ModelsThatNeverServedDoNotAddUp) {
  constexpr int kLength = 1000;
  BrokenArm arm({Fault::kTool, "", 1}, Regime::kFree, kLength, 2);
  ChapterAdaptationOptions impatient = options();
  impatient.training = 2;
  std::size_t num_models = 0;
  ChapterAdaptation adaptation(
      arm.engineered(), impatient,
      [&](int from, int to, const std::vector<int>&, const std::vector<const ActionPoseSample*>&) {
        Edge useless;
        useless.from = from;
        useless.to = to;
        useless.left.translation().setConstant(9);
        return useless;
      });
  for (int t = 0; t < 2 * kLength; ++t) {
    adaptation.on_sample(arm.observe(t));
    num_models = std::max(num_models, adaptation.num_models());
  }
  EXPECT_GT(adaptation.num_sampled(), 200);
  EXPECT_LE(num_models, 100U);
}

TEST(ChapterAdaptationTest, RefusesAnActionOfAnotherLength) {
  BrokenArm arm({Fault::kNone, "", 1}, Regime::kFree, 1, 2);
  ChapterAdaptation adaptation(arm.engineered(), options(), newest_pose);
  ActionPoseSample sample = arm.observe(0);
  sample.action.resize(3);
  EXPECT_THROW(adaptation.on_sample(sample), std::invalid_argument);
}

}  // namespace
}  // namespace bodyschema
