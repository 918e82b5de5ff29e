#pragma once

#include <cstdint>
#include <filesystem>

#include "common/config/camera_calibration.h"
#include "common/config/rig.h"

namespace bodyschema {

/// What a rig claims of its tags and its camera.
struct RigCalibration {
  Markers markers;
  CameraCalibration camera;
};

/// Hash of the calibration that poses rest on, carried by messages: FNV-1a (64 bit) of these int64
/// numbers, little-endian, in this order:
///   1. per tag, ascending id: id; part; size [nm]; 1 and its placement, or 0 where there is none.
///      Placement: position [nm]; quaternion w x y z in 1e-9, of q and −q the one whose first
///      number that is not 0 is positive;
///   2. image width and height [px]; fx, fy, cx, cy in 1e-6 px;
///   3. 1 for fisheye, else 0; the distortion's coefficients in 1e-9 up to the last that is not 0.
/// Real numbers are rounded to the nearest multiple. So the hash depends on values, not on how a
/// file writes them, and is the same on every machine. Names (camera, tag family) do not count. It
/// is never 0, which means "unknown".
std::int64_t calibration_id(const Markers& markers, const CameraCalibration& camera);
std::int64_t calibration_id(const RigCalibration& calibration);

/// The file that the rig's camera.yaml names. @throws ConfigError.
std::filesystem::path calibration_file(const std::filesystem::path& rig_folder);

/// The rig's markers.yaml and the calibration that camera.yaml names. @throws ConfigError.
RigCalibration load_calibration(const std::filesystem::path& rig_folder);

/// Hash of load_calibration(). @throws ConfigError.
std::int64_t calibration_id(const std::filesystem::path& rig_folder);

}  // namespace bodyschema
