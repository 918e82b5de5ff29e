#pragma once

#include <vector>

#include "common/geometry/pose.h"

namespace bodyschema {

/// Factors on the assumed variance of a measurement that a fit may choose: of a tenth and of twice
/// the deviation.
inline constexpr double kLeastNoise = 1e-2, kMostNoise = 4;

/// A whitened residual along the principal axes of S, the whitened covariance of its prediction.
struct PrincipalResidual {
  Vector6d squares;
  Vector6d variances;  ///< of the prediction: eigenvalues of S

  /// d² = rᵀ(fI + S)⁻¹r with the factor f on the assumed variance.
  double squared_distance(double noise) const;
  /// The log density of the residual up to a constant [nats]: −½[d² + log|fI + S|]; of an outlier
  /// no less than −½[2c + log|I + S|], c kOutlierThreshold, so that f is that of the others.
  double log_density(double noise) const;
};

/// `S` is symmetric, positive semidefinite up to rounding.
PrincipalResidual principal_residual(const Vector6d& residual, const Matrix6d& S);

/// The factor of largest density within [kLeastNoise, kMostNoise], to 10 %: between two steps lies
/// one that has 0.003 nats a frame more at most.
double best_noise(const std::vector<PrincipalResidual>& residuals);

}  // namespace bodyschema
