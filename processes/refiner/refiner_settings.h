#pragma once

#include <filesystem>

#include "processes/refiner/refine.h"

namespace bodyschema {

/// What a refinement takes from a rig's folder.
struct RefinerSettings {
  RefineOptions options;
  RigCalibration rig;

  /// Reads markers.yaml, noise.yaml and the calibration that camera.yaml names; `config` is that of
  /// the rig's refiner.yaml. @throws ConfigError.
  static RefinerSettings load(const std::filesystem::path& rig_folder, const RefinerConfig& config);
};

}  // namespace bodyschema
