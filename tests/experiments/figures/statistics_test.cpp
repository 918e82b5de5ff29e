#include "tests/experiments/figures/statistics.h"

#include <gtest/gtest.h>

#include <cmath>
#include <random>
#include <stdexcept>

namespace bodyschema::experiments {
namespace {

TEST(Spread, IsThatOfASample) {
  const Spread s = spread_of({1, 2, 3, 4});
  EXPECT_EQ(s.count, 4);
  EXPECT_DOUBLE_EQ(s.mean, 2.5);
  EXPECT_DOUBLE_EQ(s.standard_deviation, std::sqrt(5.0 / 3));
  EXPECT_DOUBLE_EQ(s.standard_error(), std::sqrt(5.0 / 12));
}

TEST(Spread, OfNothingIsNotANumber) {
  EXPECT_TRUE(std::isnan(spread_of({}).mean));
  EXPECT_EQ(spread_of({7}).standard_deviation, 0);
}

// Newcombe, Statistics in Medicine 17 (1998), table I, method 3, 81/263, 15/148, 0/20, 1/29.
TEST(WilsonBound, AgreesWithNewcombesTable) {
  EXPECT_NEAR(wilson_lower_bound(81, 263), 0.2553, 5e-5);
  EXPECT_NEAR(wilson_upper_bound(81, 263), 0.3662, 5e-5);
  EXPECT_NEAR(wilson_lower_bound(15, 148), 0.0624, 5e-5);
  EXPECT_NEAR(wilson_upper_bound(15, 148), 0.1605, 5e-5);
  EXPECT_EQ(wilson_lower_bound(0, 20), 0);
  EXPECT_NEAR(wilson_upper_bound(0, 20), 0.1611, 5e-5);
  EXPECT_NEAR(wilson_lower_bound(1, 29), 0.0061, 5e-5);
  EXPECT_NEAR(wilson_upper_bound(1, 29), 0.1718, 5e-5);
}

TEST(WilsonBound, IsBelowTheTrueShareAboutAsOftenAsItSays) {
  std::mt19937_64 rng(1);
  constexpr int kTrials = 200, kRuns = 4000;
  for (const double share : {0.5, 0.9, 0.97}) {
    std::binomial_distribution<int> binomial(kTrials, share);
    int covered = 0;
    for (int n = 0; n < kRuns; ++n) covered += wilson_lower_bound(binomial(rng), kTrials) <= share;
    // One-sided, the binomial's steps and skew leave a percent or two.
    EXPECT_NEAR(static_cast<double>(covered) / kRuns, 0.975, 0.02) << share;
  }
}

TEST(WilsonBound, RefusesWhatIsNoShare) {
  EXPECT_THROW(wilson_lower_bound(1, 0), std::invalid_argument);
  EXPECT_THROW(wilson_lower_bound(3, 2), std::invalid_argument);
  EXPECT_THROW(wilson_upper_bound(-1, 2), std::invalid_argument);
}

TEST(Numbers, HaveThreeDigitsAndAnError) {
  EXPECT_EQ(short_number(123.4), "123");
  EXPECT_EQ(short_number(1.2345), "1.23");
  EXPECT_EQ(short_number(0.012345), "0.0123");
  EXPECT_EQ(short_number(1.2e-13), "1.2e-13");
  EXPECT_EQ(short_number(0), "0");
  EXPECT_EQ(short_number(NAN), "–");
  EXPECT_EQ(percentage(199, 200), "99.5 % (≥ 97.2)");
  EXPECT_EQ(mean_and_error(spread_of({0.010, 0.014}), 1e-3), "12.0 ± 2.00");
  EXPECT_EQ(mean_and_error(spread_of({0.010}), 1e-3), "10.0");
  EXPECT_EQ(mean_and_error(spread_of({}), 1e-3), "–");
}

}  // namespace
}  // namespace bodyschema::experiments
