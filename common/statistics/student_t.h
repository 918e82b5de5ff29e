#pragma once

namespace bodyschema {

/// Degrees of freedom of the Student-t distribution of marker noise in robust fits: wrong tags are
/// far more frequent than a Gaussian's tails.
inline constexpr double kStudentNu = 4;

/// Weight of a six-vector at this squared Mahalanobis distance: (ν + 6)/(ν + d²).
inline double robust_weight(double squared_distance) {
  return (kStudentNu + 6) / (kStudentNu + squared_distance);
}

}  // namespace bodyschema
