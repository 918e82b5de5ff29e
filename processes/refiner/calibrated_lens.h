#pragma once

#include <Eigen/Core>

#include "common/camera/calibrated_lens.h"

namespace bodyschema {

/// A lens without coefficients with as many zeros as its model has.
CameraCalibration with_all_coefficients(CameraCalibration camera);

/// The calibration with a lens's parameters (Lens::parameters()).
CameraCalibration calibration_with(CameraCalibration camera, const Eigen::VectorXd& parameters);

}  // namespace bodyschema
