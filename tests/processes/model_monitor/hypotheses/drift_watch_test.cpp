#include "processes/model_monitor/hypotheses/drift_watch.h"

#include <gtest/gtest.h>

#include <cmath>

#include "common/geometry/angle.h"
#include "processes/model_monitor/changes/body_change.h"
#include "processes/model_monitor/hypotheses/change_fit.h"
#include "tests/support/broken_arm.h"

namespace bodyschema {
namespace {

using test::BrokenArm;
using test::Fault;
using test::Regime;

/// Feeds an arm's samples; until `stop` says so. Returns how many there were.
template <typename Stop>
int feed(BrokenArm& arm, DriftWatch& watch, int begin, int end, Stop stop) {
  const BodySchema& schema = arm.engineered();
  const TreeFilter filter(schema, test::adaptation_options(Regime::kTagIso).measurement);
  for (int t = begin; t < end; ++t) {
    const ActionPoseSample sample = arm.observe(t);
    watch.add(filter, filter.prepare(sample), schema, schema.displacements(sample.action), t);
    if (stop()) return t + 1;
  }
  return end;
}

TEST(DriftWatchTest, AHealthyArmDoesNotMove) {
  for (const int seed : {1, 2, 3}) {
    BrokenArm arm({Fault::kNone, "", 0.85}, Regime::kTagIso, 75, seed);
    DriftWatch watch(1e-5);
    feed(arm, watch, 0, 300, [&] {
      const auto moved = watch.moved(arm.engineered());
      EXPECT_FALSE(moved && moved->is_sure);
      return false;
    });
  }
}

TEST(DriftWatchTest, ASlowBendIsFoundAtItsEdgeWhileItIsSmallAndThenFollowed) {
  constexpr int kHealthy = 40;
  for (const int seed : {1, 2, 3}) {
    BrokenArm arm({Fault::kDrift, "", 0.85}, Regime::kTagIso, kHealthy, seed);
    DriftWatch watch(1e-5);
    const int found = feed(arm, watch, 0, 4 * kHealthy, [&] {
      const auto moved = watch.moved(arm.engineered());
      return moved && moved->is_sure;
    });
    EXPECT_GT(found, kHealthy);
    EXPECT_LT(found, kHealthy + 75);  // 3.75°, about 20 mm at the end effector
    EXPECT_EQ(watch.moved(arm.engineered())->element, edge_element(4, 1));
    const int end = 4 * kHealthy;
    feed(arm, watch, found, end, [] { return false; });
    const auto drift = watch.follow(arm.engineered(), 4);
    ASSERT_TRUE(drift);
    EXPECT_NEAR(rotation_angle(drift->T) / kDegree, 0.05 * (end - 1 - kHealthy), 1);
    EXPECT_NEAR(drift->rate.tail<3>().norm() / kDegree, 0.05, 0.03);
    EXPECT_GT(drift->significance, 12.6);  // χ²₆(0.95)
  }
}

TEST(DriftWatchTest, AFastBendIsFoundSinceItsBeginAndItsEndIsSeen) {
  constexpr int kHealthy = 30, kBent = 10, kStill = 10;
  for (const int seed : {1, 2, 3}) {
    BrokenArm arm({Fault::kDrift, "", 0.85, 1, kBent}, Regime::kTagIso, kHealthy, seed);
    const BodySchema& schema = arm.engineered();
    const MeasurementModel measurement = test::adaptation_options(Regime::kTagIso).measurement;
    std::vector<ActionPoseSample> life;
    for (int t = 0; t < kHealthy + kBent + kStill; ++t) life.push_back(arm.observe(t));
    const auto between = [&life](int begin, int end) {
      std::vector<const ActionPoseSample*> samples;
      for (int t = begin; t < end; ++t) samples.push_back(&life[static_cast<std::size_t>(t)]);
      return samples;
    };
    const auto samples = between(0, kHealthy + kBent);
    const auto found = begun_drifts(schema, measurement, {3, 4, 5}, samples, kHealthy + 2);
    ASSERT_FALSE(found.empty());
    EXPECT_EQ(found[0].drift.part, 4);
    EXPECT_TRUE(found[0].is_good);
    EXPECT_NEAR(static_cast<double>(found[0].begin), kHealthy, 2);
    EXPECT_NEAR(found[0].drift.rate.tail<3>().norm() / kDegree, 1, 0.4);
    EXPECT_NEAR(rotation_angle(found[0].drift.T) / kDegree, kBent - 1, 2);
    EXPECT_GT(found[0].log_likelihood(schema, measurement, samples) + found[0].log_prior,
              log_likelihood(schema, measurement, samples) + 50);

    DriftWatch watch(1e-5);
    watch.look_again(schema, measurement, 4, between(kHealthy, kHealthy + kBent));
    const auto going_on = watch.follow(schema, 4);
    ASSERT_TRUE(going_on);
    EXPECT_LT(going_on->has_ended, 0.5);
    watch.look_again(schema, measurement, 4, between(kHealthy, kHealthy + kBent + kStill));
    const auto ended = watch.follow(schema, 4);
    ASSERT_TRUE(ended);
    EXPECT_GT(ended->has_ended, 0.99);
    EXPECT_NEAR(static_cast<double>(ended->last_moved), kHealthy + kBent, 2);
    EXPECT_NEAR(rotation_angle(ended->T) / kDegree, kBent, 1.5);
  }
}

TEST(DriftWatchTest, ABentLinkHasNotDriftedWell) {
  constexpr int kHealthy = 30;
  for (const int seed : {1, 2, 3}) {
    BrokenArm arm({Fault::kBend, "", 0.85}, Regime::kTagIso, kHealthy, seed);
    const BodySchema& schema = arm.engineered();
    const MeasurementModel measurement = test::adaptation_options(Regime::kTagIso).measurement;
    std::vector<ActionPoseSample> life;
    for (int t = 0; t < kHealthy + 8; ++t) life.push_back(arm.observe(t));
    std::vector<const ActionPoseSample*> samples;
    for (const ActionPoseSample& sample : life) samples.push_back(&sample);
    const auto drifts = begun_drifts(schema, measurement, {5}, samples, kHealthy);
    EXPECT_FALSE(drifts.empty());
    for (const BegunDrift& drift : drifts) EXPECT_FALSE(drift.is_good);
  }
}

TEST(DriftWatchTest, WhatIsKnownOfAnotherSchemaIsNotHeldAgainstThis) {
  BrokenArm arm({Fault::kNone, "", 1}, Regime::kTagIso, 75, 1);
  BodySchema rigid = arm.engineered();  // its edges have fewer links
  for (Edge& edge : rigid.edges) {
    edge.joints.clear();
    edge.parameter_covariance = Eigen::MatrixXd::Zero(6, 6);
  }
  const TreeFilter filter(rigid, test::adaptation_options(Regime::kTagIso).measurement);
  DriftWatch watch(1e-5);
  for (int t = 0; t < 120; ++t) {
    const ActionPoseSample sample = arm.observe(t);
    watch.add(filter, filter.prepare(sample), rigid, rigid.displacements(sample.action), t);
  }
  EXPECT_NO_THROW(watch.moved(arm.engineered()));  // reads nothing beyond its links
}

TEST(DriftWatchTest, TheSpreadOfAnEdgeIsThatOfWhatItDoes) {
  BrokenArm arm({Fault::kIntermittent, "", 1}, Regime::kTagIso, 60, 2);
  DriftWatch watch(1e-5);
  feed(arm, watch, 0, 60, [] { return false; });
  const DriftWatch::Spread whole = watch.spread(arm.engineered(), 5);
  EXPECT_EQ(whole.size, 40U);
  EXPECT_LE(whole.num_off, 3U);
  feed(arm, watch, 60, 120, [] { return false; });
  const DriftWatch::Spread broken = watch.spread(arm.engineered(), 5);
  EXPECT_GE(broken.num_off, 8U);
  // 45° for a part of the time, against some degrees of noise.
  EXPECT_GT(std::sqrt(broken.second_moment.bottomRightCorner<3, 3>().trace()), 15 * kDegree);
  EXPECT_LT(std::sqrt(whole.second_moment.bottomRightCorner<3, 3>().trace()), 5 * kDegree);
}

TEST(DriftWatchTest, WhatIsForgottenSaysNothing) {
  BrokenArm arm({Fault::kDrift, "", 0.85}, Regime::kTagIso, 40, 1);
  DriftWatch watch(1e-5);
  EXPECT_FALSE(watch.follow(arm.engineered(), 4));
  feed(arm, watch, 0, 160, [] { return false; });
  ASSERT_TRUE(watch.follow(arm.engineered(), 4));
  watch.forget(4, 160);
  EXPECT_FALSE(watch.follow(arm.engineered(), 4));
  EXPECT_TRUE(watch.follow(arm.engineered(), 5));
  watch.forget_all();
  EXPECT_FALSE(watch.follow(arm.engineered(), 5));
  EXPECT_FALSE(watch.moved(arm.engineered()));
}

}  // namespace
}  // namespace bodyschema
