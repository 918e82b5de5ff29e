#include "common/schema/standard_deviations.h"

#include <algorithm>
#include <cmath>

#include "common/kinematics/screw_chain.h"

namespace bodyschema {

std::vector<JointDeviation> joint_deviations(const Edge& edge, const Eigen::VectorXd& theta) {
  const Eigen::MatrixXd& P = edge.parameter_covariance;
  const Eigen::Index size = ScrewChainLayout::size(static_cast<int>(edge.joints.size()));
  std::vector<JointDeviation> result;
  if (P.rows() != size || P.cols() != size) return result;
  const auto sum = [&](Eigen::Index x) { return P(x, x) + P(x + 1, x + 1); };  // about x and y
  for (std::size_t d = 0; d < edge.joints.size(); ++d) {
    const ScrewJoint& joint = edge.joints[d];
    const int at = static_cast<int>(d);
    const Eigen::Index before = ScrewChainLayout::transform(at);  // ends in the joint's frame
    const Eigen::Index slide = ScrewChainLayout::slide(at), turn = ScrewChainLayout::turn(at);
    const Eigen::Index after = ScrewChainLayout::transform(at + 1);
    const Matrix6d A = adjoint(joint.X_after);
    // What a screw frame gains along its axis the transform that follows loses.
    const auto along = [&](Eigen::Index axis, Eigen::Index rate) {
      Eigen::VectorXd g = Eigen::VectorXd::Zero(size);
      g(before + axis) = 1;
      g(rate) = joint.gain * theta(joint.signal) + joint.offset;
      g.segment<6>(after) = A.row(axis);
      return std::sqrt(g.dot(P * g));
    };
    // A point of the axis at height h is off by (δx + h δry, δy − h δrx): least where that is zero.
    const double slope = P(before, before + 4) - P(before + 1, before + 3);
    const double position = sum(before) - slope * slope / std::max(sum(before + 3), 1e-300);
    result.push_back({.axis_position_m = std::sqrt(std::max(position, 0.0) / 2),
                      .axis_tilt_rad = std::sqrt(sum(before + 3) / 2),
                      .displacement_m = along(2, slide),
                      .displacement_rad = along(5, turn),
                      .slide = std::sqrt(P(slide, slide)),
                      .turn = std::sqrt(P(turn, turn))});
  }
  return result;
}

Noise deviations_of(const Matrix6d& covariance) {
  return {std::sqrt(covariance.topLeftCorner<3, 3>().trace() / 3),
          std::sqrt(covariance.bottomRightCorner<3, 3>().trace() / 3)};
}

Vector6d noise_of_pair(const Pose& X, const Noise& noise) {
  const double rotation = noise.rotation_rad * noise.rotation_rad;
  const double position =
      2 * noise.position_m * noise.position_m + 2.0 / 3 * rotation * X.translation().squaredNorm();
  Vector6d result;
  result << Eigen::Vector3d::Constant(position), Eigen::Vector3d::Constant(2 * rotation);
  return result;
}

}  // namespace bodyschema
