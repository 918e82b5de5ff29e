#pragma once

#include "common/camera/lens.h"
#include "common/config/camera_calibration.h"

namespace bodyschema {

/// @throws std::invalid_argument if the number of coefficients does not fit the model.
Lens lens_of(const CameraCalibration& camera);

/// A lens without coefficients with as many zeros as its model has.
CameraCalibration with_all_coefficients(CameraCalibration camera);

/// The calibration with a lens's parameters (Lens::parameters()).
CameraCalibration calibration_with(CameraCalibration camera, const Eigen::VectorXd& parameters);

}  // namespace bodyschema
