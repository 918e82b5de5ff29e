#pragma once

#include <vector>

#include "common/schema/body_schema.h"

namespace bodyschema {

/// How well the samples tell a joint, one standard deviation: Edge::parameter_covariance in terms
/// that do not depend on where on its axis the joint's frame sits, and how it is turned about it.
struct JointDeviation {
  /// Of the axis, across it, where it is known best; undetermined where nothing turns.
  double axis_position_m = 0;
  double axis_tilt_rad = 0;     ///< of the axis, about each direction across it
  double displacement_m = 0;    ///< of how far it has slid at these displacements ...
  double displacement_rad = 0;  ///< ... and turned
  double slide = 0;             ///< [m per command unit]
  double turn = 0;              ///< [rad per command unit]
};

/// Of each joint in the frame of the one before (the first: of `from`). Empty without a covariance.
std::vector<JointDeviation> joint_deviations(const Edge& edge, const Eigen::VectorXd& theta);

/// Variances per axis, (translation [m²], rotation [rad²]), of the pose of one part in another,
/// seen with this noise `X` apart: the rotation of the one moves the other, across the line between
/// them.
Vector6d noise_of_pair(const Pose& X, const Noise& noise);

/// Root mean square over three axes: translation [m], rotation [rad].
Noise deviations_of(const Matrix6d& covariance);

}  // namespace bodyschema
