#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <opencv2/core/mat.hpp>
#include <vector>

#include "bodyschema/camera_info_t.hpp"
#include "common/camera/lens.h"
#include "tests/support/tag_image.h"

namespace bodyschema::test {

/// Conditions of a view of a tag, beside its pose.
struct TagViewOptions {
  double blur_px =
      0;  ///< standard deviation of a Gaussian point spread; 0: the pixel's square alone
  /// Length of the straight motion of the tag's image while the shutter is open, its middle at
  /// the true pose [px].
  Eigen::Vector2d motion_px = Eigen::Vector2d::Zero();
  double black = 25, white = 220, background = 90;  ///< grey levels; above 255 they saturate
  /// Relative change of the light, 1 + gradient · (pixel − centre of the tag) [1/px].
  Eigen::Vector2d light_gradient = Eigen::Vector2d::Zero();
  int rays_per_px = 8;  ///< the picture is made at so many times the resolution, at least 4
};

/// The part of `camera`'s image that shows the plate, as a camera of its own: its image begins at
/// whole blocks of 8 × 8 pixels of the full image and has 16 pixels around the plate.
camera_info_t camera_around(const Plate& plate, const camera_info_t& camera);

/// A camera's image of one tag, without noise and to a thousandth of a pixel: every pixel is the
/// integral over its square of the printed tag after blur and motion. Pixel (0, 0) is the centre of
/// the upper left pixel. The areas that cells cover in a fraction of a pixel come from 64 points of
/// a Hammersley set, so that an edge along the pixels' rows is no worse than a slanted one.
class TagView {
 public:
  TagView(const Plate& plate, const camera_info_t& camera, const TagViewOptions& options = {});

  /// True corners, AprilTag's order [px].
  const std::vector<Eigen::Vector2d>& corners_px() const { return corners_px_; }
  /// CV_64FC1, neither rounded nor cut off.
  const cv::Mat& exact() const { return exact_; }

  /// CV_8UC1: with Gaussian noise of the sensor, cut off and rounded; coded as JPEG and decoded if
  /// `jpeg_quality` is above 0.
  cv::Mat taken(double noise_sd, std::uint64_t seed, int jpeg_quality = 0) const;

  /// The Cramér–Rao bound of the corners (x0, y0, …) [px²] of any unbiased estimate from pixels
  /// with independent Gaussian noise, with unknown black, white and width of the blur,
  /// and unknown surroundings of the tag's white margin. 8 × 8.
  Eigen::Matrix<double, 8, 8> cramer_rao_px2(double noise_sd) const;

 private:
  std::vector<Eigen::Vector2d> lattice_on_tag(const Lens& lens) const;
  cv::Mat many_rays(int id, const std::vector<Eigen::Vector2d>& lattice, double beyond);

  std::vector<Eigen::Vector2d> corners_px_;
  cv::Mat exact_;
  cv::Mat
      fine_;  // of unit contrast, at rays_per_px times the resolution, each value a pixel's mean
  cv::Mat is_plate_;
  Eigen::Matrix3d to_tag_ = Eigen::Matrix3d::Identity();  // ray → (X, Y), black square [−1, 1]²
  camera_info_t camera_;
  TagViewOptions options_;
};

}  // namespace bodyschema::test
