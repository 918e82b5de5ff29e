#include "processes/structure_learner/one_cluster.h"

#include <gtest/gtest.h>

#include "processes/structure_learner/learn.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

// The chapter's 2-DOF robot, its commands this share of their range about somewhere.
LearnResult learned(double share, test::Regime regime, int seed) {
  test::Rng rng(static_cast<test::Rng::result_type>(seed));
  const test::SyntheticRobot robot = test::chapter_robot("a", rng);
  std::vector<ActionPoseSample> samples;
  for (int n = 0; n < 40; ++n) {
    const Eigen::VectorXd action =
        Eigen::Vector2d(0.3, -0.4) + share * robot.random_action(rng).head<2>();
    samples.push_back(
        test::observe(robot, action, {.regime = regime, .with_covariances = true}, n, rng));
  }
  return learn(robot.signals, samples);
}

TEST(OneCluster, PosesOverTheWholeRangeAreMany) {
  for (int seed = 1; seed <= 5; ++seed)
    for (const test::Regime regime :
         {test::Regime::kFree, test::Regime::kTagIso, test::Regime::kTag, test::Regime::kChapter})
      EXPECT_FALSE(learned(1, regime, seed).is_one_cluster) << seed << test::name_of(regime);
}

TEST(OneCluster, MotionWithinTheNoiseIsOne) {
  for (int seed = 1; seed <= 5; ++seed)
    EXPECT_TRUE(learned(0.01, test::Regime::kTagIso, seed).is_one_cluster) << seed;
}

// Exact poses tell the joints of a hundredth of their range, but not how they go on.
TEST(OneCluster, JointsThatHardlyTurnAreOne) {
  for (int seed = 1; seed <= 5; ++seed) {
    const LearnResult result = learned(0.01, test::Regime::kFree, seed);
    EXPECT_FALSE(result.schema.edges.empty());
    EXPECT_TRUE(result.is_one_cluster) << seed;
    EXPECT_FALSE(learned(0.3, test::Regime::kFree, seed).is_one_cluster) << seed;
  }
}

TEST(OneCluster, WithoutAnyMotionThereIsNothingToWarnOf) {
  EXPECT_FALSE(learned(0, test::Regime::kTagIso, 1).is_one_cluster);
}

}  // namespace
}  // namespace bodyschema
