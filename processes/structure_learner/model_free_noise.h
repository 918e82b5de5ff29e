#pragma once

#include <algorithm>
#include <cstddef>
#include <optional>
#include <vector>

#include "processes/structure_learner/pair_data.h"

namespace bodyschema {

/// A quantile of what is left, and that of χ²₃.
struct NoiseQuantile {
  double share, chi3;
  double of(std::vector<double> values) const {
    const auto n = static_cast<std::ptrdiff_t>(share * static_cast<double>(values.size()));
    std::nth_element(values.begin(), values.begin() + n, values.end());
    return values[static_cast<std::size_t>(n)];
  }
};
inline constexpr NoiseQuantile kMedianQuantile{0.5, 2.366};
/// A stream rests, or moves slowly, for much of its time: what a model leaves in motion shows in
/// the upper quarter. A marker that flips at a fifth of the instants is outside.
inline constexpr NoiseQuantile kUpperQuantile{0.75, 4.108};

/// A residual log(Δ̂⁻¹ z) of a relative pose with the lever arm that carries the rotation noise of
/// part i into its position; 0 for a single marker (`markers` 1), and for what a soft body leaves,
/// whose position and rotation err together.
struct NoiseResidual {
  Vector6d residual;
  Eigen::Vector3d lever = Eigen::Vector3d::Zero();
  double markers = 2;
};

/// Noise per axis of one marker from residuals whose covariance is `markers`·σ² plus the lever's
/// part.
Noise noise_from(const std::vector<NoiseResidual>& residuals,
                 const NoiseQuantile& quantile = kMedianQuantile);

/// Samples of one action each, up to a millionth of the ranges, in the order of the actions. None
/// where no signal moves, and none of a stream: one that rests says the same thing many times.
std::vector<std::vector<int>> repeats(const NormalizedActions& actions);

/// From what recurs: each part's poses at one action, against their robust mean. std::nullopt: too
/// few.
std::optional<Noise> noise_from_repeats(const std::vector<ActionPoseSample>& samples,
                                        const NormalizedActions& actions);

/// The white part of a stream's noise, whatever the model: from what is left of three successive
/// poses of a part when its motion is taken to be uniform.
std::optional<Noise> noise_from_neighbours(const std::vector<ActionPoseSample>& samples,
                                           const NormalizedActions& actions);

}  // namespace bodyschema
