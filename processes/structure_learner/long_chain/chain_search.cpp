#include "processes/structure_learner/long_chain/chain_search.h"

#include <algorithm>
#include <cmath>

namespace bodyschema {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

constexpr int kSearchIterations = 60;
// Of lengths held, largest turn of an axis a step.
constexpr double kLargestStep = 0.7;

}  // namespace

Eigen::Matrix3d right_jacobian_so3(const Vector3d& w) {
  const double angle2 = w.squaredNorm(), angle = std::sqrt(angle2);
  const Matrix3d W = skew(w);
  if (angle < 1e-4) return Matrix3d::Identity() - 0.5 * W + W * W / 6;
  return Matrix3d::Identity() - (1 - std::cos(angle)) / angle2 * W +
         (angle - std::sin(angle)) / (angle2 * angle) * W * W;
}

std::vector<Eigen::MatrixXd> axis_bases(const ChainAxes& chain, bool holds_lengths) {
  std::vector<Eigen::MatrixXd> bases(chain.axes.size(), Matrix3d::Identity());
  for (std::size_t j = 0; holds_lengths && j < bases.size(); ++j) {
    const double length = chain.axes[j].norm();
    const Vector3d u = chain.axes[j] / std::max(length, 1e-12);
    const Vector3d across = u.unitOrthogonal();
    bases[j].resize(3, 2);
    bases[j] << length * across, length * u.cross(across);
  }
  return bases;
}

ChainAxes with_axes_moved(const ChainAxes& chain, const std::vector<Eigen::MatrixXd>& bases,
                          const Eigen::VectorXd& step, bool holds_lengths) {
  ChainAxes moved = chain;
  Eigen::Index at = 0;
  for (std::size_t j = 0; j < bases.size(); ++j) {
    if (bases[j].cols() == 0) continue;
    const Eigen::VectorXd own = step.segment(at, bases[j].cols());
    at += bases[j].cols();
    if (holds_lengths) {
      const double length = chain.axes[j].norm();
      const double shrink = std::min(1.0, kLargestStep / std::max(own.norm(), 1e-12));
      moved.axes[j] += shrink * bases[j] * own;
      moved.axes[j] *= length / std::max(moved.axes[j].norm(), 1e-12);
    } else {
      moved.axes[j] += own;
    }
  }
  return moved;
}

ChainSearch::ChainSearch(const PairData& pair, const NormalizedActions& actions, int max_frames,
                         const Effort& effort)
    : effort_(effort) {
  const int n = std::min(pair.size(), max_frames);
  q_.resize(actions.num_signals(), n);
  for (int k = 0; k < n; ++k) {
    frames_.push_back(static_cast<int>(static_cast<long>(k) * pair.size() / n));
    samples_.push_back(pair.frames[frames_.back()].sample);
    for (int s = 0; s < actions.num_signals(); ++s) q_(s, k) = actions(samples_.back(), s);
  }
}

double ChainSearch::uniform() { return static_cast<double>(random_() >> 11) * 0x1p-53; }

Vector3d ChainSearch::random_direction() {
  const double z = 2 * uniform() - 1, azimuth = 2 * M_PI * uniform();
  const double r = std::sqrt(1 - z * z);
  return {r * std::cos(azimuth), r * std::sin(azimuth), z};
}

ChainAxes ChainSearch::random_start(const std::vector<int>& signals,
                                    const std::vector<double>& lengths) {
  ChainAxes chain;
  chain.signals = signals;
  for (std::size_t j = 0; j < signals.size(); ++j) {
    const double length = lengths.empty() ? 0.5 * std::pow(6.0, uniform()) : lengths[j];
    chain.axes.push_back(length * random_direction());
  }
  set_end(&chain);
  return chain;
}

ChainAxes ChainSearch::best_of(const std::vector<int>& signals, const std::vector<double>& lengths,
                               int max_starts) {
  // Starts that end in the same minimum are enough to call it the global one.
  constexpr int kEnough = 3;
  constexpr double kSameMinimum = 1.02;
  ChainAxes best;
  int num_ended_there = 0;
  for (int n = 0; n < max_starts && num_ended_there < kEnough; ++n) {
    ChainAxes found = fit(random_start(signals, lengths), !lengths.empty(), kSearchIterations);
    const bool is_same =
        n > 0 && std::max(found.cost, best.cost) < kSameMinimum * std::min(found.cost, best.cost);
    const bool is_better = n == 0 || found.cost < best.cost;
    num_ended_there = is_same ? num_ended_there + 1 : is_better ? 1 : num_ended_there;
    if (is_better) best = std::move(found);
  }
  return best;
}

ChainAxes ChainSearch::with_joints_moved(ChainAxes chain) const {
  constexpr double kBetter = 0.9;
  constexpr int kMaxSweeps = 4;
  const int m = static_cast<int>(chain.signals.size());
  for (int sweep = 0; sweep < kMaxSweeps; ++sweep) {
    const double before = chain.cost;
    for (int from = 0; from < m; ++from)
      for (int to = 0; to < m; ++to) {
        if (to == from || to == from - 1) continue;  // the neighbours' exchange once
        ChainAxes moved = chain;
        move_element(&moved.signals, from, to);
        move_element(&moved.axes, from, to);
        moved = fit(std::move(moved), false, kSearchIterations);
        if (moved.cost < kBetter * chain.cost) chain = std::move(moved);
      }
    if (chain.cost >= kBetter * before) break;
  }
  return chain;
}

ChainAxes ChainSearch::best_order(const std::vector<int>& signals,
                                  const std::vector<double>& lengths, double goal) {
  constexpr int kMaxSweeps = 8;
  constexpr double kBetter = 0.98;
  const int m = static_cast<int>(signals.size());
  bool holds = true;
  const auto fit_order = [&](ChainAxes start, ChainAxes* best) {
    set_end(&start);
    ChainAxes found = fit(std::move(start), holds, kSearchIterations);
    if (found.cost < kBetter * best->cost) *best = std::move(found);
  };
  ChainAxes incumbent = random_start(signals, lengths);
  for (int j = m; j-- > 1;) {
    const int k = static_cast<int>(uniform() * (j + 1));
    std::swap(incumbent.signals[j], incumbent.signals[k]);
    std::swap(incumbent.axes[j], incumbent.axes[k]);
  }
  set_end(&incumbent);
  incumbent = fit(std::move(incumbent), true, kSearchIterations);
  for (int sweep = 0; sweep < kMaxSweeps; ++sweep) {
    const double before = incumbent.cost;
    for (const int signal : signals) {
      const auto at = std::find(incumbent.signals.begin(), incumbent.signals.end(), signal);
      const int from = static_cast<int>(at - incumbent.signals.begin());
      if (incumbent.axes[from].isZero(0)) continue;
      ChainAxes best = incumbent;
      ChainAxes sliding = incumbent;
      sliding.axes[from].setZero();
      fit_order(sliding, &best);
      for (int to = 0; to < m; ++to) {
        if (to == from) continue;
        ChainAxes moved = incumbent;
        move_element(&moved.signals, from, to);
        move_element(&moved.axes, from, to);
        fit_order(moved, &best);
        for (int n = 0; n < effort_.random_starts; ++n) {
          for (Vector3d& axis : moved.axes) axis = axis.norm() * random_direction();
          fit_order(moved, &best);
        }
      }
      incumbent = std::move(best);
      if (incumbent.median_left < goal) return incumbent;
    }
    ChainAxes reversed = incumbent;
    std::reverse(reversed.signals.begin(), reversed.signals.end());
    std::reverse(reversed.axes.begin(), reversed.axes.end());
    fit_order(reversed, &incumbent);
    if (incumbent.cost < before) continue;
    if (!holds) break;
    holds = false;
    incumbent = fit(incumbent, false, kSearchIterations);
    if (incumbent.median_left < goal) return incumbent;
  }
  return incumbent;
}

}  // namespace bodyschema
