#include "processes/structure_learner/residual_fitter.h"

#include <gtest/gtest.h>

#include <cmath>
#include <numeric>
#include <vector>

#include "processes/structure_learner/screen.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

constexpr int kNumSignals = 6;
constexpr Noise kNoise{3e-4, 0.005};

// Part 1 at the origin and part 2 at exp(bend), as they are seen.
void add_parts(const Vector6d& bend, test::Rng& rng, ActionPoseSample* sample) {
  for (int part = 1; part <= 2; ++part) {
    Vector6d noise = test::gaussian6(rng);
    noise.head<3>() *= kNoise.position_m;
    noise.tail<3>() *= kNoise.rotation_rad;
    sample->parts.push_back({.part = part});
    sample->parts.back().X_CB = (part == 1 ? Pose::Identity() : exp(bend)) * exp(noise);
  }
}

// Part 1 at the origin, part 2 where signals 0 and 1 bend a segment to; four signals do nothing.
std::vector<ActionPoseSample> bent_segment(unsigned seed) {
  test::Rng rng(seed);
  std::vector<ActionPoseSample> samples(200);
  for (int t = 0; t < 200; ++t) {
    ActionPoseSample& sample = samples[t];
    sample.sample_index = t;
    sample.utime = 2'000'000 * std::int64_t{t};
    sample.action.resize(kNumSignals);
    for (double& q : sample.action) q = test::uniform(rng, -1, 1);
    const double u = sample.action(0), v = sample.action(1);
    Vector6d bend;
    bend << 0.1 * std::sin(2 * u), 0.1 * std::sin(2 * v), 0.1 * std::cos(u * v), -v, u, 0;
    add_parts(bend, rng, &sample);
  }
  return samples;
}

// Samples chosen anew spread over the fewer signals: what that makes of a gain has twice the error.
TEST(ResidualFitter, ASignalWithoutEffectGainsNothing) {
  for (unsigned seed = 1; seed <= 8; ++seed) {
    const auto samples = bent_segment(seed);
    const NormalizedActions actions(samples, kNumSignals);
    const PairData pair = make_pair_data(samples, 1, 2, {.noise = kNoise}, 600);
    const LocalModel rigid = screen_rigid(pair, actions).model;
    ResidualFitter all(rigid, pair, actions);
    std::vector<int> signals(kNumSignals);
    std::iota(signals.begin(), signals.end(), 0);
    ASSERT_TRUE(all.fit(signals, nullptr, 15));
    all.reweigh();
    const ResidualFitter::Shape shape = all.shape();
    ASSERT_TRUE(all.fit(signals, &shape, 15));
    for (int place = 0; place < kNumSignals; ++place) {
      const bool has_effect = place < 2;
      EXPECT_EQ(all.is_straight(place), !has_effect) << place << ", seed " << seed;
      const ResidualFitter fewer = all.without(place, 8);
      const ResidualFitter::Gain gain = all.gain_over(fewer);
      if (has_effect) {
        EXPECT_GT(gain.sum, 1000);
        continue;
      }
      EXPECT_LT(gain.sum, 0);
      ResidualFitter anew = fewer;
      ASSERT_TRUE(anew.fit(fewer.signals(), &fewer.shape(), 8));
      EXPECT_LT(1.2 * gain.error, all.gain_over(anew).error) << place << ", seed " << seed;
    }
  }
}

// Height of part 2 over part 1 where a process has it, in the first two of 80 poses. There u is
// 0.97 and 1 (else below 0.9, or 1 in half of the poses if it `often_ends`), and the part `lift`
// higher.
std::vector<double> heights_at_end(double lift, bool often_ends) {
  test::Rng rng(1);
  std::vector<ActionPoseSample> samples(80);
  for (int t = 0; t < 80; ++t) {
    ActionPoseSample& sample = samples[t];
    sample.sample_index = t;
    sample.utime = 2'000'000 * std::int64_t{t};
    const bool is_at_end = t < 2 || (often_ends && t % 2 == 0);
    const double u = often_ends && is_at_end ? 1
                     : is_at_end             ? 0.97 + 0.03 * t
                                             : test::uniform(rng, -1, 0.9);
    sample.action = Eigen::Vector2d(u, test::uniform(rng, -1, 1));
    Vector6d bend;
    bend << 0.01 * std::sin(2 * u), 0, t < 2 ? lift * (u - 0.9) / 0.1 : 0, 0, 0.1 * u, 0;
    add_parts(bend, rng, &sample);
  }
  const NormalizedActions actions(samples, 2);
  const PairData pair = make_pair_data(samples, 1, 2, {.noise = kNoise}, 600);
  const LocalModel rigid = screen_rigid(pair, actions).model;
  ResidualFitter fitter(rigid, pair, actions);
  EXPECT_TRUE(fitter.fit({0, 1}, nullptr, 15));
  const bool is_too_straight = fitter.reweigh();
  const ResidualFitter::Shape shape = fitter.shape();
  EXPECT_TRUE(fitter.fit({0, 1}, is_too_straight ? nullptr : &shape, 15));
  const auto process = fitter.residual_gp();
  std::vector<double> result;
  for (int t = 0; t < 2; ++t) {
    const Pose X = rigid.predict(actions, t) * exp(process->mean(samples[t].action));
    result.push_back(X.translation().z());
  }
  return result;
}

// To a process that the others make straight what rises steeply at an end looks wild.
TEST(ResidualFitter, BendsForOutliersInARowAtAnEnd) {
  const std::vector<double> heights = heights_at_end(0.015, false);
  EXPECT_NEAR(heights[0], 0.7 * 0.015, 0.004);
  EXPECT_NEAR(heights[1], 0.015, 0.004);
}

TEST(ResidualFitter, LeavesOutWhatIsWildAtAnEnd) {
  for (const double z : heights_at_end(0.2, false)) EXPECT_LT(z, 0.02);
}

TEST(ResidualFitter, LeavesOutWhatIsWildWhereASignalOftenIs) {
  for (const double z : heights_at_end(0.015, true)) EXPECT_LT(z, 0.001);
}

}  // namespace
}  // namespace bodyschema
