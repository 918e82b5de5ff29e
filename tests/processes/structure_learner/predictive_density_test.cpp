#include "processes/structure_learner/predictive_density.h"

#include <gtest/gtest.h>

#include <Eigen/LU>
#include <cmath>

#include "common/estimation/chi_square.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Rng;

Matrix6d random_covariance(Rng& rng) {
  const Matrix6d A = Matrix6d::NullaryExpr([&] { return test::gaussian(rng); });
  return 0.1 * A * A.transpose();
}

TEST(PredictiveDensity, IsThatOfAGaussian) {
  Rng rng(1);
  const Matrix6d S = random_covariance(rng);
  const Vector6d r = test::gaussian6(rng);
  const Matrix6d C = 0.3 * Matrix6d::Identity() + S;
  const PrincipalResidual principal = principal_residual(r, S);
  EXPECT_NEAR(principal.squared_distance(0.3), r.dot(C.inverse() * r), 1e-9);
  EXPECT_NEAR(principal.log_density(0.3),
              -0.5 * (r.dot(C.inverse() * r) + std::log(C.determinant())), 1e-9);
}

TEST(PredictiveDensity, BoundsTheDistanceOfAnOutlier) {
  const PrincipalResidual far = principal_residual(Vector6d::Constant(1e6), Matrix6d::Zero());
  EXPECT_DOUBLE_EQ(far.log_density(1), -kOutlierThreshold);
}

TEST(PredictiveDensity, FindsTheNoiseBesideTheUncertaintyOfThePrediction) {
  Rng rng(2);
  for (const double noise : {0.1, 1.0, 3.0}) {
    std::vector<PrincipalResidual> residuals;
    for (int t = 0; t < 400; ++t) {
      const Matrix6d S = random_covariance(rng);
      residuals.push_back(principal_residual(
          (noise * Matrix6d::Identity() + S).llt().matrixL() * test::gaussian6(rng), S));
    }
    EXPECT_NEAR(best_noise(residuals), noise, 0.15 * noise);
  }
}

TEST(PredictiveDensity, LeavesOutliersOutOfTheNoise) {
  Rng rng(3);
  std::vector<PrincipalResidual> residuals;
  for (int t = 0; t < 500; ++t) {
    const double scale = t % 5 == 0 ? 30 : 1;
    residuals.push_back(principal_residual(scale * test::gaussian6(rng), Matrix6d::Zero()));
  }
  EXPECT_NEAR(best_noise(residuals), 1, 0.15);
}

TEST(PredictiveDensity, KeepsTheNoiseWithinItsBounds) {
  EXPECT_DOUBLE_EQ(best_noise({{Vector6d::Zero(), Vector6d::Zero()}}), kLeastNoise);
  const double most = best_noise({{Vector6d::Constant(9), Vector6d::Zero()}});
  EXPECT_LE(most, kMostNoise);
  EXPECT_GT(most, kMostNoise / 1.1);
}

}  // namespace
}  // namespace bodyschema
