#include "processes/structure_learner/long_chain/chain_rotations.h"

#include <algorithm>
#include <cmath>

#include "common/estimation/levenberg_marquardt.h"
#include "common/estimation/quantile.h"

namespace bodyschema {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

// Scale of the heavy-tailed loss: wide enough to be drawn into the global minimum from tens of
// degrees, narrow enough for one frame in five that is anything. research/long_chains.md.
constexpr double kLossScale = 0.3;
constexpr int kSearchIterations = 60;
// Of lengths held, largest turn of an axis a step.
constexpr double kLargestStep = 0.7;

// Jr(w): Exp(w + δ) = Exp(w) Exp(Jr δ + O(δ²)).
Matrix3d right_jacobian(const Vector3d& w) {
  const double angle2 = w.squaredNorm(), angle = std::sqrt(angle2);
  const Matrix3d W = skew(w);
  if (angle < 1e-4) return Matrix3d::Identity() - 0.5 * W + W * W / 6;
  return Matrix3d::Identity() - (1 - std::cos(angle)) / angle2 * W +
         (angle - std::sin(angle)) / (angle2 * angle) * W * W;
}

// Of R̂ᵀ R: sin ϑ about its axis; 4 sin²(ϑ/2).
Vector3d sine_axis(const Matrix3d& error) {
  return 0.5 *
         Vector3d(error(2, 1) - error(1, 2), error(0, 2) - error(2, 0), error(1, 0) - error(0, 1));
}
double squared_chord(const Matrix3d& error) { return std::max(0.0, 3 - error.trace()); }

double loss(double chord2) {
  return 0.5 * kLossScale * kLossScale * std::log1p(chord2 / (kLossScale * kLossScale));
}
double weight(double chord2) { return 1 / (1 + chord2 / (kLossScale * kLossScale)); }

// How each joint's parameters move its axis: 3×2 where lengths are held, else 3×3.
std::vector<Eigen::MatrixXd> axis_bases(const ChainRotations& chain, bool holds_lengths) {
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

// By the parameters of each axis, then those of R_end.
ChainRotations moved_by(const Eigen::VectorXd& step, const ChainRotations& chain,
                        const std::vector<Eigen::MatrixXd>& bases, bool holds_lengths) {
  ChainRotations moved = chain;
  Eigen::Index at = 0;
  for (std::size_t j = 0; j < bases.size(); ++j) {
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
  moved.R_end = chain.R_end * exp_so3(step.tail<3>());
  return moved;
}

}  // namespace

RotationSearch::RotationSearch(const PairData& pair, const NormalizedActions& actions,
                               int max_frames) {
  const int n = std::min(pair.size(), max_frames);
  q_.resize(actions.num_signals(), n);
  for (int k = 0; k < n; ++k) {
    const int t = static_cast<int>(static_cast<long>(k) * pair.size() / n);
    rotations_.push_back(pair.primary(t).z.linear());
    for (int s = 0; s < actions.num_signals(); ++s) q_(s, k) = actions(pair.frames[t].sample, s);
  }
}

// steps[j] = Exp(w_j q_j); suffixes[j] = ∏_{i ≥ j} steps[i] · R_end.
void RotationSearch::predict(const ChainRotations& chain, int frame, std::vector<Matrix3d>* steps,
                             std::vector<Matrix3d>* suffixes) const {
  const int m = static_cast<int>(chain.axes.size());
  steps->resize(m);
  suffixes->resize(m + 1);
  (*suffixes)[m] = chain.R_end;
  for (int j = m; j-- > 0;) {
    (*steps)[j] = exp_so3(chain.axes[j] * q_(chain.signals[j], frame));
    (*suffixes)[j].noalias() = (*steps)[j] * (*suffixes)[j + 1];
  }
}

double RotationSearch::evaluate(ChainRotations* chain) const {
  chain->cost = 0;
  for (int t = 0; t < num_frames(); ++t) {
    Matrix3d R = chain->R_end;
    for (std::size_t j = chain->axes.size(); j-- > 0;)
      R = exp_so3(chain->axes[j] * q_(chain->signals[j], t)) * R;
    chain->cost += loss(squared_chord(R.transpose() * rotations_[t]));
  }
  return chain->cost;
}

void RotationSearch::set_end(ChainRotations* chain) const {
  Matrix3d sum = Matrix3d::Zero();
  for (int t = 0; t < num_frames(); ++t) {
    Matrix3d P = Matrix3d::Identity();
    for (std::size_t j = 0; j < chain->axes.size(); ++j)
      P = P * exp_so3(chain->axes[j] * q_(chain->signals[j], t));
    sum += P.transpose() * rotations_[t];
  }
  const Eigen::JacobiSVD<Matrix3d> svd(sum, Eigen::ComputeFullU | Eigen::ComputeFullV);
  Matrix3d U = svd.matrixU();
  if ((U * svd.matrixV().transpose()).determinant() < 0) U.col(2) *= -1;
  chain->R_end = U * svd.matrixV().transpose();
}

ChainRotations RotationSearch::fit(ChainRotations chain, bool holds_lengths,
                                   int max_iterations) const {
  const int m = static_cast<int>(chain.axes.size());
  const int width = holds_lengths ? 2 : 3;
  const int size = width * m + 3;
  std::vector<Matrix3d> steps, suffixes;
  Eigen::MatrixXd H(size, size), J(3, size);
  Eigen::VectorXd g(size);
  LevenbergMarquardt optimizer(1e-3, 1e-9, 6);
  evaluate(&chain);
  for (int iteration = 0; iteration < max_iterations; ++iteration) {
    const std::vector<Eigen::MatrixXd> bases = axis_bases(chain, holds_lengths);
    H.setZero();
    g.setZero();
    for (int t = 0; t < num_frames(); ++t) {
      predict(chain, t, &steps, &suffixes);
      const Matrix3d error = suffixes[0].transpose() * rotations_[t];
      for (int j = 0; j < m; ++j) {
        const double q = q_(chain.signals[j], t);
        J.middleCols(width * j, width).noalias() =
            suffixes[j + 1].transpose() * (q * right_jacobian(chain.axes[j] * q)) * bases[j];
      }
      J.rightCols<3>().setIdentity();
      const double w = weight(squared_chord(error));
      H.selfadjointView<Eigen::Lower>().rankUpdate(J.transpose(), w);
      g.noalias() -= w * (J.transpose() * sine_axis(error));
    }
    H = Eigen::MatrixXd(H.selfadjointView<Eigen::Lower>());
    double decrease = 0;
    const bool improved = optimizer.step(H, g, [&](const Eigen::VectorXd& step) {
      ChainRotations moved = moved_by(step, chain, bases, holds_lengths);
      if (!(evaluate(&moved) < chain.cost)) return false;
      decrease = chain.cost - moved.cost;
      chain = std::move(moved);
      return true;
    });
    if (!improved || decrease < 1e-6 * chain.cost + 1e-12) break;
    // Stuck far from a minimum that explains anything.
    if (iteration >= 12 && decrease < 1e-3 * chain.cost) break;
  }
  std::vector<double> angles;
  for (int t = 0; t < num_frames(); ++t) {
    predict(chain, t, &steps, &suffixes);
    const double chord = std::sqrt(squared_chord(suffixes[0].transpose() * rotations_[t]));
    angles.push_back(2 * std::asin(std::min(1.0, chord / 2)));
  }
  chain.median_rad = angles.empty() ? 0 : upper_median(std::move(angles));
  return chain;
}

double RotationSearch::uniform() { return static_cast<double>(random_() >> 11) * 0x1p-53; }

Vector3d RotationSearch::random_direction() {
  const double z = 2 * uniform() - 1, azimuth = 2 * M_PI * uniform();
  const double r = std::sqrt(1 - z * z);
  return {r * std::cos(azimuth), r * std::sin(azimuth), z};
}

ChainRotations RotationSearch::random_start(const std::vector<int>& signals,
                                            const std::vector<double>& lengths) {
  ChainRotations chain;
  chain.signals = signals;
  for (std::size_t j = 0; j < signals.size(); ++j) {
    const double length = lengths.empty() ? 0.5 * std::pow(6.0, uniform()) : lengths[j];
    chain.axes.push_back(length * random_direction());
  }
  set_end(&chain);
  return chain;
}

ChainRotations RotationSearch::best_of(const std::vector<int>& signals,
                                       const std::vector<double>& lengths, int max_starts) {
  // Starts that end in the same minimum are enough to call it the global one.
  constexpr int kEnough = 3;
  constexpr double kSameMinimum = 1.02;
  ChainRotations best;
  int num_ended_there = 0;
  for (int n = 0; n < max_starts && num_ended_there < kEnough; ++n) {
    ChainRotations found = fit(random_start(signals, lengths), !lengths.empty(), kSearchIterations);
    const bool is_same =
        n > 0 && std::max(found.cost, best.cost) < kSameMinimum * std::min(found.cost, best.cost);
    const bool is_better = n == 0 || found.cost < best.cost;
    num_ended_there = is_same ? num_ended_there + 1 : is_better ? 1 : num_ended_there;
    if (is_better) best = std::move(found);
  }
  return best;
}

ChainRotations RotationSearch::best_order(const std::vector<int>& signals,
                                          const std::vector<double>& lengths, double goal_rad) {
  constexpr int kMaxSweeps = 8;
  constexpr int kRandomStarts = 2;
  constexpr double kBetter = 0.98;
  const int m = static_cast<int>(signals.size());
  bool holds = true;
  const auto fit_order = [&](ChainRotations start, ChainRotations* best) {
    set_end(&start);
    ChainRotations found = fit(std::move(start), holds, kSearchIterations);
    if (found.cost < kBetter * best->cost) *best = std::move(found);
  };
  ChainRotations incumbent = random_start(signals, lengths);
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
      ChainRotations best = incumbent;
      ChainRotations sliding = incumbent;
      sliding.axes[from].setZero();
      fit_order(sliding, &best);
      for (int to = 0; to < m; ++to) {
        if (to == from) continue;
        ChainRotations moved = incumbent;
        move_element(&moved.signals, from, to);
        move_element(&moved.axes, from, to);
        fit_order(moved, &best);
        for (int n = 0; n < kRandomStarts; ++n) {
          for (Vector3d& axis : moved.axes) axis = axis.norm() * random_direction();
          fit_order(moved, &best);
        }
      }
      incumbent = std::move(best);
      if (incumbent.median_rad < goal_rad) return incumbent;
    }
    ChainRotations reversed = incumbent;
    std::reverse(reversed.signals.begin(), reversed.signals.end());
    std::reverse(reversed.axes.begin(), reversed.axes.end());
    fit_order(reversed, &incumbent);
    if (incumbent.cost < before) continue;
    if (!holds) break;
    holds = false;
    incumbent = fit(incumbent, false, kSearchIterations);
    if (incumbent.median_rad < goal_rad) return incumbent;
  }
  return incumbent;
}

}  // namespace bodyschema
