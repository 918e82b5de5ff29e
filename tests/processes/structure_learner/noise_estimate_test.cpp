#include "processes/structure_learner/noise_estimate.h"

#include <gtest/gtest.h>

#include <cmath>
#include <functional>

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

// As trackers tell poses: in the frame of one body, whose own is always the identity.
void give_in_frame_of_first(std::vector<ActionPoseSample>* samples) {
  for (ActionPoseSample& sample : *samples) {
    const Pose X_1C = sample.parts.front().X_CB.inverse();
    for (PartObservation& o : sample.parts) o.X_CB = X_1C * o.X_CB;
    sample.parts.front().X_CB = Pose::Identity();
  }
}

TEST(NoiseEstimate, APartThatDefinesTheFrameHasNoNoiseToTell) {
  Rng rng(2);
  const auto robot = test::chapter_robot("a", rng);
  auto samples = test::babble(robot, 10, {Regime::kTagIso}, rng);
  const Eigen::VectorXd action = robot.random_action(rng);
  for (int n = 0; n < 10; ++n)
    samples.push_back(test::observe(robot, action, {Regime::kTagIso}, 10 + n, rng));
  for (ActionPoseSample& sample : samples)
    std::erase_if(sample.parts, [&](const PartObservation& o) {
      return o.part != sample.parts.front().part && o.part != sample.parts.back().part;
    });
  give_in_frame_of_first(&samples);
  const auto noise = estimate_noise(samples, 2);
  ASSERT_TRUE(noise);
  EXPECT_EQ(noise->source, NoiseSource::kRepeats);
  EXPECT_GT(noise->rotation_rad, 1.2 * kDegree);  // that of two markers
  EXPECT_LT(noise->rotation_rad, 2.5 * kDegree);
}

TEST(NoiseEstimate, OfExactDataIsTheFloor) {
  Rng rng(3);
  const auto robot = test::chapter_robot("co", rng);
  const auto noise = estimate_noise(test::babble(robot, 10, {}, rng), 4);
  ASSERT_TRUE(noise);
  EXPECT_EQ(noise->position_m, kNoiseFloor.position_m);
  EXPECT_EQ(noise->rotation_rad, kNoiseFloor.rotation_rad);
}

// A door at 30 Hz that turns with `angle`: 0.1 mm and 0.03° of white noise, and slow errors of
// about 1 mm and 0.2° an axis, as optical trackers have them.
std::vector<ActionPoseSample> door_in_a_stream(const std::function<double(double)>& angle) {
  constexpr int kInstants = 900;
  constexpr double kWhite_m = 1e-4, kWhite_rad = 5e-4, kSlow_m = 1.4e-3, kSlow_rad = 5e-3;
  Rng rng(4);
  std::vector<ActionPoseSample> samples;
  for (int t = 0; t < kInstants; ++t) {
    const double s = t / 30.0, q = 0.7 * std::sin(0.7 * s);
    ActionPoseSample& sample = samples.emplace_back();
    sample.utime = std::llround(1e6 * s);
    sample.sample_index = t;
    sample.action = Eigen::VectorXd::Constant(1, q);
    for (int part = 0; part < 2; ++part) {
      Vector6d error;
      for (int c = 0; c < 6; ++c)
        error(c) = (c < 3 ? kSlow_m : kSlow_rad) * std::sin((1.3 + 0.37 * (6 * part + c)) * s + c) +
                   (c < 3 ? kWhite_m : kWhite_rad) * test::gaussian(rng);
      Vector6d turn = Vector6d::Zero();
      turn(5) = part * angle(s);
      const Pose at(Eigen::Translation3d(0.3 * part, 0, 1.5));
      PartObservation& seen = sample.parts.emplace_back();
      seen.part = part;
      seen.X_CB = at * exp(turn) * Eigen::Translation3d(0.2 * part, 0, 0) * exp(error);
    }
  }
  return samples;
}

TEST(NoiseEstimate, OfAStreamTheJitterIsALowerBoundAndNoMore) {
  const auto noise =
      estimate_noise(door_in_a_stream([](double s) { return 0.7 * std::sin(0.7 * s); }), 1);
  ASSERT_TRUE(noise);
  EXPECT_EQ(noise->source, NoiseSource::kResiduals);
  EXPECT_GT(noise->position_m, 0.7e-3);
  EXPECT_LT(noise->position_m, 3e-3);
  EXPECT_GT(noise->rotation_rad, 0.15 * kDegree);
  EXPECT_LT(noise->rotation_rad, 0.6 * kDegree);
}

TEST(NoiseEstimate, OfAStreamMotionThatNoModelExplainsIsNoNoise) {
  const auto noise =
      estimate_noise(door_in_a_stream([](double s) { return 0.5 * std::sin(1.9 * s); }), 1);
  ASSERT_TRUE(noise);
  EXPECT_EQ(noise->source, NoiseSource::kFrames);
  EXPECT_LT(noise->position_m, 0.6e-3);
  EXPECT_LT(noise->rotation_rad, 0.2 * kDegree);
}

TEST(NoiseEstimate, OfAStreamThePartThatDefinesTheFrameHasNoJitter) {
  auto samples = door_in_a_stream([](double s) { return 0.5 * std::sin(1.9 * s); });
  give_in_frame_of_first(&samples);
  const auto noise = estimate_noise(samples, 1);
  ASSERT_TRUE(noise);
  EXPECT_EQ(noise->source, NoiseSource::kFrames);
  EXPECT_GT(noise->position_m, 0.3e-3);  // 4 × that of white noise
  EXPECT_LT(noise->position_m, 2e-3);
}

TEST(NoiseEstimate, NeedsTwoParts) { EXPECT_FALSE(estimate_noise({}, 2)); }

}  // namespace
}  // namespace bodyschema
