#pragma once

#include <cstdint>
#include <opencv2/core/mat.hpp>
#include <vector>

#include "bodyschema/camera_image_t.hpp"
#include "bodyschema/camera_info_t.hpp"
#include "common/geometry/pose.h"

namespace bodyschema {

/// A tag36h11 plate somewhere in front of the camera.
struct Plate {
  int id = 0;
  double size_m = 0.08;
  Pose X_CM = Pose::Identity();
};

/// 1280×960 px, f = 1159 px, no distortion.
camera_info_t pinhole_camera();

/// The camera's image: every pixel is the mean of 6×6 rays, intersected with the plates exactly;
/// then blur and sensor noise. Grey 90 beside the plates.
cv::Mat render_plates(const std::vector<Plate>& plates, const camera_info_t& camera,
                      double blur_px = 0.7, double noise_sd = 2, std::uint64_t seed = 1);

camera_image_t grey_message(const cv::Mat& image, std::int64_t utime = 1, std::int64_t seq = 0);

/// A marker at `distance_m` along the ray (x/z, y/z), turned by `spin_rad` about its normal, then
/// tilted by `tilt_rad` against the line of sight about the direction `azimuth_rad`.
Pose marker_pose(double distance_m, double tilt_rad, double azimuth_rad, double spin_rad,
                 double ray_x = 0, double ray_y = 0);

}  // namespace bodyschema
