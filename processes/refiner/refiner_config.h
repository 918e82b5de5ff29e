#pragma once

#include <cstdint>
#include <filesystem>

#include "common/estimation/measurement_model.h"
#include "common/geometry/angle.h"

namespace bodyschema {

/// refiner.yaml: what the process refines and when; how far a rig's tags and lens may be from what
/// its files claim, 1 σ each; how much is fitted. The defaults hold where a rig has no such file.
struct RefinerConfig {
  bool enabled = false;            ///< the group has a refiner
  std::int64_t refine_every = 50;  ///< samples
  /// What the process fits beside the schema, one of them at least: poses alone would tell it
  /// nothing that the learner does not know.
  bool placements = true, intrinsics = true;
  /// A ruler's and a printer's accuracy.
  TagCalibration tags = {.position_m = 0.0005, .rotation_rad = 0.3 * kDegree, .size_share = 0.003};
  /// Of a calibration with a board, of each axis.
  double focal_length_share = 0.01;
  double centre_px = 5;
  double distortion = 0.01;  ///< of each coefficient
  /// How far joints may be from their commands at a sample (backlash, droop), where the search
  /// begins: it is estimated. Sliding joints: position_m, others: rotation_rad.
  TagCalibration joint_play = {.position_m = 2e-4, .rotation_rad = 0.05 * kDegree};
  /// Of more training samples as many are fitted, those that tell most.
  int max_samples = 400;

  /// @throws ConfigError.
  static RefinerConfig load(const std::filesystem::path& file);
};

}  // namespace bodyschema
