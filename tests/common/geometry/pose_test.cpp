#include "common/geometry/pose.h"

#include <gtest/gtest.h>

#include <limits>

#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Rng;

// A tangent vector with rotation of the given angle.
Vector6d random_tangent(Rng& rng, double angle) {
  Vector6d xi = test::gaussian6(rng);
  xi.tail<3>() *= angle / xi.tail<3>().norm();
  return xi;
}

const double kAngles[] = {0,      1e-12,  1e-6, 1e-3, 0.0099, 0.0101,
                          0.0999, 0.1001, 1,    2,    3,      M_PI - 1e-6};

TEST(Pose, LogOfExpIsTheTangentVector) {
  Rng rng(1);
  for (const double angle : kAngles) {
    for (int n = 0; n < 50; ++n) {
      const Vector6d xi = random_tangent(rng, angle);
      EXPECT_LT((log(exp(xi)) - xi).norm(), 1e-9) << angle;
    }
  }
}

TEST(Pose, ExpOfLogIsThePose) {
  Rng rng(2);
  for (int n = 0; n < 500; ++n) {
    const Pose X = test::random_pose(rng, 0, 2);
    EXPECT_TRUE(exp(log(X)).isApprox(X, 1e-12));
  }
  Pose half_turn = Pose::Identity();
  half_turn.linear() = Eigen::Vector3d(-1, 1, -1).asDiagonal();
  EXPECT_TRUE(exp(log(half_turn)).isApprox(half_turn, 1e-12));
  EXPECT_NEAR(rotation_angle(half_turn), M_PI, 1e-12);
}

TEST(Pose, AdjointMovesATangentVectorToTheOtherSide) {
  Rng rng(3);
  for (int n = 0; n < 100; ++n) {
    const Pose X = test::random_pose(rng, 0, 2);
    const Vector6d xi = random_tangent(rng, 1);
    EXPECT_TRUE((X * exp(xi) * X.inverse()).isApprox(exp(adjoint(X) * xi), 1e-12));
  }
}

TEST(Pose, LittleAdjointIsTheDerivativeOfTheAdjoint) {
  Rng rng(4);
  const Vector6d xi = random_tangent(rng, 1);
  const double h = 1e-6;
  const Matrix6d numeric = (adjoint(exp(h * xi)) - adjoint(exp(-h * xi))) / (2 * h);
  EXPECT_LT((numeric - little_adjoint(xi)).norm(), 1e-8);
}

TEST(Pose, RotationOfZIsTheShortestThatTakesItThere) {
  Rng rng(5);
  for (int n = 0; n < 50; ++n) {
    const Eigen::Vector3d to = test::gaussian6(rng).head<3>();
    const Eigen::Matrix3d R = rotation_of_z_to(to);
    EXPECT_LT((R.col(2) - to.normalized()).norm(), 1e-12);
    EXPECT_LT(std::abs(log_so3(R).z()), 1e-9);  // about an axis across z
  }
  EXPECT_LT((rotation_of_z_to({0, 0, -2}).col(2) - Eigen::Vector3d(0, 0, -1)).norm(), 1e-12);
}

TEST(Pose, SquaredMahalanobisCountsInStandardDeviationsAlongTheCovariancesAxes) {
  const Vector6d sd(0.1, 0.2, 0.3, 1, 2, 3), x(0.1, 0.4, 0, 0, -4, 9);
  const Matrix6d uncorrelated = sd.cwiseAbs2().asDiagonal();
  EXPECT_NEAR(squared_mahalanobis(x, uncorrelated), 1 + 4 + 4 + 9, 1e-12);
  Rng rng(6);
  Matrix6d M;
  for (int c = 0; c < 6; ++c) M.col(c) = test::gaussian6(rng);
  // The same in other coordinates.
  EXPECT_NEAR(squared_mahalanobis(M * x, M * uncorrelated * M.transpose()), 18, 1e-6);
}

TEST(Pose, RightJacobianInverseAgreesWithCentralDifferences) {
  Rng rng(5);
  const double h = 1e-6;
  for (const double angle : {0.0, 1e-6, 1e-3, 0.0099, 0.0101, 0.0999, 0.1001, 1.0, 2.0, 3.0}) {
    const Vector6d xi = random_tangent(rng, angle);
    const Matrix6d J = right_jacobian_inverse(xi);
    for (int k = 0; k < 6; ++k) {
      const Vector6d step = h * Vector6d::Unit(k);
      const Vector6d numeric = (log(exp(xi) * exp(step)) - log(exp(xi) * exp(-step))) / (2 * h);
      EXPECT_LT((numeric - J.col(k)).norm(), 1e-7) << "angle " << angle << " column " << k;
    }
  }
}

TEST(Pose, RelativeCovarianceAgreesWithSampledNoise) {
  Rng rng(6);
  const Pose X_i = test::random_pose(rng, 0, 1), X_j = test::random_pose(rng, 0, 1);
  const Pose z = X_i.inverse() * X_j;
  Vector6d sigma_i, sigma_j;
  sigma_i << 1e-3, 2e-3, 3e-3, 0.01, 0.02, 0.005;
  sigma_j << 2e-3, 1e-3, 1e-3, 0.004, 0.01, 0.01;
  const Matrix6d covariance =
      relative_covariance(z, Matrix6d(sigma_i.array().square().matrix().asDiagonal()),
                          Matrix6d(sigma_j.array().square().matrix().asDiagonal()));
  Matrix6d sampled = Matrix6d::Zero();
  const int num_samples = 20000;
  for (int n = 0; n < num_samples; ++n) {
    const Pose y_i = X_i * exp(sigma_i.cwiseProduct(test::gaussian6(rng)));
    const Pose y_j = X_j * exp(sigma_j.cwiseProduct(test::gaussian6(rng)));
    const Vector6d e = log(z.inverse() * (y_i.inverse() * y_j));
    sampled += e * e.transpose() / num_samples;
  }
  const Vector6d scale = covariance.diagonal().cwiseSqrt().cwiseInverse();
  EXPECT_LT(
      (scale.asDiagonal() * (sampled - covariance) * scale.asDiagonal()).cwiseAbs().maxCoeff(),
      0.05);
}

TEST(Pose, NearestRotationRepairsAndRotationFromRefuses) {
  Rng rng(7);
  const Eigen::Matrix3d R = test::random_rotation(rng);
  EXPECT_TRUE(nearest_rotation(1.3 * R).isApprox(R, 1e-12));
  EXPECT_NEAR(nearest_rotation(-R).determinant(), 1, 1e-12);
  EXPECT_TRUE(rotation_from(R).isApprox(R));
  EXPECT_THROW(rotation_from(1.001 * R), std::invalid_argument);
  EXPECT_THROW(rotation_from(-R), std::invalid_argument);
  EXPECT_THROW(nearest_rotation(Eigen::Matrix3d::Zero()), std::invalid_argument);
  EXPECT_THROW(nearest_rotation(std::numeric_limits<double>::quiet_NaN() * R),
               std::invalid_argument);
}

TEST(Pose, MakePoseNormalisesTheQuaternion) {
  const Pose X = make_pose(Eigen::Quaterniond(2, 0, 0, 2), {1, 2, 3});
  EXPECT_NEAR(rotation_angle(X), M_PI / 2, 1e-12);
  EXPECT_EQ(X.translation(), Eigen::Vector3d(1, 2, 3));
}

}  // namespace
}  // namespace bodyschema
