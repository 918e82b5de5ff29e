#pragma once

#include "common/camera/lens.h"
#include "common/config/camera_calibration.h"

namespace bodyschema {

/// @throws std::invalid_argument if the number of coefficients does not fit the model.
Lens lens_of(const CameraCalibration& camera);

}  // namespace bodyschema
