#include "processes/structure_learner/noise_estimate.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>

#include "common/estimation/quantile.h"
#include "common/geometry/angle.h"
#include "processes/structure_learner/long_chain/long_chain.h"
#include "processes/structure_learner/screen.h"
#include "processes/structure_learner/turn_scan.h"

namespace bodyschema {
namespace {

constexpr double kMedianChi3 = 2.366;  // median of χ²₃
constexpr double kSafety = 1.2;
constexpr int kFramesOfAPair = 120;
constexpr int kMinRepeats = 5;
// Of a pair, per axis: any tag's or tracker's is below.
constexpr double kLargestRotationNoise = 1.5 * kDegree;
constexpr double kLargestBias = 4;  // of a stream, in standard deviations of its white noise

// A residual log(Δ̂⁻¹ z) of a relative pose with the lever arm that carries the rotation noise of
// part i into its position. For a single marker the lever is 0 and `markers` 1.
struct NoiseResidual {
  Vector6d residual;
  Eigen::Vector3d lever = Eigen::Vector3d::Zero();
  double markers = 2;
};

// Noise per axis of one marker from residuals whose covariance is `markers`·σ² plus the lever's
// part.
Noise noise_from(const std::vector<NoiseResidual>& residuals) {
  Noise noise;
  std::vector<double> values;
  for (const auto& r : residuals) values.push_back(r.residual.tail<3>().squaredNorm() / r.markers);
  noise.rotation_rad = std::sqrt(upper_median(values) / kMedianChi3);
  const double rotation_variance = noise.rotation_rad * noise.rotation_rad;
  // The position variance that brings the median of the whitened position residuals to that of χ²₃:
  // the covariance is v·m along the lever and v·m + |lever|²σ_r² across it.
  const auto median_at = [&](double v) {
    values.clear();
    for (const auto& r : residuals) {
      const double l2 = r.lever.squaredNorm();
      const double along2 = l2 > 0 ? std::pow(r.residual.head<3>().dot(r.lever), 2) / l2 : 0.0;
      const double across2 = r.residual.head<3>().squaredNorm() - along2;
      values.push_back(along2 / (v * r.markers) +
                       across2 / (v * r.markers + l2 * rotation_variance));
    }
    return upper_median(values);
  };
  double low = 1e-20, high = 1e2;  // [m²]
  for (int n = 0; n < 60; ++n) {
    const double middle = std::sqrt(low * high);
    (median_at(middle) > kMedianChi3 ? low : high) = middle;
  }
  noise.position_m = std::sqrt(high);
  return noise;
}

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

// Median pose: iteratively re-weighted mean with weights 1/|residual|.
Pose robust_mean(const std::vector<Pose>& poses) {
  Pose mean = poses[poses.size() / 2];
  for (int round = 0; round < 20; ++round) {
    Eigen::Vector3d dv = Eigen::Vector3d::Zero(), dw = Eigen::Vector3d::Zero();
    double sv = 0, sw = 0;
    for (const Pose& pose : poses) {
      const Vector6d r = log(mean.inverse() * pose);
      const double wv = 1 / std::max(r.head<3>().norm(), 1e-9);
      const double ww = 1 / std::max(r.tail<3>().norm(), 1e-9);
      dv += wv * r.head<3>();
      dw += ww * r.tail<3>();
      sv += wv;
      sw += ww;
    }
    Vector6d step;
    step << dv / sv, dw / sw;
    mean = mean * exp(step);
  }
  return mean;
}

std::optional<Noise> noise_from_repeats(const std::vector<ActionPoseSample>& samples,
                                        const NormalizedActions& actions) {
  if (actions.moving().empty()) return std::nullopt;
  // Repeats: the same action up to a millionth of the range.
  std::map<std::vector<long>, std::vector<int>> groups;
  for (int t = 0; t < actions.num_samples(); ++t) {
    std::vector<long> key;
    for (const int s : actions.moving()) key.push_back(std::lround(actions(t, s) * 1e6));
    groups[key].push_back(t);
  }
  std::vector<NoiseResidual> residuals;
  for (const auto& [key, members] : groups) {
    std::map<int, std::vector<Pose>> poses;
    for (const int t : members)
      for (const PartObservation& o : samples[t].parts) poses[o.part].push_back(o.X_CB);
    for (const auto& [part, of_part] : poses) {
      const double n = static_cast<double>(of_part.size());
      if (n < kMinRepeats) continue;
      const Pose mean = robust_mean(of_part);
      for (const Pose& pose : of_part)
        residuals.push_back(
            {std::sqrt(n / (n - 1)) * log(mean.inverse() * pose), Eigen::Vector3d::Zero(), 1.0});
    }
  }
  if (residuals.size() < 10) return std::nullopt;
  return noise_from(residuals);
}

// The white part of a stream's noise, whatever the model: from what is left of three successive
// poses of a part when its motion is taken to be uniform.
std::optional<Noise> noise_from_neighbours(const std::vector<ActionPoseSample>& samples,
                                           const NormalizedActions& actions) {
  if (!actions.blocks().is_stream()) return std::nullopt;
  std::vector<NoiseResidual> residuals;
  for (std::size_t t = 1; t + 1 < samples.size(); ++t)
    for (const PartObservation& o : samples[t].parts) {
      const PartObservation* before = samples[t - 1].find(o.part);
      const PartObservation* after = samples[t + 1].find(o.part);
      if (!before || !after) continue;
      const Pose inverse = o.X_CB.inverse();
      residuals.push_back({log(inverse * before->X_CB) + log(inverse * after->X_CB),
                           Eigen::Vector3d::Zero(), 6.0});  // variance of (1, −2, 1)
    }
  if (residuals.size() < 10) return std::nullopt;
  return noise_from(residuals);
}

// A model of a pair with its leave-one-out residuals and the noise that they speak of.
struct ScaledFit {
  std::vector<NoiseResidual> residuals;
  Noise noise;
  double scale = std::numeric_limits<double>::infinity();  // log of position × rotation noise
};

class ModelNoise {
 public:
  ModelNoise(const std::vector<ActionPoseSample>& samples, const NormalizedActions& actions)
      : samples_(samples), actions_(actions) {}

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
        residuals.push_back({loo.residual[t],
                             pair.hypotheses[fit.frames[t].hypothesis].z.inverse().translation(),
                             2.0});
      // Leave-one-out residuals are wider than the noise by the model's own uncertainty: exactly so
      // that the mean of d² with (I − H)⁻¹ in it is unbiased. Undo the average widening.
      const double dof = 6.0 * pair.size();
      const double shrink = std::sqrt((dof - loo.rank) / dof);
      for (auto& r : residuals) r.residual *= shrink;
      result.noise = noise_from(residuals);
      result.residuals = std::move(residuals);
      noise = floored(result.noise, 1);
    }
    const Noise bounded = floored(result.noise, 1);
    result.scale = std::log(bounded.position_m) + std::log(bounded.rotation_rad);
    return result;
  }

  ScaledFit best(int part_i, int part_j, bool with_two_joints) const {
    ScaledFit best;
    const auto offer = [&](ScaledFit fit) {
      if (fit.scale < best.scale) best = std::move(fit);
    };
    const PairData pair = pair_data(part_i, part_j, kRough);
    if (pair.size() < 3) return best;
    if (!with_two_joints) {
      offer(refine(screen_rigid(pair, actions_).model, part_i, part_j, kRough));
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

  // Replaces `best` if a chain on all signals leaves less than half of the product of its noises.
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
    if (chain.scale < best->scale - std::log(2.0)) *best = std::move(chain);
  }

 private:
  static constexpr Noise kRough{0.005, 0.03};

  PairData pair_data(int part_i, int part_j, const Noise& noise) const {
    MeasurementModel measurement;
    measurement.noise = noise;
    return make_pair_data(samples_, part_i, part_j, measurement, kFramesOfAPair);
  }

  const std::vector<ActionPoseSample>& samples_;
  const NormalizedActions& actions_;
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

}  // namespace

std::optional<SourcedNoise> estimate_noise(const std::vector<ActionPoseSample>& samples,
                                           int num_signals, int max_signals) {
  const NormalizedActions actions(samples, num_signals);
  // What moves under one command, or where no model holds, is no noise: that of a stream is not
  // taken for more than what jumps from frame to frame and what a marker's bias may add to it.
  const auto bounded = [&](Noise noise, NoiseSource source) {
    if (const auto white = noise_from_neighbours(samples, actions)) {
      const Noise most = floored(*white, kLargestBias);
      if (most.position_m < noise.position_m || most.rotation_rad < noise.rotation_rad)
        source = NoiseSource::kFrames;
      noise.position_m = std::min(noise.position_m, most.position_m);
      noise.rotation_rad = std::min(noise.rotation_rad, most.rotation_rad);
    }
    return SourcedNoise{believable(noise), source};
  };
  if (const auto noise = noise_from_repeats(samples, actions))
    return bounded(*noise, NoiseSource::kRepeats);

  const std::vector<int> parts = seen_parts(samples);
  const int n = static_cast<int>(parts.size());
  if (n < 2) return std::nullopt;

  const ModelNoise model_noise(samples, actions);
  std::map<std::pair<int, int>, ScaledFit> fits;
  for (int i = 0; i < n; ++i)
    for (int j = i + 1; j < n; ++j) fits[{i, j}] = model_noise.best(parts[i], parts[j], false);

  const std::vector<std::pair<int, int>> tree = spanning_tree(n, fits);
  if (tree.empty()) return std::nullopt;

  // Where one joint does not suffice, two may. Edges far above the quietest do, and with few edges
  // any may.
  double quietest = std::numeric_limits<double>::infinity();
  for (const auto& ij : tree) quietest = std::min(quietest, fits[ij].scale);
  if (max_signals >= 2) {
    for (const auto& ij : tree) {
      if (tree.size() > 2 && fits[ij].scale < quietest + std::log(4.0)) continue;
      ScaledFit two = model_noise.best(parts[ij.first], parts[ij.second], true);
      if (two.scale < fits[ij].scale) fits[ij] = std::move(two);
    }
  }
  if (max_signals > kMaxScreenedJoints)
    for (const auto& ij : tree)
      if (tree.size() <= 2 || fits[ij].scale >= quietest + std::log(4.0))
        model_noise.offer_long_chain(parts[ij.first], parts[ij.second], max_signals, &fits[ij]);

  // Pool the edges no worse than four times the lower quartile (in the product of both noises): an
  // edge across two hidden parts has no model here and would speak of motion, not of noise.
  std::vector<double> scales;
  for (const auto& ij : tree) scales.push_back(fits[ij].scale);
  std::sort(scales.begin(), scales.end());
  const double limit = scales[scales.size() / 4] + std::log(4.0);
  std::vector<NoiseResidual> pooled;
  for (const auto& ij : tree)
    if (fits[ij].scale <= limit)
      pooled.insert(pooled.end(), fits[ij].residuals.begin(), fits[ij].residuals.end());
  if (pooled.size() < 6) return std::nullopt;
  return bounded(noise_from(pooled), NoiseSource::kResiduals);
}

}  // namespace bodyschema
