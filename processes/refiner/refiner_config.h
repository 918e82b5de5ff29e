#pragma once

#include <filesystem>

#include "common/estimation/measurement_model.h"
#include "common/geometry/angle.h"

namespace bodyschema {

/// refiner.yaml: how far a rig's tags and lens may be from what its files claim, 1 σ each, and how
/// much is fitted. The defaults hold where a rig has no such file.
struct RefinerConfig {
  /// A ruler's and a printer's accuracy.
  TagCalibration tags = {.position_m = 0.0005, .rotation_rad = 0.3 * kDegree, .size_share = 0.003};
  /// Of a calibration with a board, of each axis.
  double focal_length_share = 0.01;
  double centre_px = 5;
  double distortion = 0.01;  ///< of each coefficient
  /// Of more training samples as many are fitted, evenly spaced.
  int max_samples = 400;

  /// @throws ConfigError.
  static RefinerConfig load(const std::filesystem::path& file);
};

}  // namespace bodyschema
