#include "common/schema/signal.h"

#include <algorithm>
#include <cmath>

namespace bodyschema {
namespace {

/// Position within the range, −1 … 1 between the limits; a range of no width has no position.
double position_in(const Signal& signal, double q) {
  const double half = 0.5 * (signal.upper - signal.lower);
  return half > 0 ? (q - signal.lower) / half - 1 : 0;
}

}  // namespace

Eigen::VectorXd warp_basis(double x, int size) {
  const double phase = 0.5 * M_PI * (1 + x / kWarpReach);
  Eigen::VectorXd phi(size);
  for (int n = 0; n < size; ++n) phi(n) = std::sin((n + 1) * phase);
  return phi;
}

Eigen::VectorXd warp_basis_rate(double x, int size) {
  const double phase = 0.5 * M_PI * (1 + x / kWarpReach);
  Eigen::VectorXd rate(size);
  for (int n = 0; n < size; ++n)
    rate(n) = (n + 1) * 0.5 * M_PI / kWarpReach * std::cos((n + 1) * phase);
  return rate;
}

double Signal::displacement(double q) const {
  if (warp.empty()) return q;
  const double x = std::clamp(position_in(*this, q), -1.0, 1.0);
  const Eigen::Map<const Eigen::VectorXd> w(warp.data(), static_cast<Eigen::Index>(warp.size()));
  return q + warp_basis(x, static_cast<int>(warp.size())).dot(w);
}

double Signal::displacement_rate(double q) const {
  const double half = 0.5 * (upper - lower);
  const double x = position_in(*this, q);
  if (warp.empty() || half <= 0 || x < -1 || x > 1) return 1;
  const Eigen::Map<const Eigen::VectorXd> w(warp.data(), static_cast<Eigen::Index>(warp.size()));
  return 1 + warp_basis_rate(x, static_cast<int>(warp.size())).dot(w) / half;
}

}  // namespace bodyschema
