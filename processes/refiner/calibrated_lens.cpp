#include "processes/refiner/calibrated_lens.h"

#include <algorithm>

namespace bodyschema {

CameraCalibration with_all_coefficients(CameraCalibration camera) {
  if (!camera.distortion.empty()) return camera;
  using Model = CameraCalibration::Model;
  camera.distortion.resize(camera.model == Model::kPlumbBob   ? 5
                           : camera.model == Model::kRational ? 8
                                                              : 4);
  return camera;
}

CameraCalibration calibration_with(CameraCalibration camera, const Eigen::VectorXd& parameters) {
  camera.fx = parameters(0);
  camera.fy = parameters(1);
  camera.cx = parameters(2);
  camera.cy = parameters(3);
  std::copy(parameters.begin() + 4, parameters.end(), camera.distortion.begin());
  return camera;
}

}  // namespace bodyschema
