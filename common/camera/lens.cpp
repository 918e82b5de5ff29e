#include "common/camera/lens.h"

#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>

namespace bodyschema {

Lens::Lens(const camera_info_t& info)
    : width_(info.image_width),
      height_(info.image_height),
      focal_px_(info.fx, info.fy),
      centre_px_(info.cx, info.cy),
      model_(info.distortion_model),
      num_coefficients_(info.num_coefficients),
      is_distorted_(false) {
  const int n = info.num_coefficients;
  const bool fits = n == 0 || (model_ == camera_info_t::MODEL_PLUMB_BOB && (n == 4 || n == 5)) ||
                    (model_ == camera_info_t::MODEL_RATIONAL && n == 8) ||
                    (model_ == camera_info_t::MODEL_FISHEYE && n == 4);
  if (!fits) {
    throw std::invalid_argument("distortion model " + std::to_string(model_) + " with " +
                                std::to_string(n) + " coefficients");
  }
  if (!(info.fx > 0 && info.fy > 0)) throw std::invalid_argument("focal length not above 0");
  std::copy_n(info.distortion.begin(), n, k_);
  set_distorted();
}

void Lens::set_distorted() {
  // Coefficients of zero are a pinhole's, and a pinhole needs no iteration.
  is_distorted_ = std::any_of(k_, k_ + num_coefficients_, [](double k) { return k != 0; });
  // Without coefficients a fisheye lens is still not a pinhole.
  if (model_ == camera_info_t::MODEL_FISHEYE) is_distorted_ = true;
}

Eigen::VectorXd Lens::parameters() const {
  Eigen::VectorXd parameters(4 + num_coefficients_);
  parameters << focal_px_, centre_px_, Eigen::Map<const Eigen::VectorXd>(k_, num_coefficients_);
  return parameters;
}

Lens Lens::with(const Eigen::Ref<const Eigen::VectorXd>& parameters) const {
  Lens lens = *this;
  lens.focal_px_ = parameters.head<2>();
  lens.centre_px_ = parameters.segment<2>(2);
  std::copy(parameters.begin() + 4, parameters.end(), lens.k_);
  lens.set_distorted();
  return lens;
}

Eigen::Vector2d Lens::distort(const Eigen::Vector2d& ray) const {
  if (!is_distorted_) return ray;
  const double r2 = ray.squaredNorm();
  if (model_ == camera_info_t::MODEL_FISHEYE) {
    const double r = std::sqrt(r2);
    if (r < 1e-12) return ray;
    const double theta = std::atan(r);
    const double t2 = theta * theta;
    const double theta_d = theta * (1 + t2 * (k_[0] + t2 * (k_[1] + t2 * (k_[2] + t2 * k_[3]))));
    return ray * (theta_d / r);
  }
  const auto& [k1, k2, p1, p2, k3, k4, k5, k6] = k_;
  const double radial =
      (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)));
  const double xy = ray.x() * ray.y();
  return ray * radial + Eigen::Vector2d(2 * p1 * xy + p2 * (r2 + 2 * ray.x() * ray.x()),
                                        p1 * (r2 + 2 * ray.y() * ray.y()) + 2 * p2 * xy);
}

Eigen::Vector2d Lens::project(const Eigen::Vector2d& ray) const {
  return distort(ray).array() * focal_px_ + centre_px_;
}

Eigen::Matrix2d Lens::px_per_ray(const Eigen::Vector2d& ray) const {
  if (!is_distorted_) return focal_px_.matrix().asDiagonal();
  // Central differences: smooth, and good to 1e-9 of the focal length.
  constexpr double kStep = 1e-5;
  Eigen::Matrix2d J;
  for (int i = 0; i < 2; ++i) {
    const Eigen::Vector2d step = kStep * Eigen::Vector2d::Unit(i);
    J.col(i) = (project(ray + step) - project(ray - step)) / (2 * kStep);
  }
  return J;
}

std::optional<ImagePoint> Lens::straighten(const Eigen::Vector2d& p_px) const {
  if (!p_px.allFinite()) return std::nullopt;
  Eigen::Vector2d ray = (p_px.array() - centre_px_) / focal_px_;
  if (!is_distorted_) return ImagePoint{ray, px_per_ray(ray), 1};
  if (model_ == camera_info_t::MODEL_FISHEYE) {
    const double theta = ray.norm();
    if (theta >= M_PI / 2) return std::nullopt;
    if (theta > 1e-9) ray *= std::tan(theta) / theta;
  }
  // Newton's method; a step that does not help is halved. OpenCV's own fixed-point iteration stops
  // after 5 rounds, which costs tenths of a pixel with strong lenses.
  Eigen::Vector2d error = p_px - project(ray);
  for (int iteration = 0; iteration < 50 && error.norm() > 1e-10; ++iteration) {
    const Eigen::Vector2d step = px_per_ray(ray).inverse() * error;
    if (!step.allFinite()) return std::nullopt;
    double scale = 1;
    while (scale > 1e-3 && (p_px - project(ray + scale * step)).norm() >= error.norm()) scale /= 2;
    if (scale <= 1e-3) break;
    ray += scale * step;
    error = p_px - project(ray);
  }
  constexpr double kAccuracy_px = 1e-6;
  if (!(error.norm() < kAccuracy_px)) return std::nullopt;
  // Beyond the radius where distortion folds the image back, the Jacobian is not positive definite.
  const Eigen::Matrix2d J = px_per_ray(ray);
  if (J(0, 0) <= 0 || J.determinant() <= 0) return std::nullopt;
  return ImagePoint{ray, J, 1};
}

}  // namespace bodyschema
