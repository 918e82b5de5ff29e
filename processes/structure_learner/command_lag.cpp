#include "processes/structure_learner/command_lag.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <functional>
#include <set>
#include <tuple>
#include <utility>

#include "common/estimation/quantile.h"
#include "common/estimation/student_t.h"
#include "common/geometry/pose.h"
#include "processes/structure_learner/command_warp.h"
#include "processes/structure_learner/edge_fit.h"
#include "processes/structure_learner/local_model.h"
#include "processes/structure_learner/noise_estimate.h"
#include "processes/structure_learner/pair_data.h"

namespace bodyschema {
namespace {

/// Lags are looked for up to so far, or to so many intervals, but no farther than a share of the
/// stream, in so many steps at most to either side. Chosen.
constexpr double kFarthest_us = 600'000, kFarthestIntervals = 12, kShareOfStream = 0.125;
constexpr double kMostSteps = 40;
/// By which a lag must explain more than none to be true, or to be tried, and a delay by models and
/// schemas [nats, of blocks of time]; the best of many lags by the log of their number more. Chosen
/// by numpy's streams of 13 to 30 s.
constexpr double kEvidence = 3, kLeastEvidence = 0.1, kModelEvidence = 0.5;
/// Smaller ones the models tell.
constexpr double kLeastIntervals = 0.25;
/// Motions of a regression: at most, and at least, also for each signal; of more parts those with
/// neighbouring ids alone. Chosen.
constexpr std::size_t kMostMotions = 400, kFewestMotions = 40, kFewestOfSignal = 5,
                      kMostPaired = 10;
/// Time shifts tried, as shares of the farthest lag; and the share of the squared change of the
/// commands below which what the present commands leave unexplained is nothing. Chosen.
constexpr std::array kWhiles{0.25, 0.5, 1.0};
constexpr double kLeastNews = 0.01;
/// Residuals below are no information [m, rad].
constexpr double kFloor = 1e-5;
/// Of the median squared distance; flips and false detections are beyond. Chosen.
constexpr double kWild = 8;
/// Of a fit by models, and by a schema. Chosen.
constexpr int kFitted = 300, kIterations = 20;
constexpr std::size_t kMostFrames = 500;

double farthest_lag_us(const std::vector<ActionPoseSample>& samples, double interval_us) {
  return std::min(std::max(kFarthest_us, kFarthestIntervals * interval_us),
                  kShareOfStream * (time_of(samples.back()) - time_of(samples.front())));
}

/// log(z(t_a)⁻¹ z(t_b)) of a pair of parts.
struct Motion {
  double from_us, to_us;
  std::size_t sample;  ///< at its begin
  Vector6d twist;
};

std::vector<Motion> motions_of(const std::vector<ActionPoseSample>& samples,
                               const std::vector<std::size_t>& inner, int part_i, int part_j,
                               double interval_us, int num_intervals) {
  struct Seen {
    double time_us;
    std::size_t sample;
    Pose z;
  };
  std::vector<Seen> seen;
  for (const std::size_t n : inner) {
    const ActionPoseSample& sample = samples[n];
    const PartObservation *i = sample.find(part_i), *j = sample.find(part_j);
    if (i && j && i->has_rotation && j->has_rotation)
      seen.push_back({time_of(sample), n, i->X_CB.inverse() * j->X_CB});
  }
  std::vector<Motion> motions;
  std::size_t b = 0;
  for (const Seen& from : seen) {
    while (b < seen.size() && seen[b].time_us < from.time_us + (num_intervals - 0.5) * interval_us)
      ++b;
    if (b == seen.size()) break;
    if (seen[b].time_us > from.time_us + 2 * num_intervals * interval_us) continue;
    motions.push_back(
        {from.time_us, seen[b].time_us, from.sample, log(from.z.inverse() * seen[b].z)});
  }
  if (motions.size() <= kMostMotions) return motions;
  std::vector<Motion> some;
  for (std::size_t n = 0; n < kMostMotions; ++n)
    some.push_back(motions[n * motions.size() / kMostMotions]);
  return some;
}

/// What the commands of `lag_us` before say about one pair's motions.
class MotionRegression {
 public:
  MotionRegression(std::vector<Motion> motions, const CommandTrack& track,
                   const NormalizedActions& actions)
      : motions_(std::move(motions)), track_(track), actions_(actions) {}

  bool is_enough() const {
    return motions_.size() >= std::max(kFewestMotions, kFewestOfSignal * actions_.moving().size());
  }

  /// Of residuals of covariance S: −½ log |S| for each block of time.
  double log_likelihood(double lag_us) const {
    const int num_blocks = actions_.blocks().count(
        motions_, [](const Motion& motion) { return static_cast<int>(motion.sample); });
    return -0.5 * num_blocks * log_det(covariance(residuals_at(lag_us)));
  }

  /// Without what is wild at this lag.
  void drop_wild(double lag_us) {
    const Eigen::MatrixXd residuals = residuals_at(lag_us);
    const Eigen::MatrixXd whitened = covariance(residuals).llt().matrixL().solve(residuals);
    const Eigen::VectorXd distances = whitened.colwise().squaredNorm();
    const double most = kWild * upper_median({distances.begin(), distances.end()});
    std::vector<Motion> kept;
    for (std::size_t n = 0; n < motions_.size(); ++n)
      if (distances[static_cast<Eigen::Index>(n)] <= most) kept.push_back(motions_[n]);
    motions_ = std::move(kept);
  }

 private:
  static Matrix6d covariance(const Eigen::MatrixXd& residuals) {
    return residuals * residuals.transpose() / static_cast<double>(residuals.cols()) +
           kFloor * kFloor * Matrix6d::Identity();
  }
  static double log_det(const Matrix6d& S) {
    return 2 * Matrix6d(S.llt().matrixL()).diagonal().array().log().sum();
  }

  Eigen::MatrixXd residuals_at(double lag_us) const {
    const std::vector<int>& moving = actions_.moving();
    const auto m = static_cast<Eigen::Index>(moving.size());
    const auto num = static_cast<Eigen::Index>(motions_.size());
    Eigen::MatrixXd steps(m, num), twists(6, num);
    for (Eigen::Index n = 0; n < num; ++n) {
      const Motion& motion = motions_[static_cast<std::size_t>(n)];
      const auto from = track_.at(motion.from_us - lag_us), to = track_.at(motion.to_us - lag_us);
      for (Eigen::Index s = 0; s < m; ++s) {
        const int signal = moving[static_cast<std::size_t>(s)];
        steps(s, n) = ((*to)[signal] - (*from)[signal]) / actions_.half_range(signal);
      }
      twists.col(n) = motion.twist;
    }
    Eigen::MatrixXd normal = steps * steps.transpose();
    normal.diagonal().array() += 1e-9 * normal.trace() / static_cast<double>(normal.rows());
    return twists - twists * steps.transpose() * normal.ldlt().solve(steps);
  }

  std::vector<Motion> motions_;
  const CommandTrack& track_;
  const NormalizedActions& actions_;
};

double num_blocks(const NormalizedActions& actions) {
  return static_cast<double>(actions.num_samples()) / actions.blocks().length();
}

/// Of three values at −1, 0, 1, where their parabola has its least, within ±1; where it has none,
/// downhill.
double vertex(double before, double at, double after) {
  const double bend = before - 2 * at + after;
  if (bend > 0) return std::clamp(0.5 * (before - after) / bend, -1.0, 1.0);
  if (std::min(before, after) >= at) return 0;
  return before < after ? -1 : 1;
}

/// Of delays the one at which the samples, with the commands that brought them there, cost least.
/// Keeps references.
class DelaySearch {
 public:
  using CostOf = std::function<double(const std::vector<ActionPoseSample>&)>;  ///< [nats]

  DelaySearch(const std::vector<ActionPoseSample>& samples, CostOf cost_of)
      : samples_(samples),
        track_(samples),
        cost_of_(std::move(cost_of)),
        step_us_(static_cast<std::int64_t>(median_interval_us(samples) / 2)) {}

  /// Downhill from a delay; `without` where that is hardly less than there.
  CommandDelay least_near(const CommandDelay& start, const CommandDelay& without) const {
    const CommandDelay sharp = downhill(start, false), smeared = downhill(sharp, true);
    const CommandDelay best = best_of(sharp, smeared);
    return best_of(best_of(without, sharp), best);
  }

 private:
  // All delays are compared on the same frames; alike where these are too few.
  std::vector<double> costs_at(const std::vector<CommandDelay>& delays) const {
    std::vector<DelayedTrack> drives;
    double past_us = 0, future_us = 0;
    for (const CommandDelay& d : delays) {
      drives.emplace_back(track_, d);
      past_us = std::max(past_us, drives.back().past_us());
      future_us = std::max(future_us, drives.back().future_us());
    }
    const std::vector<std::size_t> inner = track_.within(past_us, future_us);
    if (inner.size() < std::min(kFewestMotions, samples_.size() / 4))
      return std::vector<double>(delays.size(), 0.0);
    std::vector<ActionPoseSample> moved;
    for (std::size_t k = 0, count = std::min(kMostFrames, inner.size()); k < count; ++k)
      moved.push_back(samples_[inner[k * inner.size() / count]]);
    std::vector<double> costs;
    for (const DelayedTrack& drive : drives) {
      for (ActionPoseSample& sample : moved) sample.action = *drive.at(time_of(sample));
      costs.push_back(cost_of_(moved));
    }
    return costs;
  }

  // One step in a direction of both, and whether it was none.
  std::pair<CommandDelay, bool> moved_by(CommandDelay at, std::int64_t lag_us,
                                         std::int64_t smear_us) const {
    constexpr double kThere = 0.1;  // of half an interval
    const auto at_share = [&](double share) {
      CommandDelay there = at;
      there.lag_us += std::llround(share * static_cast<double>(lag_us));
      there.smear_us =
          std::abs(there.smear_us + std::llround(share * static_cast<double>(smear_us)));
      return there;
    };
    const auto costs = costs_at({at_share(-1), at, at_share(1)});
    const double share = vertex(costs[0], costs[1], costs[2]);
    at = at_share(share);
    // The dead time is not below 0, except by half an interval, since a command may be of the end
    // of the interval in which it acts. Otherwise a joint that moves less than commanded would pass
    // for a slow drive.
    const std::int64_t late_us = std::max<std::int64_t>(0, at.lag_us);
    const std::int64_t widest_us = late_us + std::min(late_us / 4, step_us_);
    const bool is_widest = at.smear_us > widest_us;
    if (is_widest) at.smear_us = widest_us;
    return {at, is_widest || std::abs(share) < kThere};
  }

  CommandDelay downhill(CommandDelay at, bool is_smeared) const {
    constexpr int kMostRounds = 20;
    for (int n = 0; n < kMostRounds; ++n) {
      bool is_there = false, is_smooth = true, is_slow = true;
      std::tie(at, is_there) = moved_by(at, step_us_, 0);
      if (is_smeared) {
        std::tie(at, is_smooth) = moved_by(at, 0, step_us_);
        std::tie(at, is_slow) = moved_by(at, step_us_, step_us_);  // of the same dead time
      }
      if (is_there && is_smooth && is_slow) break;
    }
    return at;
  }

  // Each on the frames that it has: a smeared one needs more of the past.
  CommandDelay best_of(const CommandDelay& simple, const CommandDelay& other) const {
    const auto costs = costs_at({simple, other});
    return costs[0] - costs[1] < kModelEvidence ? simple : other;
  }

  const std::vector<ActionPoseSample>& samples_;
  const CommandTrack track_;
  const CostOf cost_of_;
  const std::int64_t step_us_;
};

struct Regressions {
  std::vector<MotionRegression> of_pairs;
  std::set<int> parts;

  double log_likelihood(double lag_us) const {
    double sum = 0;
    for (const MotionRegression& of_pair : of_pairs) sum += of_pair.log_likelihood(lag_us);
    // Of n (n − 1) / 2 pairs n − 1 say something of their own.
    return sum * std::min(1.0, static_cast<double>(parts.size() - 1) /
                                   static_cast<double>(of_pairs.size()));
  }
};

Regressions regressions_of(const std::vector<ActionPoseSample>& samples, const CommandTrack& track,
                           const NormalizedActions& actions, double farthest_us) {
  // Their commands are known at every lag.
  const std::vector<std::size_t> inner = track.within(farthest_us);
  const int num_intervals = std::max(1, actions.blocks().length() / 4);
  const std::vector<int> parts = seen_parts(samples);
  Regressions regressions;
  for (std::size_t i = 0; i < parts.size(); ++i) {
    const std::size_t end =
        parts.size() <= kMostPaired ? parts.size() : std::min(i + 2, parts.size());
    for (std::size_t j = i + 1; j < end; ++j) {
      MotionRegression of_pair(motions_of(samples, inner, parts[i], parts[j],
                                          median_interval_us(samples), num_intervals),
                               track, actions);
      if (!of_pair.is_enough()) continue;
      regressions.of_pairs.push_back(std::move(of_pair));
      regressions.parts.insert({parts[i], parts[j]});
    }
  }
  return regressions;
}

}  // namespace

bool is_one_rhythm(const std::vector<ActionPoseSample>& samples, int num_signals) {
  const NormalizedActions actions(samples, num_signals);
  const std::vector<int>& moving = actions.moving();
  if (!actions.blocks().is_stream() || moving.size() < 2) return false;
  const CommandTrack track(samples);
  const double farthest_us = farthest_lag_us(samples, median_interval_us(samples));
  const auto m = static_cast<Eigen::Index>(moving.size());
  // Few blocks of time are mixtures of anything.
  if (num_blocks(actions) <= 2 * static_cast<double>(m + 1)) return false;
  return std::ranges::all_of(kWhiles, [&](double share) {
    const double while_us = share * farthest_us;
    const std::vector<std::size_t> inner = track.within(while_us);
    if (inner.size() < kFewestMotions) return false;
    Eigen::MatrixXd now(m + 1, inner.size()), change(m, inner.size());
    for (Eigen::Index n = 0; n < now.cols(); ++n) {
      const ActionPoseSample& sample = samples[inner[static_cast<std::size_t>(n)]];
      const auto before = track.at(time_of(sample) - while_us);
      if (!before) return false;
      now(m, n) = 1;
      for (Eigen::Index s = 0; s < m; ++s) {
        const int signal = moving[static_cast<std::size_t>(s)];
        now(s, n) = (sample.action[signal] - actions.centre(signal)) / actions.half_range(signal);
        change(s, n) = ((*before)[signal] - sample.action[signal]) / actions.half_range(signal);
      }
    }
    const Eigen::MatrixXd left =
        change - now.transpose().colPivHouseholderQr().solve(change.transpose()).transpose() * now;
    return left.squaredNorm() < kLeastNews * change.squaredNorm();
  });
}

CommandLag command_lag(const std::vector<ActionPoseSample>& samples, int num_signals) {
  const NormalizedActions actions(samples, num_signals);
  if (!actions.blocks().is_stream() || actions.moving().empty()) return {};
  const double interval_us = median_interval_us(samples);
  const double farthest_us = farthest_lag_us(samples, interval_us);
  const double step_us = std::max(interval_us, farthest_us / kMostSteps);
  const int most = static_cast<int>(farthest_us / step_us);
  const CommandTrack track(samples);
  Regressions regressions = regressions_of(samples, track, actions, most * step_us);
  if (regressions.of_pairs.empty()) return {};
  std::vector<double> gains;  // at −most … most
  int best = 0;
  const auto gain_at = [&](int k) { return gains[static_cast<std::size_t>(k + most)]; };
  const auto look = [&] {
    gains.clear();
    const double without = regressions.log_likelihood(0);
    for (int k = -most; k <= most; ++k)
      gains.push_back(regressions.log_likelihood(k * step_us) - without);
    best = static_cast<int>(std::ranges::max_element(gains) - gains.begin()) - most;
  };
  look();
  for (MotionRegression& of_pair : regressions.of_pairs) of_pair.drop_wild(best * step_us);
  look();
  if (std::abs(best) == most) return {};
  const double lag_us =
      step_us * (best + vertex(-gain_at(best - 1), -gain_at(best), -gain_at(best + 1)));
  if (std::abs(lag_us) < kLeastIntervals * interval_us || gain_at(best) < kLeastEvidence) return {};
  return {std::llround(lag_us), gain_at(best) >= kEvidence + std::log(2 * most + 1)};
}

CommandDelay refined_delay(const std::vector<ActionPoseSample>& samples,
                           const std::vector<Signal>& signals, const NormalizedActions& actions,
                           const std::vector<AcceptedModel>& models,
                           const MeasurementModel& measurement, const CommandDelay& delay) {
  const auto is_soft = [](const AcceptedModel& model) { return !model.soft_signals.empty(); };
  if (!actions.blocks().is_stream() || std::ranges::any_of(models, is_soft)) return delay;
  const auto cost_of = [&](const std::vector<ActionPoseSample>& lagged) {
    const std::vector<ActionPoseSample> moved = displaced(lagged, signals);
    const NormalizedActions actions_here(moved, actions.num_signals());
    double cost = 0, num_frames = 0, num_models = 0;
    for (const AcceptedModel& accepted : models) {
      if (accepted.model.joints.empty()) continue;
      const PairData pair =
          make_pair_data(moved, accepted.part_i, accepted.part_j, measurement, kFitted);
      const LocalModel start = rescaled(accepted.model, actions, actions_here);
      cost += fit_local_model(start, pair, actions_here, kIterations, 1e-3).cost;
      num_frames += static_cast<double>(pair.frames.size());
      ++num_models;
    }
    // A model's frames count as many as there are blocks.
    return num_frames == 0 ? 0 : cost * num_blocks(actions) * num_models / num_frames;
  };
  return DelaySearch(samples, cost_of).least_near(delay, delay);
}

CommandDelay command_delay(const std::vector<ActionPoseSample>& samples, const BodySchema& schema) {
  const int num_signals = static_cast<int>(schema.signals.size());
  const NormalizedActions actions(samples, num_signals);
  if (!actions.blocks().is_stream()) return {};
  const CommandLag lag = command_lag(samples, num_signals);
  const auto is_soft = [](const Edge& edge) { return edge.residual_gp != nullptr; };
  if (std::ranges::any_of(schema.edges, is_soft))
    return {.lag_us = lag.is_significant ? lag.us : 0};
  const double position_m = std::max(schema.noise.position_m, kNoiseFloor.position_m);
  const double rotation_rad = std::max(schema.noise.rotation_rad, kNoiseFloor.rotation_rad);
  const auto cost_of = [&](const std::vector<ActionPoseSample>& lagged) {
    double cost = 0;
    for (const ActionPoseSample& sample : lagged) {
      const PartObservation* root = sample.find(schema.root);
      if (!root || !root->has_rotation) continue;
      for (const auto& [part, X_RB] : schema.predict_all(sample.action)) {
        const PartObservation* seen = sample.find(part);
        if (!seen || part == schema.root) continue;
        const bool has_rotation = seen->has_rotation && schema.has_rotation(part);
        const Pose error = (root->X_CB * X_RB).inverse() * seen->X_CB;
        double squared = error.translation().squaredNorm() / (2 * position_m * position_m);
        if (has_rotation)
          squared += log(error).tail<3>().squaredNorm() / (2 * rotation_rad * rotation_rad);
        cost += robust_cost(squared, has_rotation ? 6 : 3);
      }
    }
    return lagged.empty() ? 0 : cost * num_blocks(actions) / static_cast<double>(lagged.size());
  };
  return DelaySearch(samples, cost_of).least_near({.lag_us = lag.us}, {});
}

}  // namespace bodyschema
