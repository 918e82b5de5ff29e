#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "common/config/calibration_id.h"

namespace bodyschema {

/// How an old file is called that adopt() replaced: its name and this.
inline constexpr const char* kReplacedSuffix = ".before";

/// Tags and lens that a run proposes, and the files of a rig that would say so.
struct Adoption {
  struct File {
    std::filesystem::path path;  ///< symbolic links followed
    std::string before, after;   ///< whole texts
  };
  RigCalibration before, after;  ///< of the rig
  std::vector<File> files;       ///< whose values change; none: the rig is as proposed
};

/// Reads RUN/proposed (markers.yaml, camera_info.yaml or one of them), RUN/config and a rig, and
/// compares them by their values.
/// @throws std::runtime_error, with every reason in a line: nothing is proposed; the proposal has
/// another family of tags, other tags or parts, another image size or model of distortion than the
/// run; the rig's markers or camera calibration are neither the run's nor those proposed; the run's
/// samples were not seen through RUN/config; the rig is RUN/config. ConfigError.
Adoption plan_adoption(const std::filesystem::path& run, const std::filesystem::path& rig);

/// Copies the old files beside themselves (kReplacedSuffix), then replaces them, each durably and
/// as a whole. After a failure in between, plan_adoption() finds what is still to be done.
/// @throws std::runtime_error if a file is no longer as it was planned (then nothing was written),
/// or cannot be written.
void adopt(const Adoption& adoption);

}  // namespace bodyschema
