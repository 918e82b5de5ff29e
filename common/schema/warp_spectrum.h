#pragma once

#include <Eigen/Core>
#include <array>
#include <cmath>

#include "common/schema/signal.h"

namespace bodyschema {

/// Correlation lengths that are tried for a warp, in half ranges.
inline constexpr std::array<double, 3> kWarpLengths{0.25, 0.4, 0.7};

/// Variances of the weights of warp_basis() for a process of amplitude 1: the spectral density of
/// a squared exponential of that length (Solin and Särkkä 2020).
inline Eigen::ArrayXd warp_spectrum(double length, Eigen::Index size) {
  const Eigen::ArrayXd omega =
      Eigen::ArrayXd::LinSpaced(size, 1, static_cast<double>(size)) * M_PI / (2 * kWarpReach);
  return std::sqrt(2 * M_PI) * length * (-0.5 * (omega * length).square()).exp() / kWarpReach;
}

}  // namespace bodyschema
