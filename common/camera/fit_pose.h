#pragma once

#include <Eigen/Core>
#include <optional>
#include <vector>

#include "common/camera/lens.h"
#include "common/geometry/pose.h"

namespace bodyschema {

/// A local minimum of the reprojection error of a body B's points.
struct PoseFit {
  Pose X_CB = Pose::Identity();
  double rms_sigma =
      0;  ///< root mean square of the (whitened) residual over the 2n coordinates [sigmas]
  /// JᵀJ of the residual, right perturbation in B, order (translation [m], rotation [rad]): its
  /// inverse is the covariance of X_CB.
  Matrix6d information = Matrix6d::Zero();
};

/// Covariance of a tag's corners (x0, y0, …, x3, y3) [px²].
using Matrix8d = Eigen::Matrix<double, 8, 8>;

/// One standard deviation for all coordinates of corners with that covariance [px] …
double sigma_px(const Matrix8d& corner_covariance_px2);
/// … and fit_pose()'s whitener for points with that sigma_px. The covariance is positive definite.
Matrix8d whitener_of(const Matrix8d& corner_covariance_px2);

/// Where the points `p_BP` of body B, posed at X_CB, are seen, minus where they were measured:
/// 2n values in units of their standard deviations; nothing if a point lies behind the camera.
/// `jacobian`, if given, receives the 2n×6 derivative with respect to ξ in X_CB · exp(ξ).
std::optional<Eigen::VectorXd> reprojection_residual(
    const Pose& X_CB, const std::vector<Eigen::Vector3d>& p_BP,
    const std::vector<ImagePoint>& measured, Eigen::Matrix<double, Eigen::Dynamic, 6>* jacobian);

/// Levenberg–Marquardt from `start` down to the local minimum of the reprojection error of at least
/// 3 points; nothing if the start has a point behind the camera or the points do not determine the
/// pose. Where the errors of the n points are correlated, `whitener` (2n × 2n) is the inverse of
/// the Cholesky factor of their covariance, in units of the points' sigma_px.
std::optional<PoseFit> fit_pose(const Pose& start, const std::vector<Eigen::Vector3d>& p_BP,
                                const std::vector<ImagePoint>& measured,
                                const Eigen::MatrixXd* whitener = nullptr);

/// (JᵀJ)⁻¹, exactly symmetric. std::nullopt if the information is singular.
std::optional<Matrix6d> covariance_from(const Matrix6d& information);

/// True if both are the same minimum, found from two starts: two different minima of a planar
/// target are never closer than this in rotation.
bool is_same_minimum(const Pose& a, const Pose& b);

/// How well the corners of a tag are known. Where the tag is so small or steep that blur mixes its
/// cells, the corners are pulled by the bits next to the border: a bias that grows as the cells
/// shrink, measured to go with 1/side² of the shortest side.
struct CornerNoise {
  double corner_noise_px = 0;     ///< standard deviation of a coordinate, of any tag …
  double small_tag_noise_px = 0;  ///< … and what a tag with a side of 20 px has beside it

  /// Standard deviation of each coordinate of a tag with these 4 corners [px].
  double sigma_px(const std::vector<Eigen::Vector2d>& corners_px) const;
};

/// Length of the shortest side of the quadrangle [px].
double shortest_side_px(const std::vector<Eigen::Vector2d>& corners_px);

/// Corners of a tag of side `size_m` in its own frame M, AprilTag's order: (−,+) (+,+) (+,−) (−,−).
std::vector<Eigen::Vector3d> tag_corners(double size_m);

}  // namespace bodyschema
