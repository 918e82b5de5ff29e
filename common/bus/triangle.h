#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <cstddef>
#include <span>

namespace bodyschema {

// Symmetric matrices travel as their lower triangle, row by row, in float: N(N + 1)/2 numbers. Only
// this code knows that layout.

/// Largest error of an eigenvalue of an N×N correlation matrix, N ≤ 8, whose covariance was rounded
/// to float: an entry is off by two roundings (its own, and half of each of its variances'), so
/// 8 · 2 · 2^-24 ≈ 1e-6 at most.
inline constexpr double kTriangleRounding = 1e-6;

/// `packed` has room for the triangle.
template <class Derived>
void pack_triangle(const Eigen::MatrixBase<Derived>& matrix, std::span<float> packed) {
  std::size_t k = 0;
  for (Eigen::Index i = 0; i < matrix.rows(); ++i)
    for (Eigen::Index j = 0; j <= i; ++j) packed[k++] = static_cast<float>(matrix(i, j));
}

/// Both triangles. `packed` has side (side + 1) / 2 numbers.
template <int Side>
Eigen::Matrix<double, Side, Side> unpack_triangle(std::span<const float> packed,
                                                  Eigen::Index side = Side) {
  Eigen::Matrix<double, Side, Side> matrix(side, side);
  std::size_t k = 0;
  for (Eigen::Index i = 0; i < side; ++i)
    for (Eigen::Index j = 0; j <= i; ++j)
      matrix(i, j) = matrix(j, i) = static_cast<double>(packed[k++]);
  return matrix;
}

/// Unit diagonal; 0 beside a variance of 0. Metres² and radians² differ by orders of magnitude.
template <int Side>
Eigen::Matrix<double, Side, Side> correlation_of(
    const Eigen::Matrix<double, Side, Side>& covariance) {
  const Eigen::Matrix<double, Side, 1> sd = covariance.diagonal().cwiseMax(0).cwiseSqrt();
  Eigen::Matrix<double, Side, Side> correlation = covariance;
  for (Eigen::Index i = 0; i < covariance.rows(); ++i) {
    for (Eigen::Index j = 0; j < covariance.cols(); ++j) {
      const double scale = sd[i] * sd[j];
      correlation(i, j) = i == j ? 1 : scale > 0 ? covariance(i, j) / scale : 0;
    }
  }
  return correlation;
}

}  // namespace bodyschema
