#include "processes/structure_learner/serial_correlation.h"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

TEST(SerialCorrelation, IsThatOfTheNoiseAndOfWhiteNoiseNone) {
  for (const double rho : {0.0, 0.5, 0.9}) {
    test::Rng rng(1);
    SerialCorrelation series, other;
    FrameFit before, now;
    for (int n = 0; n < 2000; ++n) {
      now.residual = rho * before.residual + std::sqrt(1 - rho * rho) * test::gaussian6(rng);
      now.squared_distance = now.residual.squaredNorm();
      if (n > 0) (n < 1000 ? series : other).add(before, now);
      before = now;
    }
    series.add(other);
    EXPECT_NEAR(series.coefficient(2000), rho, 0.07);
  }
}

// Of a frame that was told the rounding is left, always the same.
TEST(SerialCorrelation, AnAxisInWhichNothingIsLeftSaysNothing) {
  test::Rng rng(1);
  SerialCorrelation series;
  FrameFit before, now;
  for (int n = 0; n < 100; ++n) {
    now.residual = test::gaussian6(rng);
    now.residual(4) = 1e-9;
    now.squared_distance = now.residual.squaredNorm();
    if (n > 0) series.add(before, now);
    before = now;
  }
  EXPECT_EQ(series.coefficient(100), 0);
}

TEST(CorrelationTime, IsThatOfTheScores) {
  test::Rng rng(1);
  constexpr Eigen::Index kNum = 20'000;
  const auto time_of = [](const Eigen::MatrixXd& scores) {
    return correlation_time(scores, Eigen::MatrixXd::Identity(scores.rows(), scores.rows()));
  };
  for (const double kept : {0.0, 0.5, 0.9}) {
    Eigen::MatrixXd scores(3, kNum), halves = Eigen::MatrixXd::Zero(6, 2 * kNum);
    Eigen::Vector3d last = Eigen::Vector3d::Zero();
    for (Eigen::Index n = 0; n < kNum; ++n) {
      last = kept * last + std::sqrt(1 - kept * kept) * test::gaussian6(rng).head<3>();
      scores.col(n) = last;
      halves.col(2 * n).head<3>() = last;
    }
    EXPECT_NEAR(time_of(scores), (1 + kept) / (1 - kept), 0.2 * (1 + kept) / (1 - kept)) << kept;
    // Parts that are seen in turn.
    EXPECT_NEAR(time_of(halves), time_of(scores), 0.2 * time_of(scores)) << kept;
  }
  EXPECT_EQ(time_of(Eigen::MatrixXd(3, 0)), 1);
  EXPECT_EQ(time_of(Eigen::MatrixXd::Ones(3, 1)), 1);
  EXPECT_EQ(time_of(Eigen::MatrixXd::Zero(3, 10)), 1);
}

TEST(SerialCorrelation, WhatLastsAsLongAsTheNoiseIsExplainedByItTheMost) {
  std::vector<double> fast, slow;
  std::vector<int> samples;
  for (int n = 0; n < 400; ++n) {
    samples.push_back(n);
    fast.push_back(n % 2);
    slow.push_back(n / 50 % 2);
  }
  EXPECT_EQ(variance_inflation(slow, samples, 0), 1);
  EXPECT_LT(variance_inflation(fast, samples, 0.9), 2);
  EXPECT_GT(variance_inflation(slow, samples, 0.9), 10);
  EXPECT_LT(variance_inflation(slow, samples, 0.5), variance_inflation(slow, samples, 0.9));
}

}  // namespace
}  // namespace bodyschema
