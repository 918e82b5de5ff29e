#include "processes/structure_learner/noise_estimate.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <set>

#include "common/geometry/angle.h"
#include "processes/structure_learner/long_chain/coupled_joints.h"
#include "processes/structure_learner/long_chain/long_chain.h"
#include "processes/structure_learner/model_free_noise.h"
#include "processes/structure_learner/residual_fit.h"
#include "processes/structure_learner/screen.h"
#include "processes/structure_learner/search/model_forest.h"
#include "processes/structure_learner/told_noise.h"
#include "processes/structure_learner/turn_scan.h"

namespace bodyschema {
namespace {

constexpr double kSafety = 1.2;
constexpr int kFramesOfAPair = 120, kFramesOfAStream = 400, kFramesOfASoftPair = 400;
// Of a pair, per axis: any tag's or tracker's is below.
constexpr double kLargestRotationNoise = 1.5 * kDegree;
constexpr double kLargestBias = 4;  // of a stream, in standard deviations of its white noise

Noise floored(Noise noise, double factor) {
  noise.position_m = std::max(noise.position_m * factor, kNoiseFloor.position_m);
  noise.rotation_rad = std::max(noise.rotation_rad * factor, kNoiseFloor.rotation_rad);
  return noise;
}

Noise believable(Noise noise) {
  noise = floored(noise, kSafety);
  noise.position_m = std::min(noise.position_m, kNoiseCeiling.position_m);
  noise.rotation_rad = std::min(noise.rotation_rad, kNoiseCeiling.rotation_rad);
  return noise;
}

double scale_of(const Noise& noise) {
  const Noise bounded = floored(noise, 1);
  return std::log(bounded.position_m) + std::log(bounded.rotation_rad);
}

// A model of a pair with its leave-one-out residuals and the noise that they speak of.
struct ScaledFit {
  std::vector<NoiseResidual> residuals;
  Noise noise;
  double scale = std::numeric_limits<double>::infinity();  // log of position × rotation noise
  double rigid_scale = std::numeric_limits<double>::infinity();  // of the rigid model
  std::vector<int> signals;                                      // ascending

  void replace_if_explained(ScaledFit by) {
    if (!(by.scale < scale + std::log(kExplained))) return;
    by.rigid_scale = rigid_scale;
    *this = std::move(by);
  }
  bool explains_motion() const { return scale < rigid_scale + std::log(kExplained); }
};

class ModelNoise {
 public:
  ModelNoise(const std::vector<ActionPoseSample>& samples, const NormalizedActions& actions)
      : samples_(samples),
        actions_(actions),
        fixed_parts_(fixed_parts(samples)),
        quantile_(actions.blocks().is_stream() ? kUpperQuantile : kMedianQuantile) {}
  const NoiseQuantile& quantile() const { return quantile_; }

  // The start refined at its own noise: whitening and model in turn.
  ScaledFit refine(LocalModel model, int part_i, int part_j, Noise noise) const {
    ScaledFit result;
    for (int round = 0; round < 4; ++round) {
      const PairData pair = pair_data(part_i, part_j, noise);
      const Fit fit = fit_local_model(model, pair, actions_, round == 0 ? 15 : 8);
      const LeaveOneOut loo = leave_one_out(fit, pair, actions_);
      if (6 * pair.size() - loo.rank < 6) return ScaledFit{};
      model = fit.model;
      std::vector<NoiseResidual> residuals;
      for (int t = 0; t < pair.size(); ++t)
        residuals.push_back(residual_of(loo.residual[t], pair, fit.frames[t]));
      // Leave-one-out residuals are wider than the noise by the model's own uncertainty: exactly so
      // that the mean of d² with (I − H)⁻¹ in it is unbiased. Undo the average widening.
      const double dof = 6.0 * pair.size();
      const double shrink = std::sqrt((dof - loo.rank) / dof);
      for (auto& r : residuals) r.residual *= shrink;
      result.noise = noise_from(residuals, quantile_);
      result.residuals = std::move(residuals);
      noise = floored(result.noise, 1);
    }
    result.scale = scale_of(result.noise);
    const std::set<int> used = signal_set(model);
    result.signals.assign(used.begin(), used.end());
    return result;
  }

  ScaledFit best(int part_i, int part_j, bool with_two_joints) const {
    ScaledFit best;
    const auto offer = [&](ScaledFit fit) {
      fit.rigid_scale = best.rigid_scale;
      if (fit.scale < best.scale) best = std::move(fit);
    };
    const PairData pair = pair_data(part_i, part_j, kRough);
    const bool is_measured = !fixed_parts_.contains(part_i) || !fixed_parts_.contains(part_j);
    if (pair.size() < 3 || !is_measured) return best;
    if (!with_two_joints) {
      offer(refine(screen_rigid(pair, actions_).model, part_i, part_j, kRough));
      best.rigid_scale = best.scale;
      const RelativeMotions motions = relative_motions(pair, 200);
      const auto regressions = screen_one_joint(motions, actions_);
      if (!regressions.empty())
        offer(refine(one_joint_start(regressions[0], pair, actions_, motions.sigma_rad).model,
                     part_i, part_j, kRough));
      for (const Start& start : screen_wide_joint(pair, actions_, motions))
        offer(refine(start.model, part_i, part_j, kRough));
    } else {
      const RelativeMotions motions = relative_motions(pair, 200);
      const std::vector<std::vector<double>> turns(actions_.num_signals(), default_turns());
      const auto starts = screen_two_joints(pair, actions_, motions, turns, 6);
      for (std::size_t n = 0; n < starts.size(); ++n)
        offer(refine(starts[n].model, part_i, part_j, kRough));
    }
    return best;
  }

  // A Gaussian process, by the blocks of time that are left out.
  void offer_soft(int part_i, int part_j, ScaledFit* best) const {
    ScaledFit soft;
    Noise noise = kRough;
    for (int round = 0; round < 4; ++round) {
      const PairData pair = pair_data(part_i, part_j, noise, kFramesOfASoftPair);
      // Which signals it needs shows at a noise that is about right.
      const std::vector<int> signals = round < 2 ? std::vector<int>{} : soft.signals;
      const auto fit =
          fit_soft_model(screen_rigid(pair, actions_).model, pair, actions_, {}, signals);
      if (!fit) return;
      soft.signals = fit->model.signals;
      soft.residuals.clear();
      for (int t = 0; t < pair.size(); ++t)
        soft.residuals.push_back(residual_of(fit->residual[t], pair, fit->frames[t]));
      soft.noise = noise_from(soft.residuals, quantile_);
      noise = floored(soft.noise, 1);
    }
    soft.scale = scale_of(soft.noise);
    best->replace_if_explained(std::move(soft));
  }

  // A chain on all signals.
  void offer_long_chain(int part_i, int part_j, int max_joints, ScaledFit* best) const {
    const std::vector<int>& signals = actions_.moving();
    const int m = static_cast<int>(signals.size());
    const PairData pair = pair_data(part_i, part_j, kRough);
    const int num_independent =
        actions_.blocks().count(pair.frames, [](const PairFrame& frame) { return frame.sample; });
    if (m <= kMaxScreenedJoints || m > max_joints || num_independent < kPosesPerJoint * m) return;
    const JointOrder order =
        actions_.blocks().is_stream() ? JointOrder::kListed : JointOrder::kUnknown;
    const auto fit = fit_long_chain(pair, actions_, signals, order, kLargestRotationNoise);
    if (!fit) return;
    ScaledFit chain = refine(fit->model, part_i, part_j, kRough);
    const Noise noise = floored(chain.noise, 1);
    best->replace_if_explained(std::move(chain));
    offer_coupled(fit->model, part_i, part_j, noise, best);
  }

  // The chain with joints that a second signal moves, too.
  void offer_coupled(const LocalModel& chain, int part_i, int part_j, const Noise& noise,
                     ScaledFit* best) const {
    const PairData pair = pair_data(part_i, part_j, noise);
    const Fit coupled =
        with_coupled_joints(fit_local_model(chain, pair, actions_, 15, 1e-2), pair, actions_);
    if (coupled.model.num_joints() > chain.num_joints())
      best->replace_if_explained(refine(coupled.model, part_i, part_j, noise));
  }

 private:
  static constexpr Noise kRough{0.005, 0.03};

  NoiseResidual residual_of(const Vector6d& residual, const PairData& pair,
                            const FrameFit& frame) const {
    const bool is_fixed = fixed_parts_.contains(pair.part_i);
    const double markers = is_fixed || fixed_parts_.contains(pair.part_j) ? 1 : 2;
    if (is_fixed || actions_.blocks().is_stream())
      return {residual, Eigen::Vector3d::Zero(), markers};
    return {residual, pair.hypotheses[frame.hypothesis].z.inverse().translation(), markers};
  }

  PairData pair_data(int part_i, int part_j, const Noise& noise) const {
    return pair_data(part_i, part_j, noise,
                     actions_.blocks().is_stream() ? kFramesOfAStream : kFramesOfAPair);
  }
  PairData pair_data(int part_i, int part_j, const Noise& noise, int max_frames) const {
    MeasurementModel measurement;
    measurement.noise = noise;
    measurement.fixed_parts = fixed_parts_;
    return make_pair_data(samples_, part_i, part_j, measurement, max_frames);
  }

  const std::vector<ActionPoseSample>& samples_;
  const NormalizedActions& actions_;
  const std::set<int> fixed_parts_;
  const NoiseQuantile quantile_;
};

// Prim's minimum spanning tree by scale: every part by the partner that predicts it best.
std::vector<std::pair<int, int>> spanning_tree(
    int num_parts, const std::map<std::pair<int, int>, ScaledFit>& fits) {
  std::vector<bool> in_tree(num_parts, false);
  in_tree[0] = true;
  std::vector<std::pair<int, int>> tree;
  while (true) {
    std::pair<int, int> best{-1, -1};
    double best_scale = std::numeric_limits<double>::infinity();
    for (const auto& [ij, fit] : fits) {
      if (in_tree[ij.first] == in_tree[ij.second] || !(fit.scale < best_scale)) continue;
      best_scale = fit.scale;
      best = ij;
    }
    if (best.first < 0) return tree;
    in_tree[best.first] = in_tree[best.second] = true;
    tree.push_back(best);
  }
}

// The pairs that are worth a model: of few parts all; of many, those that move little against each
// other, for the fewer joints there are between two parts, the less they do. Each part's nearest
// ones, and what connects them all.
std::vector<std::pair<int, int>> near_pairs(const std::vector<ActionPoseSample>& samples,
                                            const std::vector<int>& parts) {
  constexpr int kFewParts = 16, kNearest = 6, kMotions = 24;
  constexpr double kMetresPerRadian = 0.2;  // about the length of a link
  const int n = static_cast<int>(parts.size());
  std::vector<std::pair<int, int>> result;
  std::map<std::pair<int, int>, ScaledFit> motion;
  std::vector<std::vector<std::pair<double, int>>> near(parts.size());
  for (int i = 0; i < n; ++i)
    for (int j = i + 1; j < n; ++j) {
      if (n <= kFewParts) {
        result.emplace_back(i, j);
        continue;
      }
      const PairData pair = make_pair_data(samples, parts[i], parts[j], {}, 2 * kMotions);
      std::vector<double> moved;
      for (const auto& m : relative_motions(pair, kMotions).motions)
        moved.push_back(m.log.head<3>().norm() + kMetresPerRadian * m.log.tail<3>().norm());
      if (moved.empty()) continue;
      const double typical = kMedianQuantile.of(std::move(moved));
      motion[{i, j}].scale = typical;
      near[i].emplace_back(typical, j);
      near[j].emplace_back(typical, i);
    }
  if (n <= kFewParts) return result;
  std::set<std::pair<int, int>> chosen;
  for (int i = 0; i < n; ++i) {
    std::sort(near[i].begin(), near[i].end());
    for (std::size_t k = 0; k < std::min<std::size_t>(kNearest, near[i].size()); ++k)
      chosen.insert(std::minmax(i, near[i][k].second));
  }
  for (const auto& ij : spanning_tree(n, motion)) chosen.insert(ij);
  return {chosen.begin(), chosen.end()};
}

using FitsOfPairs = std::map<std::pair<int, int>, ScaledFit>;

// Where one joint does not suffice, more may, or a Gaussian process. Edges far above the quietest
// do, those of a stream far above its jitter, and what is no marker's noise; with few edges any
// may. A soft body passes for a chain of many joints, roughly: a process is offered there, too.
void offer_richer_models(const ModelNoise& model_noise, const std::vector<int>& parts,
                         const std::vector<std::pair<int, int>>& tree,
                         const std::optional<Noise>& jitter, int max_signals, FitsOfPairs* fits) {
  double quietest = std::numeric_limits<double>::infinity();
  for (const auto& ij : tree) quietest = std::min(quietest, fits->at(ij).scale);
  const auto may_be_richer = [&](const ScaledFit& fit) {
    return tree.size() <= 2 || fit.scale >= quietest + std::log(4.0) ||
           is_above_any_marker(fit.noise) ||
           (jitter && fit.scale > scale_of(floored(*jitter, kLargestBias)));
  };
  for (const auto& ij : tree) {
    ScaledFit& fit = fits->at(ij);
    const int part_i = parts[ij.first], part_j = parts[ij.second];
    if (max_signals >= 2 && may_be_richer(fit)) {
      ScaledFit two = model_noise.best(part_i, part_j, true);
      two.rigid_scale = fit.rigid_scale;
      if (two.scale < fit.scale) fit = std::move(two);
    }
    if (max_signals > kMaxScreenedJoints && may_be_richer(fit))
      model_noise.offer_long_chain(part_i, part_j, max_signals, &fit);
    const bool is_long = fit.signals.size() > kMaxScreenedJoints;
    if (max_signals > 0 && (is_long || may_be_richer(fit)))
      model_noise.offer_soft(part_i, part_j, &fit);
  }
}

// Of the quieter fits: an edge across two hidden parts has no model here and would speak of motion,
// not of noise. Those no worse than four times the lower quartile in the product of both noises; of
// a stream, the lower half.
std::vector<NoiseResidual> residuals_of_quiet(const std::vector<const ScaledFit*>& fits,
                                              bool is_stream) {
  std::vector<double> scales;
  for (const ScaledFit* fit : fits) scales.push_back(fit->scale);
  std::sort(scales.begin(), scales.end());
  const double limit =
      is_stream ? scales[scales.size() / 2] : scales[scales.size() / 4] + std::log(4.0);
  std::vector<NoiseResidual> pooled;
  for (const ScaledFit* fit : fits)
    if (fit->scale <= limit)
      pooled.insert(pooled.end(), fit->residuals.begin(), fit->residuals.end());
  return pooled;
}

}  // namespace

bool is_above_any_marker(const Noise& noise) {
  return noise.position_m > kLoudestMarker.position_m ||
         noise.rotation_rad > kLoudestMarker.rotation_rad;
}

std::optional<SourcedNoise> estimate_noise(const std::vector<ActionPoseSample>& samples,
                                           int num_signals, int max_signals) {
  const NormalizedActions actions(samples, num_signals);
  if (const auto noise = noise_from_repeats(samples, actions))
    return SourcedNoise{believable(*noise), NoiseSource::kRepeats};

  const std::vector<int> parts = seen_parts(samples);
  const int n = static_cast<int>(parts.size());
  if (n < 2) return std::nullopt;

  const ModelNoise model_noise(samples, actions);
  FitsOfPairs fits;
  for (const auto& [i, j] : near_pairs(samples, parts))
    fits[{i, j}] = model_noise.best(parts[i], parts[j], false);

  const std::vector<std::pair<int, int>> tree = spanning_tree(n, fits);
  if (tree.empty()) return std::nullopt;
  const std::optional<Noise> jitter = noise_from_neighbours(samples, actions);
  offer_richer_models(model_noise, parts, tree, jitter, max_signals, &fits);

  std::vector<const ScaledFit*> all, explaining;
  for (const auto& ij : tree) {
    all.push_back(&fits[ij]);
    if (fits[ij].explains_motion()) explaining.push_back(&fits[ij]);
  }
  const bool is_any_explained = !explaining.empty();
  const auto pooled =
      residuals_of_quiet(jitter && is_any_explained ? explaining : all, jitter.has_value());
  if (pooled.size() < 6) return std::nullopt;
  SourcedNoise noise{noise_from(pooled, model_noise.quantile()), NoiseSource::kResiduals};
  // What no model explains is motion; of a stream, also what is above any marker but does not jump.
  const bool is_loud = is_above_any_marker(noise);
  if (jitter) {
    const Noise most = floored(*jitter, kLargestBias);
    const bool is_above =
        noise.position_m > most.position_m || noise.rotation_rad > most.rotation_rad;
    if (is_above && (is_loud || !is_any_explained)) {
      noise.position_m = std::min(noise.position_m, most.position_m);
      noise.rotation_rad = std::min(noise.rotation_rad, most.rotation_rad);
      noise.source = NoiseSource::kFrames;
    }
  } else if (is_loud && !is_any_explained) {
    noise = {kLoudestMarker, NoiseSource::kAssumed};
  }
  static_cast<Noise&>(noise) = believable(noise);
  return noise;
}

}  // namespace bodyschema
