#pragma once

#include <Eigen/Cholesky>
#include <Eigen/Core>
#include <optional>

#include "common/gp/kernel.h"

namespace bodyschema {

/// A Gaussian process before it saw data: y = f(x) + ε, f ~ GP(mean, kernel), ε ~ N(0,
/// noise_variance). A value: all that is needed beside the observations to make the fitted model
/// again.
struct GpPrior {
  /// Unit of y; none: a constant that is not known, to be estimated from the observations, with its
  /// uncertainty in every variance (a vague prior on it; Rasmussen and Williams, section 2.7).
  std::optional<double> mean;
  Kernel kernel;
  double noise_variance = 0;  ///< unit of y, squared; 0 is allowed

  /// The kernel's log-parameters, then log noise_variance: P + 1 values.
  Eigen::VectorXd log_parameters() const;
  /// @throws std::invalid_argument on a wrong number of values, or values beyond what exp() holds.
  GpPrior with_log_parameters(const Eigen::VectorXd& log_parameters) const;
};

/// What the other observations say about each one of them (Rasmussen and Williams, eq. 5.12).
struct GpLeaveOneOut {
  Eigen::VectorXd mean;      ///< N, expectation of y_i without y_i
  Eigen::VectorXd variance;  ///< N, of y_i − mean_i: the observation's own noise is in it
};

/// A Gaussian process conditioned on N observations (Rasmussen and Williams, algorithm 2.1). Inputs
/// are columns of a D×N matrix; N = 0 is the prior, if that has a mean. With K the covariance of
/// the observations, noise included:
///   mean(x) = m + k(x)ᵀ K⁻¹ (y − m),   cov(x, x') = k(x, x') − k(x)ᵀ K⁻¹ k(x').
/// Means and (co)variances are of the function, without the noise of a new observation.
///
/// K is factorised by Cholesky. Where a pivot falls below N·2⁻⁵²·max K_ii, that is, drowns in
/// rounding (equal inputs and no noise), a jitter of 1e-12, 1e-11, … 1e-6 times max K_ii is added
/// to the diagonal until none does. So there is always an answer, and it is finite.
class FittedGp {
 public:
  /// `noise_scales`, if not empty, multiplies the noise variance of each observation: 1/w for a
  /// robust weight w.
  /// @throws std::invalid_argument on shapes that do not go together, values that are not finite,
  /// a negative noise variance, noise scales not above 0, neither a mean nor observations.
  FittedGp(GpPrior prior, Eigen::MatrixXd inputs, const Eigen::VectorXd& targets,
           const Eigen::VectorXd& noise_scales = {});

  const GpPrior& prior() const { return prior_; }
  const Eigen::MatrixXd& inputs() const { return inputs_; }
  int num_observations() const { return static_cast<int>(inputs_.cols()); }
  /// What was added to K's diagonal; 0 as a rule.
  double jitter() const { return jitter_; }

  /// Three questions about the function at the columns of `x` (D×M): M means, M variances, and the
  /// M×M covariance, whose diagonal the variances are.
  Eigen::VectorXd mean(const Eigen::MatrixXd& x) const;
  Eigen::VectorXd marginal_variance(const Eigen::MatrixXd& x) const;
  Eigen::MatrixXd joint_covariance(const Eigen::MatrixXd& x) const;
  /// ∂mean/∂x at one point: D values.
  Eigen::VectorXd mean_gradient(const Eigen::VectorXd& x) const;

  /// In closed form; an unknown mean is estimated without the one that is left out.
  /// @throws std::invalid_argument for a single observation with an unknown mean.
  GpLeaveOneOut leave_one_out() const;

  /// log p(y | x, prior) [nats], if kernel and noise variance were both multiplied by `scale`. With
  /// an unknown mean: of the N − 1 contrasts in which it cancels (eq. 2.45).
  double log_marginal_likelihood(double scale = 1) const;
  /// Its derivatives with respect to GpPrior::log_parameters(): P + 1 values (eq. 5.9).
  Eigen::VectorXd log_marginal_likelihood_gradient(double scale = 1) const;
  /// The scale with the largest marginal likelihood: (y − m)ᵀK⁻¹(y − m) over N, with an unknown
  /// mean over N − 1; 0 where that is 0.
  double best_scale() const;

 private:
  int degrees_of_freedom() const { return num_observations() - (prior_.mean ? 0 : 1); }
  Eigen::VectorXd mean_influence(const Eigen::MatrixXd& k) const;
  Eigen::MatrixXd precision() const;

  GpPrior prior_;
  Eigen::MatrixXd inputs_;        // D×N
  Eigen::VectorXd targets_;       // y
  Eigen::VectorXd noise_scales_;  // N
  double jitter_ = 0;
  Eigen::LLT<Eigen::MatrixXd> llt_;  // of K
  double mean_ = 0;                  // m, known or estimated
  Eigen::VectorXd alpha_;            // K⁻¹ (y − m)
  // Of an unknown mean:
  Eigen::VectorXd mean_weights_;  // K⁻¹ 1
  double mean_information_ = 0;   // 1ᵀ K⁻¹ 1
};

}  // namespace bodyschema
