#pragma once

#include <cmath>

namespace bodyschema {

/// Degrees of freedom of the Student-t distribution of marker noise in robust fits: wrong tags are
/// far more frequent than a Gaussian's tails.
inline constexpr double kStudentNu = 4;

/// Weight in a fit of a six-vector at this squared Mahalanobis distance: (ν + 6)/(ν + d²).
inline double robust_weight(double squared_distance) {
  return (kStudentNu + 6) / (kStudentNu + squared_distance);
}

/// Negative logarithm of the density there, up to a constant.
inline double robust_cost(double squared_distance) {
  return (kStudentNu + 6) / 2 * std::log1p(squared_distance / kStudentNu);
}

}  // namespace bodyschema
