#pragma once

#include <Eigen/Core>
#include <optional>
#include <vector>

#include "bodyschema/camera_info_t.hpp"

namespace bodyschema {

/// A measured image point without the lens: the ray through it, and how pixels move with the ray.
struct ImagePoint {
  Eigen::Vector2d ray = Eigen::Vector2d::Zero();  ///< (x/z, y/z) in the camera's frame C
  /// ∂p/∂ray [px]: carries a small difference of rays to the pixels in which noise is isotropic.
  Eigen::Matrix2d px_per_ray = Eigen::Matrix2d::Identity();
  double sigma_px = 1;  ///< standard deviation of each of its coordinates
};

/// The intrinsic calibration as mathematics: rays to pixels and back, for the plumb bob, rational
/// and fisheye (equidistant) models with OpenCV's formulas and order of coefficients.
class Lens {
 public:
  /// @throws std::invalid_argument if the number of coefficients does not fit the model.
  explicit Lens(const camera_info_t& info);

  int width() const { return width_; }    ///< [px]
  int height() const { return height_; }  ///< [px]

  /// Pixel (centre convention) of the ray (x/z, y/z).
  Eigen::Vector2d project(const Eigen::Vector2d& ray) const;

  /// Its derivative by the ray [px].
  Eigen::Matrix2d px_per_ray(const Eigen::Vector2d& ray) const;

  /// fx, fy, cx, cy [px], then the coefficients in OpenCV's order.
  Eigen::VectorXd parameters() const;
  /// A lens of this model and size with such parameters, whose focal lengths are above 0.
  Lens with(const Eigen::Ref<const Eigen::VectorXd>& parameters) const;

  /// Inverse of project(): std::nullopt where the model has none, that is, outside of the region
  /// in which it is one-to-one, or 90° and more off the optical axis.
  std::optional<ImagePoint> straighten(const Eigen::Vector2d& p_px) const;

 private:
  Eigen::Vector2d distort(const Eigen::Vector2d& ray) const;
  void set_distorted();

  int width_, height_;
  Eigen::Array2d focal_px_;
  Eigen::Array2d centre_px_;
  int model_;
  int num_coefficients_;
  double k_[8] = {};
  bool is_distorted_;
};

}  // namespace bodyschema
