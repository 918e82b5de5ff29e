#include "processes/structure_learner/screen.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

#include "common/estimation/quantile.h"
#include "common/estimation/student_t.h"
#include "processes/structure_learner/placed_screw.h"
#include "processes/structure_learner/turn_scan.h"

namespace bodyschema {
namespace {

constexpr int kCoarseFrames = 16;  // frames on which a start is chosen among a few alike

// ξ by an L1 regression on motions that are scaled to their standard deviations; the first of the
// `rounds` re-weightings is without weights. In the motions' scale.
ScrewRegression regress(const std::vector<Vector6d>& scaled, const RelativeMotions& motions,
                        const NormalizedActions& actions, int signal, int rounds) {
  std::vector<double> dq;
  std::vector<Vector6d> used;
  for (std::size_t n = 0; n < scaled.size(); ++n) {
    const auto& motion = motions.motions[n];
    const double d = actions(motion.sample_t, signal) - actions(motion.sample_s, signal);
    if (std::abs(d) > 1) continue;  // more than half the range may wrap around
    dq.push_back(d);
    used.push_back(scaled[n]);
  }
  ScrewRegression regression;
  regression.signal = signal;
  regression.score = std::numeric_limits<double>::infinity();
  Vector6d& slope = regression.xi;
  for (int round = 0; round <= rounds; ++round) {
    double sxx = 1e-12, score = 0;
    Vector6d sxy = Vector6d::Zero();
    for (std::size_t n = 0; n < used.size(); ++n) {
      const double root = std::sqrt(1 + (used[n] - slope * dq[n]).squaredNorm());
      const double w = round == 0 ? 1 : 1 / root;
      sxx += w * dq[n] * dq[n];
      sxy += w * dq[n] * used[n];
      score += root;
    }
    if (round < rounds)
      slope = sxy / sxx;
    else if (!used.empty())
      regression.score = score / static_cast<double>(used.size());
  }
  return regression;
}

// The signals of which one least squares fit leaves least, motions weighted by their size: of many
// signals only these are worth a robust one. All of them at once: a pair of 100 parts has 80.
std::vector<int> promising_signals(const std::vector<Vector6d>& scaled,
                                   const RelativeMotions& motions, const NormalizedActions& actions,
                                   std::size_t most) {
  const std::vector<int>& moving = actions.moving();
  if (moving.size() <= most) return moving;
  const auto n = static_cast<Eigen::Index>(scaled.size());
  const auto m = static_cast<Eigen::Index>(moving.size());
  Eigen::MatrixXd moved(n, 6), dq(n, m);
  for (Eigen::Index k = 0; k < n; ++k) {
    const RelativeMotions::Motion& motion = motions.motions[static_cast<std::size_t>(k)];
    const Vector6d& xi = scaled[static_cast<std::size_t>(k)];
    const double weight = 1 / std::sqrt(std::sqrt(1 + xi.squaredNorm()));
    moved.row(k) = weight * xi.transpose();
    for (Eigen::Index s = 0; s < m; ++s) {
      const int signal = moving[static_cast<std::size_t>(s)];
      const double d = actions(motion.sample_t, signal) - actions(motion.sample_s, signal);
      dq(k, s) = std::abs(d) > 1 ? 0 : weight * d;
    }
  }
  const Eigen::VectorXd explained = (dq.transpose() * moved).rowwise().squaredNorm().array() /
                                    (dq.colwise().squaredNorm().transpose().array() + 1e-12);
  std::vector<int> order(moving.size());
  std::iota(order.begin(), order.end(), 0);
  std::stable_sort(order.begin(), order.end(),
                   [&](int x, int y) { return explained(x) > explained(y); });
  order.resize(most);
  std::sort(order.begin(), order.end());
  std::vector<int> result;
  for (const int s : order) result.push_back(moving[static_cast<std::size_t>(s)]);
  return result;
}

}  // namespace

Start judged_start(const LocalModel& model, const PairData& pair, const NormalizedActions& actions,
                   int max_frames) {
  Start start;
  start.model = model;
  const int n = std::min(pair.size(), max_frames);
  if (n == 0) return start;
  std::vector<double> squared(n);
  for (int k = 0; k < n; ++k) {
    const int t = static_cast<int>(static_cast<long>(k) * pair.size() / n);
    const FrameFit fit = best_reading(pair, t, model.predict(actions, pair.frames[t].sample));
    squared[k] = fit.squared_distance;
    start.score += fit.cost() / n;
  }
  start.median = upper_median(std::move(squared));
  return start;
}

RelativeMotions relative_motions(const PairData& pair, int max_motions) {
  constexpr double kMaxAngle = 2.4;
  RelativeMotions result;
  const long n = pair.size();
  std::vector<double> variance_m, variance_rad;
  for (int t = 0; t < pair.size(); ++t) {
    // Σ_z = (W ᵀW)⁻¹; its diagonal from the inverse of the triangular W.
    const Matrix6d L =
        pair.primary(t).whitening.triangularView<Eigen::Lower>().solve(Matrix6d::Identity());
    variance_m.push_back(L.topRows<3>().squaredNorm() / 3);
    variance_rad.push_back(L.bottomRows<3>().squaredNorm() / 3);
    if (t >= kStartFrames) break;
  }
  if (n > 0) {
    result.sigma_m = std::sqrt(upper_median(variance_m));
    result.sigma_rad = std::sqrt(upper_median(variance_rad));
  }
  const long total = n * (n - 1) / 2;
  const long count = std::min<long>(total, max_motions);
  result.motions.reserve(count);
  long row = 0, row_start = 0;  // the k-th pair (s, t), s < t, in row order
  for (long m = 0; m < count; ++m) {
    const long k = m * total / count;
    while (k >= row_start + (n - 1 - row)) row_start += n - 1 - row++;
    const int s = static_cast<int>(row), t = static_cast<int>(row + 1 + k - row_start);
    const Vector6d xi = log(pair.primary(s).z.inverse() * pair.primary(t).z);
    if (xi.tail<3>().norm() > kMaxAngle) continue;
    result.motions.push_back({pair.frames[s].sample, pair.frames[t].sample, xi});
  }
  return result;
}

Start screen_rigid(const PairData& pair, const NormalizedActions& actions) {
  constexpr int kCandidates = 8;
  Start best;
  best.score = std::numeric_limits<double>::infinity();
  const int n = std::min(pair.size(), kCandidates);
  for (int k = 0; k < n; ++k) {
    LocalModel model;
    model.first = pair.primary(static_cast<int>(static_cast<long>(k) * pair.size() / n)).z;
    const Start start = judged_start(model, pair, actions, kCoarseFrames);
    if (start.score < best.score) best = start;
  }
  return n > 0 ? judged_start(best.model, pair, actions) : best;
}

std::vector<ScrewRegression> screen_one_joint(const RelativeMotions& motions,
                                              const NormalizedActions& actions) {
  Vector6d scale;
  scale.head<3>().setConstant(1 / (std::sqrt(2.0) * motions.sigma_m));
  scale.tail<3>().setConstant(1 / (std::sqrt(2.0) * motions.sigma_rad));
  std::vector<Vector6d> scaled;
  scaled.reserve(motions.motions.size());
  for (const auto& motion : motions.motions) scaled.push_back(scale.cwiseProduct(motion.log));
  constexpr int kRounds = 6;
  constexpr std::size_t kMaxSignals = 8;  // worth more than two rounds of re-weighting
  constexpr std::size_t kMostRobust = 24;
  const auto scaled_back = [&](int signal, int rounds) {
    ScrewRegression regression = regress(scaled, motions, actions, signal, rounds);
    regression.xi = regression.xi.cwiseQuotient(scale);
    return regression;
  };
  const auto best_first = [](const auto& x, const auto& y) { return x.score < y.score; };
  std::vector<ScrewRegression> result;
  const bool many = actions.moving().size() > kMaxSignals;
  for (const int signal : promising_signals(scaled, motions, actions, kMostRobust))
    result.push_back(scaled_back(signal, many ? 2 : kRounds));
  std::stable_sort(result.begin(), result.end(), best_first);
  if (many) {
    result.resize(kMaxSignals);
    for (ScrewRegression& r : result) r = scaled_back(r.signal, kRounds);
    std::stable_sort(result.begin(), result.end(), best_first);
  }
  return result;
}

Start one_joint_start(const ScrewRegression& regression, const PairData& pair,
                      const NormalizedActions& actions, double sigma_rad) {
  // A turn below the noise would place the axis anywhere: begin as a sliding joint.
  const double turn = regression.xi.tail<3>().norm();
  const PlacedScrew placed =
      PlacedScrew::of(regression.xi, !(turn > 0.5 * sigma_rad && turn > 1e-6));
  LocalModel model;
  model.joints = {{regression.signal, placed.screw.slide, placed.screw.turn, placed.X.inverse()}};
  Start best;
  best.score = std::numeric_limits<double>::infinity();
  constexpr int kCandidates = 6;
  const int n = std::min(pair.size(), kCandidates);
  for (int k = 0; k < n; ++k) {
    const int t = static_cast<int>(static_cast<long>(k) * pair.size() / n);
    const Vector6d back = -regression.xi * actions(pair.frames[t].sample, regression.signal);
    model.first = pair.primary(t).z * exp(back) * placed.X;
    const Start start = judged_start(model, pair, actions, kCoarseFrames);
    if (start.score < best.score) best = start;
  }
  return n > 0 ? judged_start(best.model, pair, actions) : best;
}

std::vector<double> default_turns() { return {kLeastTurn, 0.55, 0.9, 1.4, 2.0, 2.8}; }

std::vector<double> wide_turns() {
  std::vector<double> turns = default_turns();
  while (turns.back() < kMostTurn) turns.push_back(turns.back() + kTurnStep);
  return turns;
}

}  // namespace bodyschema
