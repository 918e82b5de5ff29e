#include "processes/structure_learner/noise_estimate.h"

#include <gtest/gtest.h>

#include "common/geometry/angle.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Regime;
using test::Rng;

TEST(NoiseEstimate, FromScrewModelsIsSlightlyAboveTheTruth) {
  for (const Regime regime : {Regime::kChapter, Regime::kTagIso}) {
    for (const char* name : {"a", "co", "d"}) {
      Rng rng(1);
      const auto robot = test::chapter_robot(name, rng);
      const auto samples = test::babble(robot, 40, {regime}, rng);
      const auto noise = estimate_noise(samples, static_cast<int>(robot.signals.size()));
      ASSERT_TRUE(noise);
      const Noise truth = test::nominal_noise(regime);
      EXPECT_GT(noise->position_m, 0.9 * truth.position_m) << name;
      EXPECT_LT(noise->position_m, 1.6 * truth.position_m) << name;
      EXPECT_GT(noise->rotation_rad, 0.9 * truth.rotation_rad) << name;
      EXPECT_LT(noise->rotation_rad, 1.6 * truth.rotation_rad) << name;
    }
  }
}

TEST(NoiseEstimate, RepeatsAtOnePoseDecideWhereThereAreAny) {
  Rng rng(2);
  const auto robot = test::chapter_robot("c", rng);
  auto samples = test::babble(robot, 10, {Regime::kTagIso}, rng);
  const Eigen::VectorXd action = robot.random_action(rng);
  for (int n = 0; n < 10; ++n)
    samples.push_back(test::observe(robot, action, {Regime::kTagIso}, 10 + n, rng));
  const auto noise = estimate_noise(samples, 4);
  ASSERT_TRUE(noise);
  EXPECT_NEAR(noise->position_m, 1.2 * 0.003, 0.001);
  EXPECT_NEAR(noise->rotation_rad, 1.2 * kDegree, 0.005);
}

TEST(NoiseEstimate, OfExactDataIsTheFloor) {
  Rng rng(3);
  const auto robot = test::chapter_robot("co", rng);
  const auto noise = estimate_noise(test::babble(robot, 10, {}, rng), 4);
  ASSERT_TRUE(noise);
  EXPECT_EQ(noise->position_m, kNoiseFloor.position_m);
  EXPECT_EQ(noise->rotation_rad, kNoiseFloor.rotation_rad);
}

TEST(NoiseEstimate, NeedsTwoParts) { EXPECT_FALSE(estimate_noise({}, 2)); }

}  // namespace
}  // namespace bodyschema
