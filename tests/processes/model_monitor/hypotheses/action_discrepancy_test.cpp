#include "processes/model_monitor/hypotheses/action_discrepancy.h"

#include <gtest/gtest.h>

#include <cmath>
#include <random>
#include <vector>

namespace bodyschema {
namespace {

const std::vector<Signal> kSignals{{.name = "q1", .lower = -2, .upper = 2},
                                   {.name = "q2", .lower = 0, .upper = 1}};

ActionDiscrepancy discrepancy_of(const std::vector<Eigen::Vector2d>& actions) {
  ActionDiscrepancy discrepancy;
  for (std::size_t n = 0; n < actions.size(); ++n)
    discrepancy.add(actions[n], kSignals, static_cast<std::int64_t>(10 * n));
  return discrepancy;
}

/// Anywhere in the range of both signals.
std::vector<Eigen::Vector2d> random_actions(int size, int seed) {
  std::mt19937 rng(static_cast<unsigned>(seed));
  std::uniform_real_distribution<double> anywhere(0, 1);
  std::vector<Eigen::Vector2d> actions;
  for (int n = 0; n < size; ++n) actions.emplace_back(4 * anywhere(rng) - 2, anywhere(rng));
  return actions;
}

TEST(ActionDiscrepancyTest, IsTheDistanceOfTheMeansOfTheKernel) {
  // One action before, one after, a kernel's length apart in q1 alone: ½ (k + 1), k = exp(−½).
  const double kernel = 0.5 * (std::exp(-0.5) + 1);
  const auto two = discrepancy_of({{0, 0.3}, {1.2, 0.3}});
  EXPECT_NEAR(two.since(10), 2 - 2 * kernel, 1e-12);
  EXPECT_NEAR(two.since(3), 2 - 2 * kernel, 1e-12);
  // Both of them before, and again after.
  EXPECT_NEAR(discrepancy_of({{0, 0.3}, {1.2, 0.3}, {1.2, 0.3}, {0, 0.3}}).since(20), 0, 1e-12);
  EXPECT_NEAR(discrepancy_of({{0, 0.3}, {1.2, 0.3}, {1.2, 0.3}}).since(20),
              1 + 0.25 * (2 + 2 * kernel) - (1 + kernel), 1e-12);
}

TEST(ActionDiscrepancyTest, FallsWithTheNumberOfActionsAtRandom) {
  double few = 0, many = 0;
  for (int seed = 0; seed < 20; ++seed) {
    const auto discrepancy = discrepancy_of(random_actions(100, seed));
    few += discrepancy.since(900) / 20;
    many += discrepancy.since(500) / 20;
  }
  // (1/n + 1/m)(1 − the mean kernel of two actions).
  EXPECT_NEAR(few / many, (1 / 10.0 + 1 / 90.0) / (1 / 50.0 + 1 / 50.0), 0.7);
  EXPECT_LT(many, 0.04);
  EXPECT_GT(many, 0.004);
}

TEST(ActionDiscrepancyTest, OfWhatIsRepeatedIsNoneAndOfWhatIsElsewhereMuch) {
  std::vector<Eigen::Vector2d> actions(60, Eigen::Vector2d(0.5, 0.2));
  EXPECT_NEAR(discrepancy_of(actions).since(400), 0, 1e-12);
  for (std::size_t n = 40; n < actions.size(); ++n) actions[n].x() = -2;
  EXPECT_GT(discrepancy_of(actions).since(400), 0.8);
}

TEST(ActionDiscrepancyTest, IsOneWhereNothingIsOnOneSide) {
  const auto discrepancy = discrepancy_of(random_actions(300, 1));
  EXPECT_EQ(discrepancy.since(0), 1);
  EXPECT_EQ(discrepancy.since(5000), 1);
  EXPECT_LT(discrepancy.since(2500), 0.2);  // older ones are forgotten, these are not
  EXPECT_EQ(ActionDiscrepancy().since(0), 1);
}

TEST(ActionDiscrepancyTest, ASignalOfNoRangeSaysNothing) {
  std::vector<Signal> signals = kSignals;
  signals[1].upper = signals[1].lower;
  ActionDiscrepancy discrepancy;
  for (int n = 0; n < 20; ++n) discrepancy.add(Eigen::Vector2d(1, n), signals, n);
  EXPECT_NEAR(discrepancy.since(10), 0, 1e-12);
}

}  // namespace
}  // namespace bodyschema
