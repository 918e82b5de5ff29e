#include "common/schema/signal.h"

#include <algorithm>
#include <cmath>
#include <utility>

namespace bodyschema {
namespace {

/// Position within the range, −1 … 1 between the limits; a range of no width has no position.
double position_in(const Signal& signal, double q) {
  const double half = 0.5 * (signal.upper - signal.lower);
  return half > 0 ? (q - signal.lower) / half - 1 : 0;
}

/// φ of the first sine.
double phase_of(double x) { return 0.5 * M_PI * (1 + x / kWarpReach); }

}  // namespace

Eigen::VectorXd warp_basis(double x, int size) {
  const double phase = phase_of(x);
  Eigen::VectorXd phi(size);
  for (int n = 0; n < size; ++n) phi(n) = std::sin((n + 1) * phase);
  return phi;
}

// Both sums by Clenshaw's recurrence, without memory and with one sine and cosine: Σ wₙ sin((n+1)φ)
// = b₁ sin φ and Σ wₙ cos((n+1)φ) = b₁ cos φ − b₂ with bₖ = wₖ + 2 cos φ bₖ₊₁ − bₖ₊₂. The phase
// stays clear of 0 and π, where it would lose digits.
double Signal::displacement(double q) const {
  if (warp.empty()) return q;
  const double phase = phase_of(std::clamp(position_in(*this, q), -1.0, 1.0));
  const double twice_cosine = 2 * std::cos(phase);
  double b1 = 0, b2 = 0;
  for (std::size_t n = warp.size(); n-- > 0;)
    b2 = std::exchange(b1, warp[n] + twice_cosine * b1 - b2);
  return q + b1 * std::sin(phase);
}

double Signal::displacement_rate(double q) const {
  const double half = 0.5 * (upper - lower);
  const double x = position_in(*this, q);
  if (warp.empty() || half <= 0 || x < -1 || x > 1) return 1;
  const double phase = phase_of(x), cosine = std::cos(phase);
  double b1 = 0, b2 = 0;
  for (std::size_t n = warp.size(); n-- > 0;)
    b2 = std::exchange(b1, static_cast<double>(n + 1) * warp[n] + 2 * cosine * b1 - b2);
  return 1 + 0.5 * M_PI / kWarpReach * (b1 * cosine - b2) / half;
}

void Signal::cover(double q) {
  if (!covered) covered = {q, q};
  covered->lower = std::min(covered->lower, q);
  covered->upper = std::max(covered->upper, q);
}

Eigen::VectorXd mid_range(const std::vector<Signal>& signals) {
  Eigen::VectorXd action(static_cast<Eigen::Index>(signals.size()));
  for (std::size_t s = 0; s < signals.size(); ++s)
    action(static_cast<Eigen::Index>(s)) = 0.5 * (signals[s].lower + signals[s].upper);
  return action;
}

Eigen::VectorXd normalized(const std::vector<Signal>& signals, const Eigen::VectorXd& action) {
  Eigen::VectorXd x(action.size());
  for (Eigen::Index s = 0; s < x.size(); ++s) {
    const Signal& signal = signals[static_cast<std::size_t>(s)];
    const double range = signal.upper - signal.lower;
    x(s) = range > 0 ? (2 * action(s) - signal.lower - signal.upper) / range : 0;
  }
  return x;
}

}  // namespace bodyschema
