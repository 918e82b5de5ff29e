#include "common/estimation/chi_square.h"

#include <gtest/gtest.h>

#include <cmath>
#include <random>

namespace bodyschema {
namespace {

TEST(ChiSquare, QuantilesAreThoseOfTheTables) {
  EXPECT_NEAR(chi_square_quantile(1, 0.05), 3.8415, 1e-4);
  EXPECT_NEAR(chi_square_quantile(6, 0.01), 16.812, 1e-3);
  EXPECT_NEAR(chi_square_median(3), 2.366, 1e-3);
  EXPECT_NEAR(chi_square_median(6), 5.348, 1e-3);
  EXPECT_NEAR(kOutlierThreshold, 20.062, 1e-3);
}

TEST(ChiSquare, TheLogarithmOfTheTailGoesOnWhereTheTailUnderflows) {
  EXPECT_NEAR(log_chi_square_tail(chi_square_quantile(6, 0.01), 6), std::log(0.01), 1e-9);
  EXPECT_NEAR(log_chi_square_tail(3000, 6), -1500, 1e-9);
}

TEST(ChiSquare, MomentsBelowALimitAreThoseOfDraws) {
  std::mt19937_64 rng(1);
  std::chi_squared_distribution<double> draw(6);
  constexpr double kLimit = 9;
  double sum = 0, squares = 0, count = 0;
  for (int n = 0; n < 200000; ++n) {
    const double x = draw(rng);
    if (x > kLimit) continue;
    sum += x;
    squares += x * x;
    ++count;
  }
  const ChiSquareMoments moments = chi_square_below(kLimit, 6);
  EXPECT_NEAR(moments.mean, sum / count, 0.03);
  EXPECT_NEAR(moments.variance, squares / count - sum / count * sum / count, 0.05);
  EXPECT_NEAR(chi_square_below(1e3, 6).mean, 6, 1e-9);
  EXPECT_NEAR(chi_square_below(1e3, 6).variance, 12, 1e-9);
}

TEST(ChiSquare, ThreeResidualsAreExceededAsRarelyAsTheSixTheyAreTakenFor) {
  for (const double tail : {0.95, 0.5, 0.1, 0.0027, 1e-5})
    EXPECT_NEAR(as_of_six(chi_square_quantile(3, tail), 3), chi_square_quantile(6, tail),
                0.03 * chi_square_quantile(6, tail))
        << tail;
  EXPECT_EQ(as_of_six(7.5, 6), 7.5);
  EXPECT_GE(as_of_six(0, 3), 0);
}

TEST(ChiSquare, BinomialQuantilesRoundUp) {
  EXPECT_EQ(binomial_quantile(10, 0.5, 0.5), 5);
  EXPECT_EQ(binomial_quantile(20, 0.07, 0.995), 5);
}

}  // namespace
}  // namespace bodyschema
