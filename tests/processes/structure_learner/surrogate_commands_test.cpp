#include "processes/structure_learner/surrogate_commands.h"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

constexpr Noise kNoise{1e-3, 0.005};
constexpr int kPeriod = 600;  // frames

// 60 s at 30 Hz: signal 0 goes to and fro all the time, signal 1 moves part 2 in the first 2.2 s of
// each 20 s and rests else. What moved the part came `late` frames after the command.
std::vector<ActionPoseSample> stream_of_a_resting_joint(int late) {
  test::Rng rng(1);
  const auto command = [](int t) {
    const int phase = (t + kPeriod) % kPeriod;
    return phase < 66 ? std::pow(std::sin(M_PI * phase / 66.0), 2) : 0.0;
  };
  std::vector<ActionPoseSample> samples(3 * kPeriod);
  for (int t = 0; t < 3 * kPeriod; ++t) {
    ActionPoseSample& sample = samples[static_cast<std::size_t>(t)];
    sample.sample_index = t;
    sample.utime = 33'333 * std::int64_t{t};
    sample.action = Eigen::Vector2d(std::sin(0.011 * t), command(t));
    Vector6d turn = Vector6d::Zero();
    turn(5) = 0.8 * command(t - late);
    for (int part = 1; part <= 2; ++part) {
      sample.parts.push_back({.part = part});
      Vector6d noise = test::gaussian6(rng);
      noise.head<3>() *= kNoise.position_m;
      noise.tail<3>() *= kNoise.rotation_rad;
      sample.parts.back().X_CB = (part == 1 ? Pose::Identity() : exp(turn)) * exp(noise);
    }
  }
  return samples;
}

bool is_by_chance(const std::vector<ActionPoseSample>& samples) {
  AcceptedModel hinge{.part_i = 1, .part_j = 2, .model = {}};
  hinge.model.joints.push_back({.signal = 1, .turn = 0.4});
  return SurrogateCommands(samples, 2, {.noise = kNoise}).explain_as_well(hinge);
}

// While it rests every command explains it, and a period later it moves again.
TEST(SurrogateCommands, OfAJointThatMostlyRestsItsMotionTells) {
  EXPECT_FALSE(is_by_chance(stream_of_a_resting_joint(0)));
}

TEST(SurrogateCommands, CommandsOfAnotherTimeAreByChance) {
  EXPECT_TRUE(is_by_chance(stream_of_a_resting_joint(200)));
}

}  // namespace
}  // namespace bodyschema
