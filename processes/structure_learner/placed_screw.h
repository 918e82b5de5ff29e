#pragma once

#include "common/kinematics/screw_chain.h"

namespace bodyschema {

/// A rotation whose third column is the unit vector `axis`.
inline Eigen::Matrix3d frame_with_z(const Eigen::Vector3d& axis) {
  Eigen::Matrix3d R;
  R.col(2) = axis;
  R.col(0) = axis.unitOrthogonal();
  R.col(1) = R.col(2).cross(R.col(0));
  return R;
}

/// A screw in its frame X: X Exp(ŝ) X⁻¹ = Exp(ξ).
struct PlacedScrew {
  Pose X = Pose::Identity();
  Screw screw;

  /// ξ = (v, w): z of X along w, through the point of the axis nearest to the origin; or along v,
  /// without the turn.
  static PlacedScrew of(const Vector6d& xi, bool slides) {
    const Eigen::Vector3d v = xi.head<3>(), w = xi.tail<3>();
    PlacedScrew placed;
    if (slides) {
      placed.screw.slide = v.norm();
      if (v.norm() > 1e-12) placed.X.linear() = frame_with_z(v.normalized());
    } else if (w.norm() > 1e-12) {
      const Eigen::Vector3d axis = w.normalized();
      placed.X.linear() = frame_with_z(axis);
      placed.X.translation() = w.cross(v) / w.squaredNorm();
      placed.screw.turn = w.norm();
      placed.screw.slide = axis.dot(v);
    }
    return placed;
  }
};

}  // namespace bodyschema
