#include "common/camera/calibrated_lens.h"

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

}  // namespace bodyschema
