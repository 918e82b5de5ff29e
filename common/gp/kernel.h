#pragma once

#include <Eigen/Core>
#include <vector>

namespace bodyschema {

/// k(x, x') = variance · exp(−½ Σ_d (x_d − x'_d)²/ℓ_d²) with a length scale of its own for every
/// dimension of the input (automatic relevance determination; Rasmussen and Williams, "Gaussian
/// Processes for Machine Learning", eq. 5.1). Over no dimensions it is the constant `variance`.
struct SquaredExponential {
  double variance = 1;            ///< square of the function's unit
  Eigen::VectorXd length_scales;  ///< D, in units of the inputs
};

/// The covariance function of a Gaussian process: a sum of squared exponentials over the same
/// inputs, each a process of its own (a slow trend and a fine structure, say). Kernels add:
///   Kernel k = SquaredExponential{1, slow} + SquaredExponential{0.01, fine};
/// What is independent from observation to observation is not a function of the inputs: it is the
/// noise, which GpPrior has.
///
/// Points are columns: N inputs are a D×N matrix. The parameters are the logarithms of, term by
/// term, the variance and the D length scales: P = terms·(1 + D) in all.
class Kernel {
 public:
  /// @throws std::invalid_argument unless variance and length scales are finite and above 0.
  Kernel(SquaredExponential term);  // NOLINT: a squared exponential is a kernel

  const std::vector<SquaredExponential>& terms() const { return terms_; }
  int num_dimensions() const { return static_cast<int>(terms_.front().length_scales.size()); }
  int num_parameters() const;

  Eigen::VectorXd log_parameters() const;
  /// The same sum with other parameters. @throws std::invalid_argument as the constructor.
  Kernel with_log_parameters(const Eigen::VectorXd& log_parameters) const;

  /// k(x, x), the same everywhere.
  double variance() const;
  /// N_A×N_B matrix of k(a, b); `a` is D×N_A, `b` is D×N_B. @throws std::invalid_argument.
  Eigen::MatrixXd covariance(const Eigen::MatrixXd& a, const Eigen::MatrixXd& b) const;
  /// D×N matrix of ∂k(x, a)/∂x; `a` is D×N.
  Eigen::MatrixXd input_gradient(const Eigen::VectorXd& x, const Eigen::MatrixXd& a) const;
  /// Σ_st weights_st · ∂k(a_s, a_t)/∂parameter for each of the P log-parameters: all that a
  /// gradient of the marginal likelihood needs, without P matrices. `weights` is symmetric, N×N.
  Eigen::VectorXd weighted_parameter_gradient(const Eigen::MatrixXd& a,
                                              const Eigen::MatrixXd& weights) const;

  /// @throws std::invalid_argument unless both have the same number of dimensions.
  friend Kernel operator+(Kernel left, const Kernel& right);

 private:
  std::vector<SquaredExponential> terms_;  // at least one
};

Kernel operator+(Kernel left, const Kernel& right);

}  // namespace bodyschema
