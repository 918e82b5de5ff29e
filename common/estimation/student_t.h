#pragma once

#include <cmath>

namespace bodyschema {

/// Degrees of freedom of the Student-t distribution of marker noise in robust fits: wrong tags are
/// far more frequent than a Gaussian's tails.
inline constexpr double kStudentNu = 4;

/// Weight in a fit of so many residuals (a pose has 6) at this squared Mahalanobis distance:
/// (ν + n)/(ν + d²).
inline double robust_weight(double squared_distance, int num_residuals = 6) {
  return (kStudentNu + num_residuals) / (kStudentNu + squared_distance);
}

/// Negative logarithm of the density there, up to a constant.
inline double robust_cost(double squared_distance, int num_residuals = 6) {
  return (kStudentNu + num_residuals) / 2 * std::log1p(squared_distance / kStudentNu);
}

}  // namespace bodyschema
