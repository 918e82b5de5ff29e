#pragma once

#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

namespace bodyschema {

/// Intrinsic calibration of a camera, OpenCV's and ROS's convention: pixel (0, 0) is the centre of
/// the upper left pixel, p = (fx x/z + cx, fy y/z + cy) before distortion is applied to (x/z, y/z).
struct CameraCalibration {
  enum class Model : std::int8_t { kPlumbBob = 0, kRational = 1, kFisheye = 2 };

  std::string camera_name;
  int width = 0;                          ///< [px]
  int height = 0;                         ///< [px]
  double fx = 0, fy = 0, cx = 0, cy = 0;  ///< [px]
  Model model = Model::kPlumbBob;
  /// OpenCV's order; empty: no distortion. Plumb bob 4 or 5, rational 8, fisheye 4.
  std::vector<double> distortion;
};

/// ROS's name: "plumb_bob", "rational_polynomial" or "equidistant".
const char* distortion_model_name(CameraCalibration::Model model);

/// Reads a ROS camera_info YAML (camera_calibration's output: image_width, camera_matrix.data, …)
/// or an OpenCV FileStorage YAML (camera_matrix as !!opencv-matrix, image_width/image_height).
/// @throws ConfigError naming file, line, key.
CameraCalibration load_camera_calibration(const std::filesystem::path& file);

}  // namespace bodyschema
