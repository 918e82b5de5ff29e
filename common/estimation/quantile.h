#pragma once

#include <algorithm>
#include <cstddef>
#include <vector>

namespace bodyschema {

/// The middle value, the upper of two if their number is even. There must be a value. O(n).
inline double upper_median(std::vector<double> values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

/// The middle value, the mean of two if their number is even. There must be a value. O(n).
inline double median(std::vector<double> values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  if (values.size() % 2 == 1) return *middle;
  return 0.5 * (*std::max_element(values.begin(), middle) + *middle);
}

/// The value that a share of `tail` exceeds, 0 ≤ tail < 1. There must be a value. O(n).
inline double exceeded_by(double tail, std::vector<double> values) {
  const auto rank = static_cast<std::ptrdiff_t>((1 - tail) * static_cast<double>(values.size()));
  const auto at = values.begin() + std::min(rank, std::ssize(values) - 1);
  std::nth_element(values.begin(), at, values.end());
  return *at;
}

}  // namespace bodyschema
