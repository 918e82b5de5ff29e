#include "tests/support/tag_image.h"

#include <algorithm>
#include <cmath>
#include <opencv2/imgproc.hpp>

#include "common/bus/convert.h"
#include "common/camera/lens.h"
#include "common/scene/tag_bitmap.h"

namespace bodyschema {

camera_info_t pinhole_camera() {
  camera_info_t info{};
  info.camera_name = "test";
  info.image_width = 1280;
  info.image_height = 960;
  info.fx = info.fy = 1159;
  info.cx = 643.2;
  info.cy = 477.9;
  return info;
}

cv::Mat render_plates(const std::vector<Plate>& plates, const camera_info_t& camera, double blur_px,
                      double noise_sd, std::uint64_t seed) {
  const Lens lens(camera);
  cv::Mat image(camera.image_height, camera.image_width, CV_64FC1, cv::Scalar(90));
  for (const Plate& plate : plates) {
    const cv::Mat bitmap = tag_bitmap(plate.id, 1);  // 10×10 cells
    const double cell_m = plate.size_m / 8;
    Eigen::Array2d low(1e9, 1e9), high(-1e9, -1e9);
    for (const double x : {-5.0, 0.0, 5.0}) {
      for (const double y : {-5.0, 0.0, 5.0}) {
        const Eigen::Vector3d p_C = plate.X_CM * Eigen::Vector3d(x * cell_m, y * cell_m, 0);
        const Eigen::Array2d p_px = lens.project(p_C.head<2>() / p_C.z());
        low = low.min(p_px);
        high = high.max(p_px);
      }
    }
    const Pose X_MC = plate.X_CM.inverse();
    constexpr int kRays = 6;
    for (int v = std::max(0, static_cast<int>(low.y()) - 4);
         v < std::min(image.rows, static_cast<int>(high.y()) + 5); ++v) {
      for (int u = std::max(0, static_cast<int>(low.x()) - 4);
           u < std::min(image.cols, static_cast<int>(high.x()) + 5); ++u) {
        double sum = 0;
        for (int i = 0; i < kRays * kRays; ++i) {
          const Eigen::Vector2d p_px(u - 0.5 + (i % kRays + 0.5) / kRays,
                                     v - 0.5 + (i / kRays + 0.5) / kRays);
          const auto point = lens.straighten(p_px);
          double grey = image.at<double>(v, u);
          if (point) {
            const Eigen::Vector3d direction_M = X_MC.linear() * point->ray.homogeneous();
            const Eigen::Vector3d origin_M = X_MC.translation();
            const Eigen::Vector3d p_M = origin_M - origin_M.z() / direction_M.z() * direction_M;
            const int column = static_cast<int>(std::floor(p_M.x() / cell_m + 5));
            const int row = static_cast<int>(std::floor(p_M.y() / cell_m + 5));
            if (row >= 0 && row < 10 && column >= 0 && column < 10) {
              grey = bitmap.at<uchar>(row, column) ? 220 : 25;
            }
          }
          sum += grey;
        }
        image.at<double>(v, u) = sum / (kRays * kRays);
      }
    }
  }
  if (blur_px > 0) cv::GaussianBlur(image, image, {0, 0}, blur_px);
  cv::Mat noise(image.size(), CV_64FC1);
  cv::RNG random(seed);
  random.fill(noise, cv::RNG::NORMAL, 0, noise_sd);
  image += noise;
  cv::Mat grey;
  image.convertTo(grey, CV_8U);
  return grey;
}

camera_image_t grey_message(const cv::Mat& image, std::int64_t utime, std::int64_t seq) {
  camera_image_t message{};
  message.utime = utime;
  message.image_seq = seq;
  message.camera_name = pinhole_camera().camera_name;
  message.width = image.cols;
  message.height = image.rows;
  message.encoding = camera_image_t::ENCODING_GREY;
  set_array(message.num_bytes, message.data,
            std::vector<std::uint8_t>(image.datastart, image.dataend));
  return message;
}

Pose marker_pose(double distance_m, double tilt_rad, double azimuth_rad, double spin_rad,
                 double ray_x, double ray_y) {
  const Eigen::Vector3d sight = Eigen::Vector3d(ray_x, ray_y, 1).normalized();
  // The rotation that turns the optical axis into the line of sight.
  const Eigen::Quaterniond turn =
      Eigen::Quaterniond::FromTwoVectors(Eigen::Vector3d::UnitZ(), sight);
  const Eigen::Vector3d axis(std::cos(azimuth_rad), std::sin(azimuth_rad), 0);
  Pose X_CM = Pose::Identity();
  X_CM.linear() = turn.toRotationMatrix() * exp_so3(tilt_rad * axis) *
                  exp_so3(spin_rad * Eigen::Vector3d::UnitZ());
  X_CM.translation() = distance_m * sight;
  return X_CM;
}

}  // namespace bodyschema
