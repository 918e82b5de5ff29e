#pragma once

#include <vector>

#include "common/geometry/pose.h"
#include "common/gp/gp.h"

namespace bodyschema {

/// What a chain of screws leaves of a soft or elastic connection: ρ(θ) in the tangent space, so
/// that Δ(θ) = Δ_screw(θ) · Exp(ρ(θ)). The six coordinates of ρ (translation [m], rotation [rad])
/// are Gaussian processes about zero of any number of action signals. They share the length scales,
/// for they are one body's bending, and differ in variance.
///
/// A value that never changes, made of hyper-parameters and at most kMaxSamples samples; the
/// factorisations follow from these. That is what travels.
class ResidualGp {
 public:
  static constexpr int kMaxSamples = 256;

  struct Prior {
    Eigen::VectorXd length_scales;                ///< D, command units
    Vector6d variances = Vector6d::Ones();        ///< of ρ [m², rad²]
    Vector6d noise_variances = Vector6d::Ones();  ///< of one sample of weight 1 [m², rad²]
  };
  using Residuals = Eigen::Matrix<double, 6, Eigen::Dynamic>;

  /// `signals`: the D indices into an action; `inputs`: D×N, their displacements in command units;
  /// `residuals`: 6×N, Log(Δ_screw⁻¹ z); `noise_scales`: N, what multiplies the noise of each: 1/w
  /// for a robust weight w, without which one flipped marker bends the body.
  /// @throws std::invalid_argument on shapes that do not go together, N = 0 or above kMaxSamples,
  /// values that are not finite, hyper-parameters that are not above 0.
  ResidualGp(std::vector<int> signals, Eigen::MatrixXd inputs, Residuals residuals,
             Eigen::VectorXd noise_scales, Prior prior);

  const std::vector<int>& signals() const { return signals_; }
  const Eigen::MatrixXd& inputs() const { return inputs_; }
  const Residuals& residuals() const { return residuals_; }
  const Eigen::VectorXd& noise_scales() const { return noise_scales_; }
  const Prior& prior() const { return prior_; }
  /// By value, to the last bit: what was written and read again is the same.
  bool operator==(const ResidualGp& other) const;
  int num_samples() const { return static_cast<int>(inputs_.cols()); }

  /// All of these take the displacements of all signals (m values). @throws std::invalid_argument
  /// if one of `signals` is not among them.
  Vector6d mean(const Eigen::VectorXd& theta) const;
  /// 6×m: ∂mean/∂θ.
  Eigen::MatrixXd mean_gradient(const Eigen::VectorXd& theta) const;
  /// Of the function: the noise of a new observation is not in it.
  Vector6d variance(const Eigen::VectorXd& theta) const;

 private:
  Eigen::VectorXd input_of(const Eigen::VectorXd& theta) const;

  std::vector<int> signals_;
  Eigen::MatrixXd inputs_;  // D×N
  Residuals residuals_;
  Eigen::VectorXd noise_scales_;
  Prior prior_;
  std::vector<FittedGp> coordinates_;  // 6
};

}  // namespace bodyschema
