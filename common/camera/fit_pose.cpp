#include "common/camera/fit_pose.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>

#include "common/estimation/levenberg_marquardt.h"

namespace bodyschema {

double sigma_px(const Matrix8d& corner_covariance_px2) {
  return std::sqrt(corner_covariance_px2.trace() / 8);
}

Matrix8d whitener_of(const Matrix8d& corner_covariance_px2) {
  return (corner_covariance_px2 / (corner_covariance_px2.trace() / 8))
      .llt()
      .matrixL()
      .solve(Matrix8d::Identity());
}

std::optional<Eigen::VectorXd> reprojection_residual(
    const Pose& X_CB, const std::vector<Eigen::Vector3d>& p_BP,
    const std::vector<ImagePoint>& measured, Eigen::Matrix<double, Eigen::Dynamic, 6>* jacobian) {
  const auto n = static_cast<Eigen::Index>(p_BP.size());
  Eigen::VectorXd residual(2 * n);
  if (jacobian) jacobian->resize(2 * n, 6);
  for (Eigen::Index i = 0; i < n; ++i) {
    const Eigen::Vector3d p_C = X_CB * p_BP[i];
    constexpr double kNearest_m = 1e-3;
    if (!(p_C.z() > kNearest_m)) return std::nullopt;
    const Eigen::Vector2d ray = p_C.head<2>() / p_C.z();
    const Eigen::Matrix2d sigmas_per_ray = measured[i].px_per_ray / measured[i].sigma_px;
    residual.segment<2>(2 * i) = sigmas_per_ray * (ray - measured[i].ray);
    if (!jacobian) continue;
    // p_C = R (p_B + v + w × p_B) + t to first order in ξ = (v, w).
    Eigen::Matrix<double, 2, 3> dray_dp;
    dray_dp << 1, 0, -ray.x(), 0, 1, -ray.y();
    dray_dp /= p_C.z();
    const Eigen::Matrix<double, 2, 3> J = sigmas_per_ray * dray_dp * X_CB.linear();
    jacobian->block<2, 3>(2 * i, 0) = J;
    jacobian->block<2, 3>(2 * i, 3) = -J * skew(p_BP[i]);
  }
  return residual;
}

std::optional<PoseFit> fit_pose(const Pose& start, const std::vector<Eigen::Vector3d>& p_BP,
                                const std::vector<ImagePoint>& measured,
                                const Eigen::MatrixXd* whitener) {
  using Jacobian = Eigen::Matrix<double, Eigen::Dynamic, 6>;
  const auto residual_at = [&](const Pose& X, Jacobian* jacobian) {
    auto r = reprojection_residual(X, p_BP, measured, jacobian);
    if (!r || !whitener) return r;
    // Few numbers: without the blocking of a large product.
    r = Eigen::VectorXd(whitener->lazyProduct(*r));
    if (jacobian) *jacobian = Jacobian(whitener->lazyProduct(*jacobian));
    return r;
  };
  Pose X_CB = start;
  Jacobian J, candidate_J;
  auto residual = residual_at(X_CB, &J);
  if (!residual || !residual->allFinite() || p_BP.size() < 3) return std::nullopt;
  double cost = residual->squaredNorm();
  LevenbergMarquardt optimizer(1e-4, 1e-12, 1);
  constexpr int kMaxIterations = 200;
  for (int iteration = 0; iteration < kMaxIterations; ++iteration) {
    const Matrix6d H = J.transpose() * J;
    const Vector6d gradient = J.transpose() * *residual;
    if (!H.allFinite()) return std::nullopt;
    bool is_converged = false;
    const bool improved = optimizer.step(H, gradient, [&](const Vector6d& step) {
      const Pose candidate = X_CB * exp(step);
      is_converged = step.head<3>().norm() < 1e-11 * candidate.translation().norm() &&
                     step.tail<3>().norm() < 1e-11;
      const auto candidate_residual = residual_at(candidate, &candidate_J);
      if (!candidate_residual || candidate_residual->squaredNorm() > cost) return false;
      X_CB = candidate;
      residual = candidate_residual;
      J.swap(candidate_J);
      cost = residual->squaredNorm();
      return true;
    });
    if (is_converged || (!improved && optimizer.damping() > 1e9)) break;
  }
  X_CB.linear() = nearest_rotation(X_CB.linear());
  return PoseFit{X_CB, std::sqrt(cost / static_cast<double>(2 * p_BP.size())), J.transpose() * J};
}

std::optional<Matrix6d> covariance_from(const Matrix6d& information) {
  // Metres and radians differ by orders of magnitude: scale to a unit diagonal before inverting.
  const Vector6d scale = information.diagonal().cwiseSqrt().cwiseInverse();
  if (!scale.allFinite()) return std::nullopt;
  const Eigen::LLT<Matrix6d> factor(scale.asDiagonal() * information * scale.asDiagonal());
  if (factor.info() != Eigen::Success) return std::nullopt;
  const Matrix6d inverse = factor.solve(Matrix6d::Identity());
  Matrix6d covariance = scale.asDiagonal() * inverse * scale.asDiagonal();
  covariance = (0.5 * (covariance + covariance.transpose())).eval();
  if (!covariance.allFinite()) return std::nullopt;
  return covariance;
}

bool is_same_minimum(const Pose& a, const Pose& b) {
  constexpr double kAngle_rad = 0.01;
  return rotation_angle(a.inverse() * b) < kAngle_rad;
}

double shortest_side_px(const std::vector<Eigen::Vector2d>& corners_px) {
  double shortest = std::numeric_limits<double>::infinity();
  for (std::size_t i = 0; i < corners_px.size(); ++i) {
    const Eigen::Vector2d& next = corners_px[(i + 1) % corners_px.size()];
    shortest = std::min(shortest, (next - corners_px[i]).norm());
  }
  return shortest;
}

double CornerNoise::sigma_px(const std::vector<Eigen::Vector2d>& corners_px) const {
  constexpr double kReference_px = 20;
  const double shrink = kReference_px / shortest_side_px(corners_px);
  return std::hypot(corner_noise_px, small_tag_noise_px * shrink * shrink);
}

std::vector<Eigen::Vector3d> tag_corners(double size_m) {
  const double h = size_m / 2;
  return {{-h, h, 0}, {h, h, 0}, {h, -h, 0}, {-h, -h, 0}};
}

}  // namespace bodyschema
