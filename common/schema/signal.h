#pragma once

#include <Eigen/Core>
#include <optional>
#include <string>
#include <vector>

namespace bodyschema {

/// An action signal as the learners know it.
struct Signal {
  std::string name;
  /// Limits in command units.
  double lower = 0;
  double upper = 0;
  /// What bends the command, w in θ(q) = q + φ(q)ᵀw [command units]; empty: linear. θ, and not q,
  /// is what moves the joints on this signal. See warp_basis().
  std::vector<double> warp = {};
  /// What the samples that a schema rests on covered of it [command units], see
  /// BodySchema::set_covered(): beyond, it was never seen to hold. std::nullopt: nobody said
  /// (messages and files then have the limits).
  struct Range {
    double lower = 0, upper = 0;
  };
  std::optional<Range> covered = {};
  /// `covered` with one value more.
  void cover(double q);
  /// `covered`, or the limits.
  Range known_range() const { return covered.value_or(Range{lower, upper}); }

  /// Displacement θ(q) that belongs to the command q, both in command units.
  double displacement(double q) const;
  /// dθ/dq.
  double displacement_rate(double q) const;
};

/// The action with every signal in the middle of its range.
Eigen::VectorXd mid_range(const std::vector<Signal>& signals);

/// Where each signal is in its range, −1..1 between the limits; 0 in a range of no width.
Eigen::VectorXd normalized(const std::vector<Signal>& signals, const Eigen::VectorXd& action);

/// φ_n(q) = sin(½nπ (1 + x/kWarpReach)), n = 1 … size, with x = −1 … 1 over the signal's range: the
/// sines that vanish kWarpReach half ranges from the middle. With variances that fall as a
/// covariance function's spectral density does, they are a Gaussian process (Solin and Särkkä,
/// Hilbert space methods for reduced-rank Gaussian process regression, 2020). Beyond the limits the
/// warp stays what it is there.
Eigen::VectorXd warp_basis(double x, int size);
inline constexpr double kWarpReach = 1.3;

}  // namespace bodyschema
