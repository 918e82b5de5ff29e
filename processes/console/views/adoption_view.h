#pragma once

#include <string>

#include "common/config/camera_calibration.h"
#include "common/config/rig.h"

namespace bodyschema {

/// What would be another in a rig's tags and lens, for people: per tag how far it moves on its part
/// and how much larger it is, and the lens's numbers.
std::string adoption_text(const Markers& before, const Markers& after,
                          const CameraCalibration& lens_before,
                          const CameraCalibration& lens_after);

}  // namespace bodyschema
