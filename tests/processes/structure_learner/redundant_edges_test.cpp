#include <gtest/gtest.h>

#include <vector>

#include "processes/structure_learner/learn.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Regime;
using test::Rng;

// Four of the random trees with a joint that moves less than the noise of one sight, 25 mm and 6°:
// poses that say so are no sign of a systematic error as large.
TEST(RedundantEdges, AreNoneForAJointThatLoudNoiseHidesInOneSight) {
  for (const std::uint64_t seed : {1001, 1015, 1034, 1055}) {
    Rng rng(seed);
    const test::SyntheticRobot robot = test::random_tree({}, rng);
    const auto samples =
        test::babble(robot, 20, {.regime = Regime::kChapter, .with_covariances = true}, rng);
    EXPECT_TRUE(test::is_right(learn(robot.signals, samples).schema, robot)) << seed;
  }
}

// A planar arm of three parallel hinges, parts 1 to 4, with a part 5 that hangs from a pin at its
// end. Nothing turns that against the base, and its three joints are no less needed.
TEST(RedundantEdges, AreNoneForAPartThatHangs) {
  for (int seed = 1; seed <= 4; ++seed) {
    Rng rng(seed);
    const std::vector<Signal> signals{{"q1", -1, 1}, {"q2", -1, 1}, {"q3", -1, 1}};
    const Pose X_CB = Eigen::Translation3d(0, 0, 2) * test::random_pose(rng, 0, 0.1);
    const Noise noise = test::nominal_noise(Regime::kTagIso);
    std::vector<Pose> markers;
    for (int part = 1; part <= 5; ++part) markers.push_back(test::random_pose(rng, 0.02, 0.06));
    std::vector<ActionPoseSample> samples(60);
    for (ActionPoseSample& sample : samples) {
      sample.sample_index = &sample - samples.data();
      sample.utime = 2'000'000 * sample.sample_index;
      sample.action = Eigen::Vector3d(test::uniform(rng, -1, 1), test::uniform(rng, -1, 1),
                                      test::uniform(rng, -1, 1));
      Pose X = X_CB;
      for (int part = 1; part <= 5; ++part) {
        if (part > 2) X = X * Eigen::Translation3d(0.2, 0, 0);
        if (part > 1)
          X = X * Eigen::AngleAxisd(part < 5 ? sample.action(part - 2) : -sample.action.sum(),
                                    Eigen::Vector3d::UnitZ());
        sample.parts.push_back(test::seen_at(part, X * markers[part - 1], noise, rng));
      }
    }
    LearnOptions options;
    options.measurement.noise = noise;
    const BodySchema schema = learn(signals, samples, options).schema;
    EXPECT_TRUE(schema.complete) << seed;
    for (const Edge& edge : schema.edges)
      if (edge.to == 5) EXPECT_EQ(edge.signals().size(), 3u) << seed;
  }
}

}  // namespace
}  // namespace bodyschema
