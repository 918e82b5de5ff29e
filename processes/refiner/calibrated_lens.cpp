#include "processes/refiner/calibrated_lens.h"

#include <algorithm>

#include "common/bus/convert.h"

namespace bodyschema {

Lens lens_of(const CameraCalibration& camera) {
  camera_info_t info{};
  info.image_width = camera.width;
  info.image_height = camera.height;
  info.fx = camera.fx;
  info.fy = camera.fy;
  info.cx = camera.cx;
  info.cy = camera.cy;
  info.distortion_model = static_cast<std::int8_t>(camera.model);
  set_array(info.num_coefficients, info.distortion, camera.distortion);
  return Lens(info);
}

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
