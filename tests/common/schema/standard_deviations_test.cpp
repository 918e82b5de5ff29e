#include "common/schema/standard_deviations.h"

#include <gtest/gtest.h>

#include <Eigen/Cholesky>

#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

/// Standard deviations: of the first axis' tilt, of its position where that is known best, and of
/// the last joint's displacement.
struct Drawn {
  double tilt = 0, across = 0, turned = 0;
};

/// Of edges of two joints whose parameters have `root` as a root of their covariance.
Drawn draw(const Edge& edge, const Eigen::MatrixXd& root, double last_displacement,
           test::Rng& rng) {
  // The last joint's displacement in terms of the end alone: the end's twist along its axis.
  constexpr int kDraws = 20'000;
  // Heights along the axis, of which one is that where its position is known best.
  std::vector<double> across(200, 0.0);
  double tilt = 0, turned = 0;
  const Matrix6d to_axis = adjoint(edge.joints[1].X_after);
  for (int n = 0; n < kDraws; ++n) {
    const Eigen::VectorXd delta =
        root * Eigen::VectorXd::NullaryExpr(root.rows(), [&] { return test::gaussian(rng); });
    const Pose X = exp(delta.head<6>());
    const Eigen::Vector3d z = X.linear().col(2);
    tilt += z.head<2>().squaredNorm() / 2 / kDraws;
    for (std::size_t i = 0; i < across.size(); ++i) {
      const Eigen::Vector3d at(0, 0, -2 + 0.02 * static_cast<double>(i));
      across[i] += (X * at - at).head<2>().squaredNorm() / 2 / kDraws;
    }
    // Exp(δ) before the joint and after it, along the axis that both share.
    const double along = delta.segment<6>(8)(5) + last_displacement * delta(15) +
                         (to_axis * delta.segment<6>(16))(5);
    turned += along * along / kDraws;
  }
  return {std::sqrt(tilt), std::sqrt(*std::min_element(across.begin(), across.end())),
          std::sqrt(turned)};
}

// Drawn edges: where the first axis lies and how it leans, and how far each joint has gone.
TEST(StandardDeviations, OfAJointAreThoseOfDrawnEdgesHoweverItsFrameIsTurned) {
  test::Rng rng(3);
  Edge edge;
  edge.left = test::random_pose(rng, 0.2, 0.4);
  for (int d = 0; d < 2; ++d) {
    ScrewJoint& joint = edge.joints.emplace_back();
    joint.signal = d;
    joint.slide = 0.02;
    joint.turn = 0.8;
    joint.X_after = test::random_pose(rng, 0.2, 0.4);
  }
  constexpr int kSize = 22;
  const Eigen::MatrixXd root =
      Eigen::MatrixXd::NullaryExpr(kSize, kSize, [&] { return 1e-4 * test::gaussian(rng); });
  edge.parameter_covariance = root * root.transpose();
  const Eigen::Vector2d theta(0.7, -0.4);
  const auto deviations = joint_deviations(edge, theta);
  ASSERT_EQ(deviations.size(), 2U);

  const Drawn drawn = draw(edge, root, theta(1), rng);
  EXPECT_NEAR(deviations[0].axis_tilt_rad, drawn.tilt, 0.02 * drawn.tilt);
  EXPECT_NEAR(deviations[0].axis_position_m, drawn.across, 0.02 * drawn.across);
  EXPECT_NEAR(deviations[1].displacement_rad, drawn.turned, 0.02 * drawn.turned);

  // The screw frame turned about its axis by 30° and slid along it by 0.1 m: another gauge.
  const auto gauge = [&](double slide, double turn) {
    Pose X = Pose::Identity();
    X.linear() = Eigen::AngleAxisd(turn, Eigen::Vector3d::UnitZ()).matrix();
    X.translation().z() = slide;
    return X;
  };
  Edge turned_edge = edge;
  const Pose G = gauge(0.1, 0.5);
  turned_edge.left = edge.left * G;
  turned_edge.joints[0].X_after = G.inverse() * edge.joints[0].X_after;
  Eigen::MatrixXd T = Eigen::MatrixXd::Identity(kSize, kSize);
  T.topLeftCorner<6, 6>() = adjoint(G.inverse());
  turned_edge.parameter_covariance = T * edge.parameter_covariance * T.transpose();
  const auto others = joint_deviations(turned_edge, theta);
  EXPECT_NEAR(others[0].axis_tilt_rad, deviations[0].axis_tilt_rad, 1e-12);
  EXPECT_NEAR(others[0].axis_position_m, deviations[0].axis_position_m, 1e-12);
  EXPECT_NEAR(others[0].displacement_rad, deviations[0].displacement_rad, 1e-12);
  EXPECT_NEAR(others[0].displacement_m, deviations[0].displacement_m, 1e-12);
}

TEST(StandardDeviations, AnEdgeWithoutCovarianceHasNone) {
  Edge edge;
  edge.joints.emplace_back();
  EXPECT_TRUE(joint_deviations(edge, Eigen::VectorXd::Zero(1)).empty());
}

TEST(MidRange, IsInTheMiddle) {
  EXPECT_EQ(mid_range({{"a", -1, 3}, {"b", 2, 2}}), Eigen::Vector2d(1, 2));
}

}  // namespace
}  // namespace bodyschema
