#pragma once

#include <filesystem>

#include "processes/refiner/refine.h"

namespace bodyschema {

/// Writes a rig's markers and lens as `markers.yaml` and `camera_info.yaml` (ROS's form) into a
/// folder, which is made where it is missing. Both read back exactly and begin with kProposalMark.
/// @throws std::runtime_error if a file cannot be written.
void write_proposed_files(const RigCalibration& rig, const std::filesystem::path& folder);

}  // namespace bodyschema
