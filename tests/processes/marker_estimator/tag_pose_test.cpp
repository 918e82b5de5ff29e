#include "processes/marker_estimator/tag_pose.h"

#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <random>

#include "common/geometry/angle.h"
#include "tests/support/tag_image.h"

namespace bodyschema {
namespace {

constexpr double kSize_m = 0.08;

std::vector<ImagePoint> view(const Pose& X_CM, double sigma_px, std::mt19937& random) {
  const Lens lens(pinhole_camera());
  std::normal_distribution<double> noise(0, 1);
  std::vector<ImagePoint> points;
  for (const Eigen::Vector3d& p_MP : tag_corners(kSize_m)) {
    const Eigen::Vector3d p_C = X_CM * p_MP;
    const Eigen::Vector2d p_px = lens.project(p_C.head<2>() / p_C.z());
    points.push_back(
        *lens.straighten(p_px + sigma_px * Eigen::Vector2d(noise(random), noise(random))));
    points.back().sigma_px = std::max(sigma_px, 1e-6);
  }
  return points;
}

TEST(ReprojectionResidual, HasTheJacobianThatCentralDifferencesGive) {
  std::mt19937 random(1);
  const Pose X_CM = marker_pose(0.8, 0.6, 1.0, 2.0, 0.2, -0.1);
  const auto points = view(X_CM, 0.3, random);
  Eigen::Matrix<double, Eigen::Dynamic, 6> J;
  ASSERT_TRUE(reprojection_residual(X_CM, tag_corners(kSize_m), points, &J));
  for (int i = 0; i < 6; ++i) {
    const Vector6d step = 1e-6 * Vector6d::Unit(i);
    const auto plus =
        reprojection_residual(X_CM * exp(step), tag_corners(kSize_m), points, nullptr);
    const auto minus =
        reprojection_residual(X_CM * exp(-step), tag_corners(kSize_m), points, nullptr);
    EXPECT_LT((J.col(i) - (*plus - *minus) / 2e-6).norm(), 1e-5 * J.col(i).norm());
  }
}

TEST(SolveTagPose, FindsTheExactPoseOfExactCornersAmongItsHypotheses) {
  std::mt19937 random(2);
  for (const double tilt_deg : {0.0, 2.0, 10.0, 30.0, 50.0, 75.0}) {
    for (const double distance_m : {0.4, 1.0, 2.0}) {
      for (int spin = 0; spin < 4; ++spin) {
        const Pose X_CM = marker_pose(distance_m, tilt_deg * kDegree, spin, 1.7 * spin, 0.2, 0.1);
        const auto minima = solve_tag_pose(kSize_m, view(X_CM, 0, random));
        ASSERT_FALSE(minima.empty());
        EXPECT_LT(log(X_CM.inverse() * minima[0].X_CB).norm(), 1e-5)
            << tilt_deg << " deg, " << distance_m << " m";
      }
    }
  }
}

TEST(SolveTagPose, OfCorrelatedCornersHasATrueCovarianceIfTheyAreWhitened) {
  std::mt19937 random(5);
  std::normal_distribution<double> normal(0, 1);
  const Lens lens(pinhole_camera());
  const Pose X_CM = marker_pose(0.6, 0.7, 0.5, 1.2, 0.1, 0);
  // Two sides displaced as by a reflection, the two corners of each alike, and little else.
  Eigen::MatrixXd S = 0.03 * 0.03 * Eigen::MatrixXd::Identity(8, 8);
  for (const auto& [a, b] : {std::pair{0, 2}, {1, 3}, {4, 7}})
    for (const int i : {a, b})
      for (const int j : {a, b}) S(i, j) += 0.2 * 0.2;
  constexpr double kSigma_px = 0.1;
  const Eigen::LLT<Eigen::MatrixXd> root(S / (kSigma_px * kSigma_px));
  const Eigen::MatrixXd whitener = root.matrixL().solve(Eigen::MatrixXd::Identity(8, 8));
  constexpr int kNum = 400;
  double whitened = 0, plain = 0;
  for (int n = 0; n < kNum; ++n) {
    Eigen::VectorXd z(8);
    for (double& x : z) x = normal(random);
    const Eigen::VectorXd correlated = root.matrixL() * z;
    const Eigen::VectorXd error_px = kSigma_px * correlated;
    std::vector<ImagePoint> points;
    for (const Eigen::Vector3d& p_MP : tag_corners(kSize_m)) {
      const Eigen::Vector3d p_C = X_CM * p_MP;
      const auto k = static_cast<Eigen::Index>(points.size());
      points.push_back(
          *lens.straighten(lens.project(p_C.head<2>() / p_C.z()) + error_px.segment<2>(2 * k)));
      points.back().sigma_px = kSigma_px;
    }
    const auto d2 = [&](const std::vector<PoseFit>& minima) {
      const Vector6d e = log(minima[0].X_CB.inverse() * X_CM);
      return e.dot(minima[0].information * e) / kNum;
    };
    whitened += d2(solve_tag_pose(kSize_m, points, &whitener));
    plain += d2(solve_tag_pose(kSize_m, points));
    if (n > 0) continue;
    const Eigen::MatrixXd none = Eigen::MatrixXd::Identity(8, 8);
    EXPECT_EQ(solve_tag_pose(kSize_m, points, &none)[0].X_CB.matrix(),
              solve_tag_pose(kSize_m, points)[0].X_CB.matrix());
  }
  EXPECT_NEAR(whitened, 6, 0.7);  // χ²₆, four standard deviations of the mean
  EXPECT_GT(std::abs(plain - 6), 2);
}

TEST(SolveTagPose, GivesLocalMinimaInAscendingOrder) {
  std::mt19937 random(3);
  for (int i = 0; i < 200; ++i) {
    const Pose X_CM = marker_pose(1.5, 0.3 * i / 100, i, 2 * i);
    const auto points = view(X_CM, 0.2, random);
    const auto minima = solve_tag_pose(kSize_m, points);
    ASSERT_FALSE(minima.empty());
    for (const PoseFit& minimum : minima) {
      Eigen::Matrix<double, Eigen::Dynamic, 6> J;
      const auto r = reprojection_residual(minimum.X_CB, tag_corners(kSize_m), points, &J);
      const Vector6d newton = (J.transpose() * J).ldlt().solve(J.transpose() * *r);
      EXPECT_LT(newton.norm(), 1e-5);
    }
    EXPECT_LE(minima.front().rms_sigma, minima.back().rms_sigma);
  }
}

TEST(SolveTagPose, KeepsTheTruePoseAmongItsHypothesesWhereTheLikelierOneIsFlipped) {
  // 8 cm at 2 m: a view of 46 px, the regime in which the wrong tilt often looks better.
  std::mt19937 random(4);
  for (const double tilt_deg : {10.0, 20.0, 30.0}) {
    int flipped = 0, lost = 0;
    constexpr int kViews = 300;
    for (int i = 0; i < kViews; ++i) {
      const Pose X_CM = marker_pose(2.0, tilt_deg * kDegree, 0.7 * i, 0.3 * i);
      const auto minima = solve_tag_pose(kSize_m, view(X_CM, 0.3, random));
      ASSERT_FALSE(minima.empty());
      const auto angle = [&](const PoseFit& m) { return rotation_angle(X_CM.inverse() * m.X_CB); };
      const double limit = tilt_deg * kDegree;
      const bool is_first_wrong = angle(minima[0]) > limit;
      flipped += is_first_wrong;
      lost += is_first_wrong && (minima.size() < 2 || angle(minima[1]) > limit);
    }
    RecordProperty("flips_at_" + std::to_string(static_cast<int>(tilt_deg)), flipped);
    EXPECT_LT(lost, kViews / 20) << tilt_deg;
    EXPECT_GT(flipped, 0) << tilt_deg;
  }
}

TEST(SolveTagPose, HasACovarianceThatIsConsistentWithGaussianCornerNoise) {
  std::mt19937 random(5);
  constexpr double kSigma_px = 0.1;
  for (const double tilt_deg : {30.0, 45.0, 60.0}) {
    double sum = 0;
    constexpr int kViews = 500;
    for (int i = 0; i < kViews; ++i) {
      const Pose X_CM = marker_pose(0.8, tilt_deg * kDegree, i, 2 * i, 0.1, 0.1);
      const auto minima = solve_tag_pose(kSize_m, view(X_CM, kSigma_px, random));
      const auto covariance = covariance_from(minima.at(0).information);
      ASSERT_TRUE(covariance);
      const Vector6d error = log(minima[0].X_CB.inverse() * X_CM);
      sum += error.dot(covariance->inverse() * error);
    }
    // Mean of chi²₆ is 6, its standard deviation over 500 views 0.15.
    EXPECT_NEAR(sum / kViews, 6, 0.7) << tilt_deg;
  }
}

// A tag mirrored at the line of sight looks much the same: where that is another minimum, it is
// found.
TEST(SolveTagPose, OverlooksNoMirroredMinimum) {
  std::mt19937 random(9);
  std::uniform_real_distribution<double> unit(0, 1);
  int num_single = 0;
  for (int n = 0; n < 3000; ++n) {
    const Pose X_CM = marker_pose(0.5 + 2.5 * unit(random), 40 * kDegree * unit(random),
                                  2 * M_PI * unit(random), 2 * M_PI * unit(random), 0.3, 0.1);
    const auto points = view(X_CM, 0.3, random);
    const auto minima = solve_tag_pose(kSize_m, points);
    if (minima.size() != 1) continue;
    ++num_single;
    const Pose& X = minima[0].X_CB;
    const Eigen::Vector3d sight = X.translation().normalized();
    const Eigen::Vector3d axis = X.linear().col(2).cross(sight);
    Pose mirrored = X;
    mirrored.linear() =
        exp_so3(axis.normalized() * (2 * std::asin(std::min(1.0, axis.norm())))) * X.linear();
    const auto fit = fit_pose(mirrored, tag_corners(kSize_m), points);
    if (fit && tilt_rad(fit->X_CB) < M_PI / 2) EXPECT_TRUE(is_same_minimum(fit->X_CB, X)) << n;
  }
  EXPECT_GT(num_single, 10);
}

TEST(SolveTagPose, GivesNothingForCornersThatAreNoSquare) {
  const ImagePoint point{{0.1, 0.1}, 1000 * Eigen::Matrix2d::Identity(), 1};
  const auto minima = solve_tag_pose(kSize_m, {point, point, point, point});
  for (const PoseFit& minimum : minima) EXPECT_TRUE(minimum.X_CB.matrix().allFinite());
}

TEST(CornerNoise, GrowsAsTheShortestSideShrinks) {
  const CornerNoise noise{0.05, 0.15};
  const auto square = [](double side) {
    return std::vector<Eigen::Vector2d>{{0, side}, {100, side}, {100, 0}, {0, 0}};
  };
  EXPECT_NEAR(noise.sigma_px(square(20)), std::hypot(0.05, 0.15), 1e-12);
  EXPECT_NEAR(noise.sigma_px(square(10)), std::hypot(0.05, 0.6), 1e-12);
  EXPECT_NEAR(noise.sigma_px(square(100)), 0.05, 1e-3);
}

}  // namespace
}  // namespace bodyschema
