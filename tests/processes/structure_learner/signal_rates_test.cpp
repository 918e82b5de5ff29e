#include "processes/structure_learner/signal_rates.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <utility>
#include <vector>

#include "processes/structure_learner/learn.h"
#include "tests/support/imperfect_robot.h"

namespace bodyschema {
namespace {

using test::ImperfectRobot;

constexpr int kJoints = 3;

/// A stream whose actions have, beside the positions, the rates, with noise of so much of them.
std::vector<ActionPoseSample> with_rates(ImperfectRobot& robot, double noise, test::Rng& rng) {
  const std::vector<ActionPoseSample> stream = robot.wander(1000, 60);
  std::vector<ActionPoseSample> samples = stream;
  for (std::size_t n = 0; n < stream.size(); ++n) {
    const ActionPoseSample& before = stream[n == 0 ? 0 : n - 1];
    const ActionPoseSample& after = stream[std::min(n + 1, stream.size() - 1)];
    const Eigen::VectorXd rate =
        1e6 * (after.action - before.action) / static_cast<double>(after.utime - before.utime);
    samples[n].action.conservativeResize(2 * kJoints);
    for (int s = 0; s < kJoints; ++s)
      samples[n].action(kJoints + s) = rate(s) * (1 + noise * test::gaussian(rng));
  }
  return samples;
}

std::vector<Signal> with_rates(std::vector<Signal> signals,
                               const std::vector<ActionPoseSample>& samples) {
  for (int s = 0; s < kJoints; ++s) {
    Signal rate{"rate of " + signals[static_cast<std::size_t>(s)].name, 0, 0};
    for (const ActionPoseSample& sample : samples) {
      rate.lower = std::min(rate.lower, sample.action(kJoints + s));
      rate.upper = std::max(rate.upper, sample.action(kJoints + s));
    }
    signals.push_back(rate);
  }
  return signals;
}

TEST(SignalRates, AreFoundBesideTheirSignals) {
  for (std::uint64_t seed = 0; seed < 10; ++seed) {
    test::Rng rng(static_cast<int>(seed));
    ImperfectRobot robot(kJoints, true, {}, seed);
    EXPECT_EQ(rates_of_others(with_rates(robot, 0.1, rng), 2 * kJoints),
              (std::vector<int>{3, 4, 5}))
        << seed;
    EXPECT_TRUE(rates_of_others(robot.wander(1000, 60), kJoints).empty()) << seed;
  }
}

// A signal that hardly varies, beside one that always goes the same way; and beside one that goes
// to and fro as it does, a quarter of a turn later.
TEST(SignalRates, AreNoneThatOnlyHaveTheSameSign) {
  std::vector<ActionPoseSample> samples(1000);
  test::Rng rng(1);
  double level = 0;
  for (std::size_t n = 0; n < samples.size(); ++n) {
    samples[n].sample_index = static_cast<std::int64_t>(n);
    samples[n].utime = 33'333 * static_cast<std::int64_t>(n);
    const double t = 0.033 * static_cast<double>(n);
    level += 0.1 * (test::gaussian(rng) - level);
    samples[n].action = Eigen::Vector3d(0.3 * t, 0.5 + 0.1 * level, std::sin(t));
  }
  EXPECT_TRUE(rates_of_others(samples, 3).empty());
  std::swap(samples[500], samples[501]);
  EXPECT_TRUE(rates_of_others(samples, 3).empty());
}

TEST(SignalRates, AreFoundAroundGaps) {
  test::Rng rng(2);
  ImperfectRobot robot(kJoints, true, {}, 2);
  std::vector<ActionPoseSample> samples = with_rates(robot, 0, rng);
  for (std::size_t n = 300; n < samples.size(); ++n) samples[n].utime += 100'000'000;
  samples.erase(samples.begin() + 600, samples.begin() + 700);
  EXPECT_EQ(rates_of_others(samples, 2 * kJoints), (std::vector<int>{3, 4, 5}));
}

TEST(SignalRates, AreNoneOfPosesAtRest) {
  ImperfectRobot robot(kJoints, true, {}, 1);
  EXPECT_TRUE(rates_of_others(robot.babble(200), kJoints).empty());
  EXPECT_TRUE(rates_of_others({}, 0).empty());
  EXPECT_TRUE(rates_of_others(robot.babble(1), kJoints).empty());
}

// Poses that come late: θ(t − τ) ≈ θ − τ dθ/dt looks like a joint of a signal and its rate.
TEST(SignalRates, AreInNoStructure) {
  for (std::uint64_t seed = 0; seed < 2; ++seed) {
    test::Rng rng(static_cast<int>(seed));
    ImperfectRobot robot(kJoints, true, {.lag = 4}, seed);
    const auto samples = with_rates(robot, 0.02, rng);
    const BodySchema schema = learn(with_rates(robot.signals(), samples), samples).schema;
    EXPECT_EQ(judge(schema, robot.structure()), test::Rightness::kRight) << seed;
    EXPECT_TRUE(schema.undecided_signals.empty()) << seed;
  }
}

}  // namespace
}  // namespace bodyschema
