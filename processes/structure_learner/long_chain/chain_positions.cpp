#include "processes/structure_learner/long_chain/chain_positions.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>

#include "common/estimation/levenberg_marquardt.h"
#include "common/estimation/quantile.h"

namespace bodyschema {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

// Scale of the heavy-tailed loss, of the positions' spread: as wide, of what can be left, as that
// of rotations.
constexpr double kLossScale = 0.3;
// Less is no noise and no motion [m].
constexpr double kExact = 3e-5;

// One free start in five succeeds; a fit costs ten times what one to rotations does.
constexpr ChainSearch::Effort kEffort{20, 1, 8, 0};

std::vector<bool> sliding(const ChainAxes& chain) {
  std::vector<bool> slides;
  for (const Vector3d& axis : chain.axes) slides.push_back(axis.isZero(0));
  return slides;
}

}  // namespace

Eigen::MatrixXd links_design(const ChainAxes& chain, const std::vector<bool>& slides,
                             const Eigen::MatrixXd& q) {
  const auto m = static_cast<Eigen::Index>(chain.signals.size());
  const auto num_slides = std::ranges::count(slides, true);
  Eigen::MatrixXd design(3 * q.cols(), 3 * (m + 1 + num_slides));
  for (Eigen::Index t = 0; t < q.cols(); ++t) {
    Matrix3d P = Matrix3d::Identity();
    auto rows = design.middleRows<3>(3 * t);
    rows.leftCols<3>().setIdentity();
    Eigen::Index slide_at = 3 * (m + 1);
    for (Eigen::Index j = 0; j < m; ++j) {
      const auto n = static_cast<std::size_t>(j);
      const double value = q(chain.signals[n], t);
      if (slides[n]) {
        rows.middleCols<3>(slide_at) = value * P;
        slide_at += 3;
      } else {
        P = P * exp_so3(chain.axes[n] * value);
      }
      rows.middleCols<3>(3 * (j + 1)) = P;
    }
  }
  return design;
}

// The links that fit given axes best. The weights are one round ahead of them: near the minimum
// these are the same.
struct PositionSearch::Projected {
  Eigen::MatrixXd design;
  Eigen::VectorXd weights, links, residual;
  Eigen::LDLT<Eigen::MatrixXd> normal;
  double cost = 0, median_left = 0;
};

PositionSearch::PositionSearch(const PairData& pair, const NormalizedActions& actions,
                               int max_frames, double sigma_m)
    : ChainSearch(pair, actions, max_frames, kEffort),
      positions_(3 * num_frames()),
      ridge_(std::pow(std::max(sigma_m, kExact) / kLongestLink, 2)) {
  Vector3d middle = Vector3d::Zero();
  for (int k = 0; k < num_frames(); ++k)
    positions_.segment<3>(3 * k) =
        pair.primary(frames_[static_cast<std::size_t>(k)]).z.translation();
  std::vector<double> values;
  for (int axis = 0; axis < 3 && num_frames() > 0; ++axis) {
    values.clear();
    for (int k = 0; k < num_frames(); ++k) values.push_back(positions_(3 * k + axis));
    middle(axis) = median(values);
  }
  values.clear();
  for (int k = 0; k < num_frames(); ++k)
    values.push_back((positions_.segment<3>(3 * k) - middle).norm());
  if (!values.empty()) spread_ = median(std::move(values));
  loss_scale_ = std::max(kLossScale * spread_, kExact);
}

PositionSearch::Projected PositionSearch::projected(const ChainAxes& chain,
                                                    Eigen::VectorXd weights) const {
  constexpr int kRounds = 2;
  Projected result;
  result.design = links_design(chain, sliding(chain), q_);
  result.weights = std::move(weights);
  std::vector<double> left;
  for (int round = 0; round < kRounds; ++round) {
    const Eigen::MatrixXd weighted = result.weights.asDiagonal() * result.design;
    Eigen::MatrixXd H = weighted.transpose() * result.design;
    H.diagonal().array() += ridge_;
    result.normal.compute(H);
    result.links = result.normal.solve(weighted.transpose() * positions_);
    result.residual = positions_ - result.design * result.links;
    result.cost = 0;
    left.clear();
    for (int k = 0; k < num_frames(); ++k) {
      const double e = result.residual.segment<3>(3 * k).norm() / loss_scale_;
      left.push_back(loss_scale_ * e);
      result.cost += 0.5 * loss_scale_ * loss_scale_ * std::log1p(e * e);
      result.weights.segment<3>(3 * k).setConstant(1 / (1 + e * e));
    }
  }
  result.median_left = left.empty() ? 0 : upper_median(std::move(left));
  return result;
}

// Of the positions by the parameters of the axes, the links as they are.
Eigen::MatrixXd PositionSearch::jacobian(const ChainAxes& chain,
                                         const std::vector<Eigen::MatrixXd>& bases,
                                         const Eigen::VectorXd& links) const {
  const std::size_t m = chain.signals.size();
  Eigen::Index size = 0;
  for (const Eigen::MatrixXd& basis : bases) size += basis.cols();
  Eigen::MatrixXd J(3 * num_frames(), size);
  std::vector<Matrix3d> steps(m);
  std::vector<Vector3d> rest(m + 1);  // what follows joint j, in its frame after the turn
  for (int k = 0; k < num_frames(); ++k) {
    rest[m] = links.segment<3>(static_cast<Eigen::Index>(3 * m));
    Eigen::Index slide_at = links.size();
    for (std::size_t j = m; j-- > 0;) {
      const double value = q_(chain.signals[j], k);
      const bool slides = bases[j].cols() == 0;
      if (slides) slide_at -= 3;
      steps[j] = slides ? Matrix3d::Identity() : exp_so3(chain.axes[j] * value);
      rest[j] = links.segment<3>(static_cast<Eigen::Index>(3 * j)) + steps[j] * rest[j + 1];
      if (slides) rest[j] += value * links.segment<3>(slide_at);
    }
    Matrix3d P = Matrix3d::Identity();
    Eigen::Index at = 0;
    for (std::size_t j = 0; j < m; ++j) {
      const double value = q_(chain.signals[j], k);
      P = P * steps[j];
      if (bases[j].cols() == 0) continue;
      J.block(3 * k, at, 3, bases[j].cols()).noalias() =
          -P * skew(rest[j + 1]) * (value * right_jacobian_so3(chain.axes[j] * value)) * bases[j];
      at += bases[j].cols();
    }
  }
  return J;
}

ChainAxes PositionSearch::fit(ChainAxes chain, bool holds_lengths, int max_iterations) const {
  LevenbergMarquardt optimizer(1e-3, 1e-9, 6);
  Projected now = projected(chain, Eigen::VectorXd::Ones(positions_.size()));
  for (int iteration = 0; iteration < max_iterations; ++iteration) {
    std::vector<Eigen::MatrixXd> bases = axis_bases(chain, holds_lengths);
    for (std::size_t j = 0; j < bases.size(); ++j)
      if (chain.axes[j].isZero(0)) bases[j].resize(3, 0);
    Eigen::MatrixXd J = jacobian(chain, bases, now.links);
    if (J.cols() == 0) break;
    const Eigen::MatrixXd weighted = now.weights.asDiagonal() * J;
    J -= now.design * now.normal.solve(now.design.transpose() * weighted);
    const Eigen::MatrixXd H = J.transpose() * now.weights.asDiagonal() * J;
    const Eigen::VectorXd g = -J.transpose() * now.weights.cwiseProduct(now.residual);
    double decrease = 0;
    const bool improved = optimizer.step(H, g, [&](const Eigen::VectorXd& step) {
      ChainAxes moved = with_axes_moved(chain, bases, step, holds_lengths);
      Projected next = projected(moved, now.weights);
      if (!(next.cost < now.cost)) return false;
      decrease = now.cost - next.cost;
      chain = std::move(moved);
      now = std::move(next);
      return true;
    });
    if (!improved || decrease < 1e-6 * now.cost + 1e-15) break;
    // Stuck far from a minimum that explains anything.
    if (iteration >= 12 && decrease < 1e-3 * now.cost) break;
  }
  chain.cost = now.cost;
  chain.median_left = now.median_left;
  return chain;
}

}  // namespace bodyschema
