#pragma once

#include <Eigen/Geometry>

#include "common/geometry/instantiations.h"

namespace bodyschema {

using Vector6d = Eigen::Matrix<double, 6, 1>;
using Matrix6d = Eigen::Matrix<double, 6, 6>;

/// A rigid transform. `X_AB` is the pose of frame B in frame A: p_AQ = X_AB * p_BQ.
using Pose = Eigen::Isometry3d;

/// The pose with rotation `q_AB` (normalised here) and origin `p_AB` [m].
Pose make_pose(const Eigen::Quaterniond& q_AB, const Eigen::Vector3d& p_AB);

/// The 3×3 matrix [v]× with [v]× w = v × w.
Eigen::Matrix3d skew(const Eigen::Vector3d& v);

/// Rotation of angle |w| [rad] about w.
Eigen::Matrix3d exp_so3(const Eigen::Vector3d& w);

/// The shortest rotation that takes the z axis to the direction of `z`.
Eigen::Matrix3d rotation_of_z_to(const Eigen::Vector3d& z);

/// Inverse of exp_so3, |result| ≤ π [rad]. `R` must be a rotation.
Eigen::Vector3d log_so3(const Eigen::Matrix3d& R);

/// SE(3) exponential of a tangent vector ξ = (translation [m], rotation [rad]).
Pose exp(const Vector6d& xi);

/// SE(3) logarithm: exp(log(X)) = X, rotation part of length ≤ π.
Vector6d log(const Pose& X);

/// Ad(X) for ξ = (translation, rotation): X · exp(ξ) · X⁻¹ = exp(Ad(X) ξ).
Matrix6d adjoint(const Pose& X);

/// ad(ξ), the derivative of Ad(exp(tξ)) at t = 0.
Matrix6d little_adjoint(const Vector6d& xi);

/// xᵀ C⁻¹ x, the squared Mahalanobis distance of x from 0: χ²₆ if C is its covariance.
double squared_mahalanobis(const Vector6d& x, const Matrix6d& C);

/// Inverse of the right Jacobian: log(exp(ξ) exp(δ)) = ξ + right_jacobian_inverse(ξ) δ + O(δ²).
/// Closed form (Barfoot, "State Estimation for Robotics", 7.1.5); valid for |rotation| < 2π.
Matrix6d right_jacobian_inverse(const Vector6d& xi);

/// The rotation closest to `M` in the Frobenius norm (SVD).
/// @throws std::invalid_argument if `M` has no closest rotation (not finite or rank < 2).
Eigen::Matrix3d nearest_rotation(const Eigen::Matrix3d& M);

/// `M` itself if it is a rotation within 1e-6. @throws std::invalid_argument otherwise.
Eigen::Matrix3d rotation_from(const Eigen::Matrix3d& M);

/// Rotation angle of X [rad], in [0, π].
double rotation_angle(const Pose& X);

/// Covariance of z_ij = y_i⁻¹ y_j from the covariances of y_i and y_j (each a right perturbation in
/// its own part's frame): Σ_z = Σ_j + Ad(z⁻¹) Σ_i Ad(z⁻¹)ᵀ. The lever arm is in the adjoint.
Matrix6d relative_covariance(const Pose& z, const Matrix6d& covariance_i,
                             const Matrix6d& covariance_j);

}  // namespace bodyschema
