#include "common/geometry/pose.h"

#include <cmath>
#include <stdexcept>

namespace bodyschema {
namespace {

// Below this angle [rad] the trigonometric coefficients are taken from their Taylor series: the
// closed forms divide differences of nearly equal numbers by powers of the angle.
constexpr double kSmallAngle = 1e-2;

// sin(a)/a
double sinc(double a) {
  if (a > kSmallAngle) return std::sin(a) / a;
  const double a2 = a * a;
  return 1 - a2 / 6 * (1 - a2 / 20 * (1 - a2 / 42));
}

// (1 − cos a)/a²
double one_minus_cos(double a) {
  if (a > kSmallAngle) {
    const double s = std::sin(a / 2) / a;
    return 2 * s * s;
  }
  const double a2 = a * a;
  return 0.5 - a2 / 24 * (1 - a2 / 30 * (1 - a2 / 56));
}

// (a − sin a)/a³
double a_minus_sin(double a) {
  const double a2 = a * a;
  if (a > kSmallAngle) return (a - std::sin(a)) / (a2 * a);
  return 1.0 / 6 - a2 / 120 * (1 - a2 / 42 * (1 - a2 / 72));
}

// Coefficient of [w]×² in the inverse of the left Jacobian of SO(3): (1 − (a/2) cot(a/2))/a².
double inverse_coefficient(double a) {
  const double a2 = a * a;
  if (a > kSmallAngle) return (1 - a / 2 * std::cos(a / 2) / std::sin(a / 2)) / a2;
  return 1.0 / 12 + a2 / 720 * (1 + a2 / 42);
}

// Left Jacobian of SO(3): the V with exp(v, w) = (exp_so3(w), V v).
Eigen::Matrix3d left_jacobian_so3(const Eigen::Vector3d& w) {
  const double a = w.norm();
  const Eigen::Matrix3d W = skew(w);
  return Eigen::Matrix3d::Identity() + one_minus_cos(a) * W + a_minus_sin(a) * W * W;
}

Eigen::Matrix3d left_jacobian_so3_inverse(const Eigen::Vector3d& w) {
  const Eigen::Matrix3d W = skew(w);
  return Eigen::Matrix3d::Identity() - 0.5 * W + inverse_coefficient(w.norm()) * W * W;
}

}  // namespace

Pose make_pose(const Eigen::Quaterniond& q_AB, const Eigen::Vector3d& p_AB) {
  Pose X_AB = Pose::Identity();
  X_AB.linear() = q_AB.normalized().toRotationMatrix();
  X_AB.translation() = p_AB;
  return X_AB;
}

Eigen::Matrix3d skew(const Eigen::Vector3d& v) {
  Eigen::Matrix3d S;
  S << 0, -v.z(), v.y(), v.z(), 0, -v.x(), -v.y(), v.x(), 0;
  return S;
}

Eigen::Matrix3d exp_so3(const Eigen::Vector3d& w) {
  const double a = w.norm();
  const Eigen::Matrix3d W = skew(w);
  return Eigen::Matrix3d::Identity() + sinc(a) * W + one_minus_cos(a) * W * W;
}

Eigen::Matrix3d rotation_of_z_to(const Eigen::Vector3d& z) {
  return Eigen::Quaterniond::FromTwoVectors(Eigen::Vector3d::UnitZ(), z).toRotationMatrix();
}

Eigen::Vector3d log_so3(const Eigen::Matrix3d& R) {
  // By way of the quaternion, whose vector part stays well conditioned up to the angle π, where the
  // antisymmetric part of R vanishes.
  Eigen::Quaterniond q(R);
  if (q.w() < 0) q.coeffs() *= -1;
  const double s = q.vec().norm();
  if (s < 1e-10) return 2 * q.vec();
  return 2 * std::atan2(s, q.w()) / s * q.vec();
}

Pose exp(const Vector6d& xi) {
  Pose X = Pose::Identity();
  X.linear() = exp_so3(xi.tail<3>());
  X.translation() = left_jacobian_so3(xi.tail<3>()) * xi.head<3>();
  return X;
}

Vector6d log(const Pose& X) {
  Vector6d xi;
  xi.tail<3>() = log_so3(X.linear());
  xi.head<3>() = left_jacobian_so3_inverse(xi.tail<3>()) * X.translation();
  return xi;
}

Matrix6d adjoint(const Pose& X) {
  Matrix6d A;
  A.topLeftCorner<3, 3>() = X.linear();
  A.topRightCorner<3, 3>().noalias() = skew(X.translation()) * X.linear();
  A.bottomLeftCorner<3, 3>().setZero();
  A.bottomRightCorner<3, 3>() = X.linear();
  return A;
}

Matrix6d little_adjoint(const Vector6d& xi) {
  Matrix6d A;
  const Eigen::Matrix3d W = skew(xi.tail<3>());
  A.topLeftCorner<3, 3>() = W;
  A.topRightCorner<3, 3>() = skew(xi.head<3>());
  A.bottomLeftCorner<3, 3>().setZero();
  A.bottomRightCorner<3, 3>() = W;
  return A;
}

double squared_mahalanobis(const Vector6d& x, const Matrix6d& C) {
  return x.dot(C.ldlt().solve(x));
}

Matrix6d right_jacobian_inverse(const Vector6d& xi) {
  // The right Jacobian at ξ is the left one at −ξ. The left one is [J Q; 0 J] with J of SO(3) and
  // Q of Barfoot (7.86b), so its inverse is [J⁻¹ −J⁻¹QJ⁻¹; 0 J⁻¹].
  const Eigen::Vector3d v = -xi.head<3>();
  const Eigen::Vector3d w = -xi.tail<3>();
  const double a = w.norm();
  const double a2 = a * a;
  const Eigen::Matrix3d V = skew(v);
  const Eigen::Matrix3d W = skew(w);
  double c2, c3;  // (a² + 2cos a − 2)/(2a⁴) and (2a − 3 sin a + a cos a)/(2a⁵)
  if (a > 0.1) {
    c2 = (a2 / 2 + std::cos(a) - 1) / (a2 * a2);
    c3 = (2 * a - 3 * std::sin(a) + a * std::cos(a)) / (2 * a2 * a2 * a);
  } else {
    c2 = 1.0 / 24 - a2 / 720 * (1 - a2 / 56 * (1 - a2 / 90));
    c3 = 1.0 / 120 - a2 / 2520 * (1 - a2 / 48 * (1 - a2 / 82.5));
  }
  const Eigen::Matrix3d WV = W * V, VW = V * W, WVW = WV * W;
  const Eigen::Matrix3d Q = 0.5 * V + a_minus_sin(a) * (WV + VW + WVW) +
                            c2 * (W * WV + VW * W - 3 * WVW) + c3 * (WVW * W + W * WVW);
  const Eigen::Matrix3d J_inverse = left_jacobian_so3_inverse(w);
  Matrix6d result;
  result.topLeftCorner<3, 3>() = J_inverse;
  result.topRightCorner<3, 3>().noalias() = -J_inverse * Q * J_inverse;
  result.bottomLeftCorner<3, 3>().setZero();
  result.bottomRightCorner<3, 3>() = J_inverse;
  return result;
}

Eigen::Matrix3d nearest_rotation(const Eigen::Matrix3d& M) {
  if (!M.allFinite()) throw std::invalid_argument("nearest_rotation: matrix is not finite");
  const Eigen::JacobiSVD<Eigen::Matrix3d> svd(M, Eigen::ComputeFullU | Eigen::ComputeFullV);
  if (svd.singularValues()(1) <= 1e-12 * svd.singularValues()(0) || svd.singularValues()(0) == 0)
    throw std::invalid_argument("nearest_rotation: matrix has rank below 2");
  Eigen::Vector3d d(1, 1, 1);
  d(2) = (svd.matrixU() * svd.matrixV().transpose()).determinant() < 0 ? -1 : 1;
  return svd.matrixU() * d.asDiagonal() * svd.matrixV().transpose();
}

Eigen::Matrix3d rotation_from(const Eigen::Matrix3d& M) {
  const double error = (M * M.transpose() - Eigen::Matrix3d::Identity()).cwiseAbs().maxCoeff();
  if (!(error < 1e-6) || M.determinant() < 0)
    throw std::invalid_argument("rotation_from: matrix is not a rotation");
  return M;
}

double rotation_angle(const Pose& X) { return log_so3(X.linear()).norm(); }

Matrix6d relative_covariance(const Pose& z, const Matrix6d& covariance_i,
                             const Matrix6d& covariance_j) {
  const Matrix6d A = adjoint(z.inverse());
  return covariance_j + A * covariance_i * A.transpose();
}

}  // namespace bodyschema
