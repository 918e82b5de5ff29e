#include "common/schema/matrix_gp.h"

#include <Eigen/SVD>
#include <algorithm>
#include <stdexcept>
#include <string>

namespace bodyschema {
namespace {

using Matrix34d = Eigen::Matrix<double, 3, 4>;
using Entries = Eigen::Matrix<double, MatrixGp::kNumEntries, 1>;  // columns of (R p)

Entries entries_of(const Pose& X) {
  const Matrix34d M = X.matrix().topRows<3>();
  return Eigen::Map<const Entries>(M.data());
}

// The rotation nearest to M and its derivative. Where several are equally near (two poses half a
// turn apart, averaged) it is one of them: a prediction is wrong there, but never undefined.
class NearestRotation {
 public:
  explicit NearestRotation(const Eigen::Matrix3d& M) {
    if (!M.allFinite()) throw std::invalid_argument("matrix GP: the action is not finite");
    const Eigen::JacobiSVD<Eigen::Matrix3d> svd(M, Eigen::ComputeFullU | Eigen::ComputeFullV);
    U_ = svd.matrixU();
    V_ = svd.matrixV();
    if (U_.determinant() * V_.determinant() < 0) U_.col(2) *= -1;
    s_ = (U_.transpose() * M * V_).diagonal();  // M = U S Vᵀ
    rotation_ = U_ * V_.transpose();
  }

  const Eigen::Matrix3d& rotation() const { return rotation_; }

  // ω with dR = R [ω]× for the change dM.
  Eigen::Vector3d rate(const Eigen::Matrix3d& dM) const {
    const Eigen::Matrix3d A = U_.transpose() * dM * V_;
    Eigen::Matrix3d Omega;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        Omega(i, j) = (A(i, j) - A(j, i)) / std::max(s_(i) + s_(j), 1e-9 * s_(0) + 1e-300);
    const Eigen::Matrix3d W = V_ * Omega * V_.transpose();  // Rᵀ dR
    return {W(2, 1), W(0, 2), W(1, 0)};
  }

 private:
  Eigen::Matrix3d U_, V_, rotation_;
  Eigen::Vector3d s_;  // the last one negative where M is nearer to a reflection
};

Pose pose_of(const NearestRotation& nearest, const Entries& entries) {
  Pose X = Pose::Identity();
  X.linear() = nearest.rotation();
  X.translation() = entries.tail<3>();
  return X;
}

Eigen::Matrix3d rotation_entries(const Entries& entries) {
  return Eigen::Map<const Eigen::Matrix3d>(entries.data());
}

// ∂(right perturbation of the projected pose)/∂entries.
Eigen::Matrix<double, 6, MatrixGp::kNumEntries> projection_jacobian(
    const NearestRotation& nearest) {
  Eigen::Matrix<double, 6, MatrixGp::kNumEntries> J;
  J.setZero();
  for (int e = 0; e < 9; ++e) {
    Eigen::Matrix3d dM = Eigen::Matrix3d::Zero();
    dM(e % 3, e / 3) = 1;
    J.col(e).tail<3>() = nearest.rate(dM);
  }
  J.topRightCorner<3, 3>() = nearest.rotation().transpose();
  return J;
}

}  // namespace

MatrixGp::MatrixGp(std::vector<int> signals, Eigen::MatrixXd inputs, std::vector<Pose> poses,
                   std::vector<GpPrior> priors)
    : signals_(std::move(signals)), inputs_(std::move(inputs)), poses_(std::move(poses)) {
  const auto D = static_cast<Eigen::Index>(signals_.size());
  const auto N = static_cast<Eigen::Index>(poses_.size());
  if (inputs_.rows() != D || inputs_.cols() != N || N == 0 || priors.size() != kNumEntries)
    throw std::invalid_argument(
        "matrix GP: " + std::to_string(D) + " signals and " + std::to_string(N) +
        " poses do not go with inputs of " + std::to_string(inputs_.rows()) + "×" +
        std::to_string(inputs_.cols()) + " and " + std::to_string(priors.size()) + " priors");
  if (std::any_of(signals_.begin(), signals_.end(), [](int s) { return s < 0; }))
    throw std::invalid_argument("matrix GP: a signal's index is below 0");
  Eigen::MatrixXd targets(N, kNumEntries);
  for (Eigen::Index t = 0; t < N; ++t) targets.row(t) = entries_of(poses_[t]);
  entries_.reserve(kNumEntries);
  for (int e = 0; e < kNumEntries; ++e)
    entries_.emplace_back(std::move(priors[e]), inputs_, targets.col(e));
}

Eigen::VectorXd MatrixGp::input_of(const Eigen::VectorXd& action) const {
  Eigen::VectorXd x(signals_.size());
  for (std::size_t d = 0; d < signals_.size(); ++d) {
    if (signals_[d] >= action.size())
      throw std::invalid_argument("action has no signal " + std::to_string(signals_[d]));
    x(d) = action(signals_[d]);
  }
  return x;
}

Pose MatrixGp::predict(const Eigen::VectorXd& action) const {
  const Eigen::VectorXd x = input_of(action);
  Entries mean;
  for (int e = 0; e < kNumEntries; ++e) mean(e) = entries_[e].mean(x)(0);
  return pose_of(NearestRotation(rotation_entries(mean)), mean);
}

Eigen::MatrixXd MatrixGp::jacobian(const Eigen::VectorXd& action) const {
  if (signals_.empty()) return Eigen::MatrixXd::Zero(6, action.size());
  const Eigen::VectorXd x = input_of(action);
  Entries mean;
  Eigen::Matrix<double, kNumEntries, Eigen::Dynamic> gradient(kNumEntries, x.size());
  for (int e = 0; e < kNumEntries; ++e) {
    mean(e) = entries_[e].mean(x)(0);
    gradient.row(e) = entries_[e].mean_gradient(x).transpose();
  }
  const Eigen::MatrixXd by_input =
      projection_jacobian(NearestRotation(rotation_entries(mean))) * gradient;
  Eigen::MatrixXd J = Eigen::MatrixXd::Zero(6, action.size());
  for (std::size_t d = 0; d < signals_.size(); ++d) J.col(signals_[d]) += by_input.col(d);
  return J;
}

Matrix6d MatrixGp::prediction_covariance(const Eigen::VectorXd& action) const {
  const Eigen::VectorXd x = input_of(action);
  Entries mean, variance;
  for (int e = 0; e < kNumEntries; ++e) {
    mean(e) = entries_[e].mean(x)(0);
    variance(e) = entries_[e].marginal_variance(x)(0);
  }
  const auto G = projection_jacobian(NearestRotation(rotation_entries(mean)));
  return G * variance.asDiagonal() * G.transpose();
}

MatrixGp::LeaveOneOut MatrixGp::leave_one_out() const {
  const int N = num_samples();
  if (N < 2) throw std::invalid_argument("matrix GP: leave-one-out needs two samples");
  Eigen::MatrixXd mean(N, kNumEntries), variance(N, kNumEntries);
  for (int e = 0; e < kNumEntries; ++e) {
    const GpLeaveOneOut loo = entries_[e].leave_one_out();
    mean.col(e) = loo.mean;
    variance.col(e) = loo.variance;
  }
  LeaveOneOut result;
  for (int t = 0; t < N; ++t) {
    const Entries entries = mean.row(t);
    const NearestRotation nearest(rotation_entries(entries));
    const auto G = projection_jacobian(nearest);
    result.residual.push_back(log(pose_of(nearest, entries).inverse() * poses_[t]));
    result.covariance.push_back(G * variance.row(t).asDiagonal() * G.transpose());
  }
  return result;
}

Matrix6d empirical_covariance(const std::vector<Vector6d>& residuals) {
  if (residuals.empty()) throw std::invalid_argument("empirical covariance: no residuals");
  Matrix6d sum = Matrix6d::Zero();
  for (const Vector6d& r : residuals) sum += r * r.transpose();
  return sum / static_cast<double>(residuals.size());
}

bool MatrixGp::operator==(const MatrixGp& other) const {
  // Quaternions on the wire round.
  const auto is_same_pose = [](const Pose& x, const Pose& y) { return x.isApprox(y, 1e-12); };
  const auto is_same_entry = [](const FittedGp& x, const FittedGp& y) {
    return x.prior().mean == y.prior().mean &&
           x.prior().log_parameters() == y.prior().log_parameters();
  };
  return signals_ == other.signals_ && num_samples() == other.num_samples() &&
         inputs_ == other.inputs_ &&
         std::equal(poses_.begin(), poses_.end(), other.poses_.begin(), is_same_pose) &&
         std::equal(entries_.begin(), entries_.end(), other.entries_.begin(), is_same_entry);
}

}  // namespace bodyschema
