#include "common/schema/warp_process.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>

namespace bodyschema {
namespace {

constexpr double kApart = 0.01;  // half ranges; chosen: far less than the shortest of kWarpLengths
/// A parameter beside the weights is free within this many half ranges; chosen: far more than any.
constexpr double kFree = 10;

/// Mean and log marginal likelihood, up to what all variances have in common, of as many
/// parameters as there are prior variances.
WarpProcess posterior(const Eigen::MatrixXd& A, const Eigen::VectorXd& b,
                      const Eigen::VectorXd& prior_variance) {
  const auto p = prior_variance.size();
  const Eigen::VectorXd root = prior_variance.cwiseSqrt();
  Eigen::MatrixXd H = root.asDiagonal() * A.topLeftCorner(p, p) * root.asDiagonal();
  H.diagonal().array() += 1;
  const Eigen::LLT<Eigen::MatrixXd> llt(H);
  const Eigen::VectorXd c = root.cwiseProduct(b.head(p));
  const Eigen::VectorXd solved = llt.solve(c);
  return {root.cwiseProduct(solved), prior_variance,
          0.5 * c.dot(solved) - llt.matrixLLT().diagonal().array().log().sum()};
}

}  // namespace

int num_positions_apart(std::vector<double> positions) {
  std::sort(positions.begin(), positions.end());
  int count = 0;
  double last = -std::numeric_limits<double>::infinity();
  for (const double position : positions) {
    if (position - last < kApart) continue;
    ++count;
    last = position;
  }
  return count;
}

Eigen::ArrayXd warp_spectrum(double length, Eigen::Index size) {
  const Eigen::ArrayXd omega =
      Eigen::ArrayXd::LinSpaced(size, 1, static_cast<double>(size)) * M_PI / (2 * kWarpReach);
  return std::sqrt(2 * M_PI) * length * (-0.5 * (omega * length).square()).exp() / kWarpReach;
}

std::vector<WarpProcess> warp_processes(const Eigen::MatrixXd& A, const Eigen::VectorXd& b,
                                        int num_others) {
  const auto size = A.rows();
  Eigen::VectorXd variance = Eigen::VectorXd::Constant(size, kFree * kFree);
  const double straight = posterior(A, b, variance.head(num_others)).evidence;
  std::vector<WarpProcess> result;
  for (const double length : kWarpLengths) {
    for (const double amplitude : kWarpAmplitudes) {
      variance.tail(size - num_others) =
          amplitude * amplitude * warp_spectrum(length, size - num_others);
      result.push_back(posterior(A, b, variance));
      result.back().evidence -= straight;
    }
  }
  return result;
}

}  // namespace bodyschema
