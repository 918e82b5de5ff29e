#include "processes/model_monitor/drift_watch.h"

#include <gtest/gtest.h>

#include <cmath>

#include "common/geometry/angle.h"
#include "processes/model_monitor/body_change.h"
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
  const TreeFilter filter(schema, test::adaptation_options(Regime::kTagIso).noise);
  for (int t = begin; t < end; ++t) {
    const ActionPoseSample sample = arm.observe(t);
    watch.add(filter, filter.prepare(sample), schema.displacements(sample.action), t);
    if (stop()) return t + 1;
  }
  return end;
}

TEST(DriftWatchTest, AHealthyArmDoesNotMove) {
  for (const int seed : {1, 2, 3}) {
    BrokenArm arm({Fault::kNone, "", 0.85}, Regime::kTagIso, 75, seed);
    DriftWatch watch(1e-5);
    feed(arm, watch, 0, 300, [&] {
      EXPECT_FALSE(watch.moved_part(arm.engineered()));
      return false;
    });
  }
}

TEST(DriftWatchTest, ASlowBendIsFoundAtItsEdgeWhileItIsSmallAndThenFollowed) {
  constexpr int kHealthy = 40;
  for (const int seed : {1, 2, 3}) {
    BrokenArm arm({Fault::kDrift, "", 0.85}, Regime::kTagIso, kHealthy, seed);
    DriftWatch watch(1e-5);
    const int found = feed(arm, watch, 0, 4 * kHealthy,
                           [&] { return watch.moved_part(arm.engineered()).has_value(); });
    EXPECT_GT(found, kHealthy);
    EXPECT_LT(found, kHealthy + 75);  // 3.75°, about 20 mm at the end effector
    EXPECT_EQ(watch.moved_part(arm.engineered()), 4);
    const int end = 4 * kHealthy;
    feed(arm, watch, found, end, [] { return false; });
    const auto drift = watch.follow(arm.engineered(), 4);
    ASSERT_TRUE(drift);
    EXPECT_NEAR(rotation_angle(drift->T) / kDegree, 0.05 * (end - 1 - kHealthy), 1);
    EXPECT_NEAR(drift->rate.tail<3>().norm() / kDegree, 0.05, 0.03);
    EXPECT_GT(drift->significance, 12.6);  // χ²₆(0.95)
  }
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
  EXPECT_FALSE(watch.moved_part(arm.engineered()));
}

}  // namespace
}  // namespace bodyschema
