#include "processes/structure_learner/surrogate_commands.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <numeric>
#include <random>
#include <utility>

#include "common/estimation/quantile.h"
#include "processes/structure_learner/screen.h"

namespace bodyschema {
namespace {

/// Shorter streams than those that the search judges in blocks.
constexpr Eigen::Index kFewestInstants = 24;
/// Shifts: so many are tried, so many are enough, and with fewer nothing is said. Chosen.
constexpr int kTried = 32, kEnough = 7, kFewest = 3;
/// Share of the shifted commands' variance that the true ones explain, above which they are these.
constexpr double kSameCommands = 0.6;
/// Frames of a fit, and products of a median. Chosen.
constexpr int kFitted = 200;
constexpr std::size_t kFewestProducts = 20;
constexpr std::ptrdiff_t kFewestMoved = 2 * kFewestProducts;
constexpr int kMotions = 200;
constexpr int kIterations = 30;
/// What a model may leave, of what time-shifted commands mostly leave, in squares: of enough
/// blocks; fewer are fitted by anything. Measured, `imperfect_robots --samples 2000 --stream 100`:
/// true models leave up to 0.06 of about 55 blocks; of 4 blocks mostly below 0.005, unrelated
/// commands from 0.02 on.
constexpr double kMostLeft = 0.12, kEnoughBlocks = 15;
/// Of poses at rest: of the least that so many orders leave. Of 90 recordings with the command of
/// another pose, models in noise above any marker's leave 0.49 and more.
constexpr int kShuffled = 15, kFewestPoses = 8;
constexpr double kMostLeftAtRest = 0.35;

TimeBlocks blocks_of(const std::vector<ActionPoseSample>& samples,
                     const NormalizedActions& actions) {
  std::vector<std::int64_t> utimes;
  for (const ActionPoseSample& sample : samples) utimes.push_back(sample.utime);
  return {utimes, actions.moving_values(), kFewestInstants};
}

/// Share of the variance of `others` that a linear function of `values` has; signals × samples
/// each.
double explained_share(const Eigen::MatrixXd& values, const Eigen::MatrixXd& others) {
  const Eigen::MatrixXd x = values.colwise() - values.rowwise().mean();
  const Eigen::MatrixXd y = others.colwise() - others.rowwise().mean();
  const Eigen::MatrixXd xy = x * y.transpose();
  const double explained = (xy.transpose() * (x * x.transpose()).ldlt().solve(xy)).trace();
  return explained / y.squaredNorm();
}

/// By sample, whether one of the model's signals is away from where it mostly is: where they rest
/// shifted commands tell as much. All samples if none rests, or if these are too few.
std::vector<bool> moved_samples(const LocalModel& model, const NormalizedActions& actions) {
  std::vector<bool> result(static_cast<std::size_t>(actions.num_samples()));
  for (const int signal : signal_set(model)) {
    std::vector<double> values;
    for (int n = 0; n < actions.num_samples(); ++n) values.push_back(actions(n, signal));
    const auto usual = usual_value(values);
    for (std::size_t n = 0; n < values.size(); ++n)
      if (!usual || std::abs(values[n] - *usual) > kResting) result[n] = true;
  }
  if (std::ranges::count(result, true) < kFewestMoved) result.assign(result.size(), true);
  return result;
}

/// Median product of the residuals of frames among `chosen` that follow each other within
/// `most_apart` samples, whitened: noise apart, what is left of the motion. Negative if there are
/// too few.
double slow_residual(const LocalModel& model, const PairData& pair,
                     const NormalizedActions& actions, const std::vector<bool>& chosen,
                     int most_apart) {
  const Fit fit = evaluate(model, pair, actions);
  std::vector<double> products;
  for (std::size_t n = 1; n < fit.frames.size(); ++n)
    if (chosen[static_cast<std::size_t>(pair.frames[n].sample)] &&
        pair.frames[n].sample - pair.frames[n - 1].sample <= most_apart)
      products.push_back(fit.frames[n - 1].residual.dot(fit.frames[n].residual));
  if (products.size() < kFewestProducts) return -1;
  return std::max(0.0, upper_median(std::move(products)));
}

/// Median squared distance, whitened.
double typical_residual(const LocalModel& model, const PairData& pair,
                        const NormalizedActions& actions) {
  const Fit fit = evaluate(model, pair, actions);
  std::vector<double> distances;
  for (const FrameFit& frame : fit.frames) distances.push_back(frame.squared_distance);
  return distances.empty() ? -1 : upper_median(std::move(distances));
}

/// The best of the closed-form starts with as many joints, and of the model itself, refined.
LocalModel best_of_as_many(const LocalModel& model, const PairData& pair,
                           const NormalizedActions& actions) {
  std::vector<LocalModel> starts{model};
  const RelativeMotions motions = relative_motions(pair, kMotions);
  if (model.num_joints() == 1) {
    for (const ScrewRegression& regression : screen_one_joint(motions, actions))
      starts.push_back(one_joint_start(regression, pair, actions, motions.sigma_rad).model);
  } else if (model.num_joints() == 2) {
    const std::vector<std::vector<double>> turns(actions.num_signals(), default_turns());
    for (const Start& start : screen_two_joints(pair, actions, motions, turns, 3))
      starts.push_back(start.model);
  }
  Fit best;
  for (std::size_t n = 0; n < starts.size(); ++n) {
    Fit fit = fit_local_model(starts[n], pair, actions, kIterations, 1e-2);
    if (n == 0 || fit.cost < best.cost) best = std::move(fit);
  }
  return best.model;
}

}  // namespace

SurrogateCommands::SurrogateCommands(const std::vector<ActionPoseSample>& samples, int num_signals,
                                     const MeasurementModel& measurement)
    : samples_(samples),
      measurement_(measurement),
      actions_(samples, num_signals),
      blocks_(blocks_of(samples, actions_)) {
  if (is_stream())
    shift();
  else if (samples.size() >= static_cast<std::size_t>(kFewestPoses))
    shuffle();
}

void SurrogateCommands::shift() {
  // In no simple ratio to any period; nor so near that the commands are still alike.
  const double golden = (std::sqrt(5) - 1) / 2;
  const int size = actions_.num_samples(), nearest = std::min(blocks_.length(), size / 4);
  const int range = size - 2 * nearest;
  for (int k = 1; k <= kTried && others_.size() < kEnough; ++k) {
    const double share = k * golden - std::floor(k * golden);
    const int by = nearest + static_cast<int>(share * range);
    std::vector<int> order(static_cast<std::size_t>(size));
    for (int n = 0; n < size; ++n) order[static_cast<std::size_t>(n)] = (n + size - by) % size;
    NormalizedActions other = actions_.reordered(order);
    if (explained_share(actions_.moving_values(), other.moving_values()) < kSameCommands)
      others_.push_back(std::move(other));
  }
  if (others_.size() < kFewest) others_.clear();
}

void SurrogateCommands::shuffle() {
  std::vector<int> order(static_cast<std::size_t>(actions_.num_samples()));
  std::iota(order.begin(), order.end(), 0);
  std::mt19937 rng(1);
  for (int k = 0; k < kShuffled; ++k) {
    // Not std::shuffle, which differs from library to library.
    for (std::size_t n = order.size() - 1; n > 0; --n) std::swap(order[n], order[rng() % (n + 1)]);
    others_.push_back(actions_.reordered(order));
  }
}

bool SurrogateCommands::explain_as_well(const AcceptedModel& accepted) const {
  if (others_.empty() || accepted.model.joints.empty() || !accepted.soft_signals.empty())
    return false;
  const auto data = [&](int max_frames) {
    return make_pair_data(samples_, accepted.part_i, accepted.part_j, measurement_, max_frames);
  };
  const PairData few = data(kFitted), all = is_stream() ? data(actions_.num_samples()) : few;
  const int most_apart = std::max(1, blocks_.length() / 4);
  const std::vector<bool> moved = moved_samples(accepted.model, actions_);
  const auto left_by = [&](const LocalModel& model, const NormalizedActions& actions) {
    return is_stream() ? slow_residual(model, all, actions, moved, most_apart)
                       : typical_residual(model, all, actions);
  };
  const double own =
      left_by(fit_local_model(accepted.model, few, actions_, kIterations, 1e-2).model, actions_);
  if (own < 0) return false;
  std::vector<double> left;
  for (const NormalizedActions& other : others_)
    left.push_back(left_by(best_of_as_many(accepted.model, few, other), other));
  if (!is_stream()) return !(own < kMostLeftAtRest * *std::ranges::min_element(left));
  const double num_blocks = static_cast<double>(std::ranges::count(moved, true)) / blocks_.length();
  const double most = kMostLeft * std::pow(std::min(1.0, num_blocks / kEnoughBlocks), 2);
  return !(own < most * upper_median(std::move(left)));
}

}  // namespace bodyschema
