#pragma once

#include <Eigen/Cholesky>

#include "common/geometry/pose.h"

namespace bodyschema {

/// Squared Mahalanobis distance of two readings of one marker, six dimensions.
class ReadingDistance {
 public:
  /// Below the one two readings are of one pose (χ²₆(0.9999) = 27.9), above the other they are not.
  static constexpr double kSame = 28;
  static constexpr double kOther = 100;

  /// `covariance`: of one reading.
  explicit ReadingDistance(const Matrix6d& covariance) : llt_(2 * covariance) {}
  double operator()(const Pose& a, const Pose& b) const {
    return llt_.matrixL().solve(log(a.inverse() * b)).squaredNorm();
  }

 private:
  const Eigen::LLT<Matrix6d> llt_;
};

}  // namespace bodyschema
