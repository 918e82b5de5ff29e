#pragma once

#include <vector>

#include "common/geometry/pose.h"
#include "common/gp/gp.h"

namespace bodyschema {

/// The chapter's local model (Section 3.1, eq. 7): the 12 entries of the homogeneous matrix
/// (R p) of Δ_ij are 12 independent Gaussian processes of the action signals in Q; the rotation is
/// ortho-normalised by singular value decomposition, R̂ = nearest rotation. Without signals it is a
/// rigid connection: 12 means.
///
/// Independent entries are the chapter's approximation, not the truth: what disturbs a rotation
/// moves its nine entries together. So the rotation's covariances below come out about a third of
/// what they should be (the translation's are right), one reason to prefer empirical_covariance().
///
/// A value that never changes, made of hyper-parameters and samples alone; the factorisations
/// follow from these. That is what has to travel.
class MatrixGp {
 public:
  static constexpr int kNumEntries = 12;
  static constexpr int kMaxSamples = 64;  ///< of one that travels; it may have more

  /// `signals`: the D indices of Q into an action; `inputs`: D×N, their values in command units;
  /// `poses`: the N observed z_ij; `priors`: of the 12 entries, column by column of the 3×4 matrix
  /// (R p), rotation entries plain, translation in metres.
  /// @throws std::invalid_argument on shapes that do not go together, N = 0 or values that are not
  /// finite.
  MatrixGp(std::vector<int> signals, Eigen::MatrixXd inputs, std::vector<Pose> poses,
           std::vector<GpPrior> priors);

  const std::vector<int>& signals() const { return signals_; }
  const Eigen::MatrixXd& inputs() const { return inputs_; }
  const std::vector<Pose>& poses() const { return poses_; }
  /// By value: what was written and read again is the same.
  bool operator==(const MatrixGp& other) const;
  int num_samples() const { return static_cast<int>(poses_.size()); }
  const GpPrior& prior(int entry) const { return entries_.at(entry).prior(); }

  /// All of these take the whole action (m values). @throws std::invalid_argument if it lacks a
  /// signal of Q, or that is not finite.
  Pose predict(const Eigen::VectorXd& action) const;
  /// 6×m, right perturbation: predict(q + δ) = predict(q) · exp(J δ + O(δ²)). Through the
  /// projection to the nearest rotation it is exact: with M = U S Vᵀ, A = Uᵀ(∂M)V and Ω_ij = (A_ij
  /// − A_ji)/(s_i + s_j), the derivative of the rotation is U Ω Vᵀ.
  Eigen::MatrixXd jacobian(const Eigen::VectorXd& action) const;
  /// First-order covariance of predict() from the posterior variances of the entries; right
  /// perturbation. What is uncertain is the model: noise of a new observation is not in it.
  Matrix6d prediction_covariance(const Eigen::VectorXd& action) const;

  /// What the model says about each sample without that sample, in closed form.
  struct LeaveOneOut {
    /// log(Δ̂₋ₜ⁻¹ z_t): (translation [m], rotation [rad]).
    std::vector<Vector6d> residual;
    /// First-order covariance of the residual, noise of the observation included.
    std::vector<Matrix6d> covariance;
  };
  /// The hyper-parameters stay as they are. There must be two samples.
  LeaveOneOut leave_one_out() const;

 private:
  Eigen::VectorXd input_of(const Eigen::VectorXd& action) const;

  std::vector<int> signals_;
  Eigen::MatrixXd inputs_;  // D×N
  std::vector<Pose> poses_;
  std::vector<FittedGp> entries_;  // 12
};

/// Mean square of leave-one-out residuals: the global estimate of a model's uncertainty that the
/// chapter prefers to local variances (Section 3.3). There must be a residual.
Matrix6d empirical_covariance(const std::vector<Vector6d>& residuals);

}  // namespace bodyschema
