#include "processes/structure_learner/positions/position_noise.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "common/estimation/chi_square.h"
#include "common/estimation/quantile.h"
#include "common/geometry/angle.h"
#include "processes/structure_learner/model_free_noise.h"
#include "processes/structure_learner/positions/position_parents.h"
#include "processes/structure_learner/tree_fit.h"

namespace bodyschema {
namespace {

/// More is no noise: as learn.cpp's kLargestGuess.
constexpr Noise kLargestGuess{0.01, 3 * kDegree};
constexpr double kSafety = 1.2;  // as noise_estimate.cpp
constexpr int kMinRepeats = 5;

// Standard deviation per axis from lengths of residuals.
double deviation(std::vector<double> lengths) {
  return median(std::move(lengths)) / std::sqrt(chi_square_median(3));
}

std::optional<double> noise_of_repeats(const std::vector<ActionPoseSample>& samples,
                                       const std::vector<int>& leaves,
                                       const NormalizedActions& actions) {
  std::vector<double> lengths;
  for (const std::vector<int>& members : repeats(actions))
    for (const int leaf : leaves) {
      std::vector<Eigen::Vector3d> positions;
      for (const int t : members)
        if (const PartObservation* o = samples[static_cast<std::size_t>(t)].find(leaf))
          positions.push_back(o->X_CB.translation());
      const auto n = static_cast<double>(positions.size());
      if (n < kMinRepeats) continue;
      Eigen::Vector3d middle;
      for (int axis = 0; axis < 3; ++axis) {
        std::vector<double> values;
        for (const Eigen::Vector3d& p : positions) values.push_back(p(axis));
        middle(axis) = median(std::move(values));
      }
      for (const Eigen::Vector3d& p : positions)
        lengths.push_back(std::sqrt(n / (n - 1)) * (p - middle).norm());
    }
  if (lengths.size() < 10) return std::nullopt;
  return deviation(std::move(lengths));
}

// Of the model of a leaf that leaves least, for its parameters, of up to two joints; or of all.
std::optional<double> noise_of_best_model(int leaf, const PositionParents& parents,
                                          const NormalizedActions& actions, bool with_chains) {
  constexpr int kFrames = 120;
  constexpr std::size_t kFits = 8;
  // A chain that leaves so much less than one or two joints ends the search for a better one.
  constexpr double kLessThanFew = 0.003;
  std::vector<PairData> pairs;
  for (const int parent : parents.parts()) pairs.push_back(parents.pair(parent, leaf, kFrames));
  std::optional<double> noise;
  double least = std::numeric_limits<double>::infinity();
  const auto consider = [&](const Fit& fit, const PairData& pair) {
    const LeaveOneOut loo = leave_one_out(fit, pair, actions);
    const double count = 3.0 * pair.size(), dof = count - loo.rank;
    if (dof < 2 * loo.rank) return;
    std::vector<double> lengths;
    for (const Vector6d& r : loo.residual)
      lengths.push_back(std::sqrt(dof / count) * r.head<3>().norm());
    const double sigma = std::max(deviation(std::move(lengths)), kNoiseFloor.position_m);
    const double cost = count * std::log(sigma) + 0.5 * loo.rank * std::log(count);
    if (cost >= least) return;
    least = cost;
    noise = sigma;
  };
  int num_screens = 0;
  for (int k = 0; k <= kMaxScreenedJoints; ++k) {
    std::vector<StartAt> starts = starts_of(pairs, actions, k, &num_screens);
    starts.resize(std::min(starts.size(), kFits));
    for (const StartAt& s : starts)
      consider(fit_local_model(s.start.model, pairs[s.parent], actions, 40, 1e-6), pairs[s.parent]);
  }
  if (!with_chains) return noise;
  const double goal_m = kLessThanFew * noise.value_or(kLargestGuess.position_m);
  for (const std::size_t p : most_often_seen(pairs))
    if (const auto chain = fit_position_chain(pairs[p], actions, actions.moving(),
                                              order_of_chains(parents, actions), goal_m))
      consider(*chain, pairs[p]);
  return noise;
}

}  // namespace

std::optional<Noise> noise_at_rest(const std::vector<ActionPoseSample>& samples, int part,
                                   const NormalizedActions& actions,
                                   const ValidityOptions& options) {
  MeasurementModel measurement;
  measurement.noise = kLargestGuess;
  const PairData rough = make_part_data(samples, part, measurement, kMaxPositionFrames);
  if (rough.size() < kMinRepeats) return std::nullopt;
  const Fit fit = fit_local_model(screen_rigid(rough, actions).model, rough, actions, 20, 1e-6);
  std::vector<double> positions, rotations;
  for (const FrameFit& frame : fit.frames) {
    positions.push_back(frame.error.head<3>().norm());
    rotations.push_back(frame.error.tail<3>().norm());
  }
  Noise noise{kSafety * deviation(std::move(positions)), kSafety * deviation(std::move(rotations))};
  if (noise.position_m > kLargestGuess.position_m ||
      noise.rotation_rad > kLargestGuess.rotation_rad)
    return std::nullopt;
  noise.position_m = std::max(noise.position_m, kNoiseFloor.position_m);
  noise.rotation_rad = std::max(noise.rotation_rad, kNoiseFloor.rotation_rad);
  measurement.noise = noise;
  if (!is_at_rest(make_part_data(samples, part, measurement, kMaxPositionFrames), actions, options))
    return std::nullopt;
  return noise;
}

std::optional<SourcedNoise> estimate_position_noise(const std::vector<ActionPoseSample>& samples,
                                                    const NormalizedActions& actions, int root,
                                                    const std::set<int>& resting) {
  const std::vector<int> leaves = parts_without_rotation(samples);
  SourcedNoise noise;
  noise.rotation_rad = kNoiseFloor.rotation_rad;
  noise.source = NoiseSource::kRepeats;
  std::optional<double> sigma = noise_of_repeats(samples, leaves, actions);
  if (!sigma) {
    noise.source = NoiseSource::kResiduals;
    MeasurementModel rough;
    rough.noise = Noise{0.005, kNoiseFloor.rotation_rad};
    const PositionParents parents(samples, actions, root, resting, rough);
    // Parts that no model explains leave motion, others noise. A long chain is one of few that may
    // be meant, and leaves more than noise where its signals move joints elsewhere, too: it is
    // asked last, unless there is nothing else to ask.
    const auto of_all = [&](bool with_chains) {
      std::optional<double> least;
      for (const int leaf : leaves)
        if (const auto of_leaf = noise_of_best_model(leaf, parents, actions, with_chains))
          least = std::min(least.value_or(*of_leaf), *of_leaf);
      return least;
    };
    sigma = of_all(leaves.size() == 1);
    if (leaves.size() > 1 && (!sigma || *sigma > kLargestGuess.position_m)) sigma = of_all(true);
    if (sigma && *sigma > kLargestGuess.position_m) return std::nullopt;
  }
  if (!sigma) return std::nullopt;
  noise.position_m = std::max(kSafety * *sigma, kNoiseFloor.position_m);
  return noise;
}

}  // namespace bodyschema
