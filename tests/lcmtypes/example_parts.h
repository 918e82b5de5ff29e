#pragma once

#include <cmath>
#include <utility>
#include <vector>

#include "common/bus/channels.h"

// What several example messages hold.

namespace bodyschema::test {

template <class Count, class Element>
void fill(Count& count, std::vector<Element>& array, std::vector<Element> values) {
  count = static_cast<Count>(values.size());
  array = std::move(values);
}

/// A pose that differs from number to number.
inline pose_t pose(int number) {
  const double angle = 0.3 + 0.1 * number;
  pose_t X{};
  X.position_m[0] = 0.01 * number + 0.1;
  X.position_m[1] = -0.02 * number;
  X.position_m[2] = 1.5;
  X.rotation_wxyz[0] = std::cos(angle / 2);
  X.rotation_wxyz[1] = 0.6 * std::sin(angle / 2);
  X.rotation_wxyz[3] = 0.8 * std::sin(angle / 2);
  return X;
}

/// B Bᵀ with B = 1e-3 (identity + a little everywhere).
inline void covariance(float (&wire)[21]) {
  for (int i = 0, n = 0; i < 6; ++i) {
    for (int j = 0; j <= i; ++j, ++n) {
      double sum = 0;
      for (int k = 0; k < 6; ++k)
        sum += 1e-6 * ((i == k) + 0.02 * (i + k)) * ((j == k) + 0.02 * (j + k));
      wire[n] = static_cast<float>(sum);
    }
  }
}

inline void corner_covariance(float (&wire)[36]) {
  for (int i = 0; i < 8; ++i) wire[i * (i + 3) / 2] = 0.0025F;
}

inline void corners(double (&wire)[4][2], double offset) {
  const double unit[4][2] = {{-1, 1}, {1, 1}, {1, -1}, {-1, -1}};
  for (int i = 0; i < 4; ++i) {
    wire[i][0] = 320 + offset + 20 * unit[i][0];
    wire[i][1] = 240 - offset + 20 * unit[i][1];
  }
}

}  // namespace bodyschema::test
