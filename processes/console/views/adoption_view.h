#pragma once

#include <string>

#include "common/config/calibration_id.h"

namespace bodyschema {

/// What would be another in a rig's tags and lens, for people: per tag how far it moves on its part
/// and how much larger it is; the lens's numbers, and how far it moves the points of an image. Both
/// have the same tags and the same model of distortion.
std::string adoption_text(const RigCalibration& before, const RigCalibration& after);

// What differs, in a few words; "" where nothing does, to the digits that calibration_id() reads.

/// "tags 3, 5 and 8 differ". A tag that only one of them has, differs.
std::string tags_that_differ(const Markers& one, const Markers& other);
/// "focal length and distortion differ".
std::string lens_values_that_differ(const CameraCalibration& one, const CameraCalibration& other);

// Why a proposal is not of the rig that a run had; "" if it is.

/// Another family, other tags, other parts.
std::string other_tags_text(const Markers& recorded, const Markers& proposed);
/// Another image size or model of distortion.
std::string other_camera_text(const CameraCalibration& recorded, const CameraCalibration& proposed);

}  // namespace bodyschema
