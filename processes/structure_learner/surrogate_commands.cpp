#include "processes/structure_learner/surrogate_commands.h"

#include <algorithm>
#include <cstddef>
#include <cstdint>

#include "common/estimation/quantile.h"
#include "common/estimation/time_blocks.h"
#include "processes/structure_learner/screen.h"

namespace bodyschema {
namespace {

constexpr int kShifts = 7;    // around the recording, evenly
constexpr int kFitted = 200;  // frames
constexpr int kMotions = 200;
constexpr int kIterations = 30;
/// Of what other commands mostly leave of the motion, the most that a model's own may, squared:
/// where the stream is too short for blocks, a few poses are fitted by anything. Measured: true
/// models of imperfect robots leave up to 0.06, of 4 s streams 0.08; unrelated commands 0.24 and
/// more, in 4 s one in ten less than 0.03.
constexpr double kMostLeft = 0.25, kMostLeftOfShort = 0.03;

/// Shorter streams than TimeBlocks judges in blocks are poses at rest to the search.
constexpr Eigen::Index kFewest = 24;

bool is_stream(const std::vector<ActionPoseSample>& samples, int num_signals) {
  const NormalizedActions actions(samples, num_signals);
  std::vector<std::int64_t> utimes;
  Eigen::MatrixXd moving(actions.moving().size(), samples.size());
  for (int t = 0; t < actions.num_samples(); ++t) {
    utimes.push_back(samples[static_cast<std::size_t>(t)].utime);
    for (Eigen::Index s = 0; s < moving.rows(); ++s)
      moving(s, t) = actions(t, actions.moving()[static_cast<std::size_t>(s)]);
  }
  return TimeBlocks(utimes, moving, kFewest).is_stream();
}

std::vector<ActionPoseSample> shifted(std::vector<ActionPoseSample> samples, std::size_t by) {
  std::vector<Eigen::VectorXd> actions;
  for (const ActionPoseSample& sample : samples) actions.push_back(sample.action);
  for (std::size_t n = 0; n < samples.size(); ++n)
    samples[n].action = actions[(n + by) % samples.size()];
  return samples;
}

/// Median product of the residuals of successive frames, whitened: noise apart, what is left of the
/// motion.
double slow_residual(const LocalModel& model, const PairData& pair,
                     const NormalizedActions& actions) {
  const Fit fit = evaluate(model, pair, actions);
  std::vector<double> products;
  for (std::size_t n = 1; n < fit.frames.size(); ++n)
    products.push_back(fit.frames[n - 1].residual.dot(fit.frames[n].residual));
  return products.empty() ? 0 : std::max(0.0, upper_median(std::move(products)));
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
    : samples_(samples), measurement_(measurement), actions_(samples, num_signals) {
  if (!is_stream(samples, num_signals)) return;
  for (std::size_t k = 1; k <= kShifts; ++k)
    shifted_.emplace_back(shifted(samples, k * samples.size() / (kShifts + 1)), num_signals);
}

bool SurrogateCommands::are_worse(const AcceptedModel& accepted) const {
  if (shifted_.empty()) return true;
  // The blocks that are left out tell whether a Gaussian process is by chance; where the stream is
  // too short for blocks, a frame's neighbours tell its pose.
  if (!accepted.soft_signals.empty()) return actions_.blocks().is_stream();
  if (accepted.model.joints.empty()) return true;
  const auto data = [&](int max_frames) {
    return make_pair_data(samples_, accepted.part_i, accepted.part_j, measurement_, max_frames);
  };
  const PairData all = data(static_cast<int>(samples_.size())), few = data(kFitted);
  std::vector<double> left;
  for (const NormalizedActions& other : shifted_)
    left.push_back(slow_residual(best_of_as_many(accepted.model, few, other), all, other));
  const double own = slow_residual(
      fit_local_model(accepted.model, few, actions_, kIterations, 1e-2).model, all, actions_);
  const double most = actions_.blocks().is_stream() ? kMostLeft : kMostLeftOfShort;
  return own < most * upper_median(std::move(left));
}

}  // namespace bodyschema
