// Arms of six joints, seen at their ends by a camera far better than their gears: each joint is off
// by a tenth of a degree and more, as often around as the gear has errors.

#include <gtest/gtest.h>

#include "common/geometry/angle.h"
#include "common/schema/standard_deviations.h"
#include "processes/structure_learner/learn.h"
#include "tests/support/random_arm.h"

namespace bodyschema {
namespace {

constexpr Noise kNoise{1e-4, 0.02 * kDegree};
constexpr int kSamples = 200;

struct Recording {
  test::SyntheticRobot robot;
  std::vector<ActionPoseSample> training, held_out;
};

Recording recorded(std::uint64_t seed, double gear_error_rad) {
  test::Rng rng(seed);
  Recording recording{.robot = test::random_arm({.num_joints = 6, .share_sliding = 0}, rng)};
  test::SyntheticRobot& robot = recording.robot;
  robot.bend = gear_error_rad;
  const std::vector<ActionPoseSample> samples =
      test::noisy_babble(robot, 2 * kSamples, kNoise, rng);
  recording.training.assign(samples.begin(), samples.begin() + kSamples);
  recording.held_out.assign(samples.begin() + kSamples, samples.end());
  return recording;
}

/// Arms that are learned right; each must tell how far it is off.
int num_right(double gear_error_rad, const std::optional<Noise>& told) {
  int result = 0;
  for (std::uint64_t seed = 1; seed <= 4; ++seed) {
    const Recording recording = recorded(seed, gear_error_rad);
    LearnOptions options;
    options.measurement.noise = told;
    const BodySchema schema = learn(recording.robot.signals, recording.training, options).schema;
    if (!test::is_right(schema, recording.robot)) continue;
    ++result;
    double squares = 0, told_squares = 0;
    for (const ActionPoseSample& sample : recording.held_out) {
      const auto predicted = schema.predict(recording.robot.links.front().part,
                                            recording.robot.links.back().part, sample.action);
      const auto truth = recording.robot.poses_in_camera(sample.action);
      const Pose X = truth.at(recording.robot.links.front().part).inverse() *
                     truth.at(recording.robot.links.back().part);
      squares += (predicted->X_AB.translation() - X.translation()).squaredNorm();
      told_squares += predicted->covariance.topLeftCorner<3, 3>().trace() +
                      noise_of_pair(X, schema.noise).head<3>().sum();
    }
    EXPECT_LT(squares, 9 * told_squares) << "seed " << seed;
  }
  return result;
}

TEST(GearErrors, OfEndsAreBentCommandsWhereTheNoiseIsTold) {
  EXPECT_EQ(num_right(0.1 * kDegree, kNoise), 4);
}

// One is refused by the noise that its bends leave at most commands, and stands by twice that.
TEST(GearErrors, OfEndsAreBentCommandsWhereTheNoiseIsNotTold) {
  EXPECT_EQ(num_right(0.2 * kDegree, std::nullopt), 4);
}

// Twice five times: straight commands are refuted at once and explained with much more.
TEST(GearErrors, OfEndsAreBentCommandsWhereTheNoiseIsToldTooLarge) {
  EXPECT_EQ(num_right(0.3 * kDegree, Noise{5 * kNoise.position_m, 2.5 * kNoise.rotation_rad}), 4);
}

}  // namespace
}  // namespace bodyschema
