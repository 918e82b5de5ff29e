#include "processes/structure_learner/model_free_noise.h"

#include <cmath>
#include <map>
#include <set>

#include "processes/structure_learner/told_noise.h"

namespace bodyschema {
namespace {

constexpr int kMinRepeats = 5;

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

}  // namespace

Noise noise_from(const std::vector<NoiseResidual>& residuals, const NoiseQuantile& quantile) {
  Noise noise;
  std::vector<double> values;
  for (const auto& r : residuals) values.push_back(r.residual.tail<3>().squaredNorm() / r.markers);
  noise.rotation_rad = std::sqrt(quantile.of(values) / quantile.chi3);
  const double rotation_variance = noise.rotation_rad * noise.rotation_rad;
  // The position variance that brings the quantile of the whitened position residuals to that of
  // χ²₃: the covariance is v·m along the lever and v·m + |lever|²σ_r² across it.
  const auto quantile_at = [&](double v) {
    values.clear();
    for (const auto& r : residuals) {
      const double l2 = r.lever.squaredNorm();
      const double along2 = l2 > 0 ? std::pow(r.residual.head<3>().dot(r.lever), 2) / l2 : 0.0;
      const double across2 = r.residual.head<3>().squaredNorm() - along2;
      values.push_back(along2 / (v * r.markers) +
                       across2 / (v * r.markers + l2 * rotation_variance));
    }
    return quantile.of(values);
  };
  double low = 1e-20, high = 1e2;  // [m²]
  for (int n = 0; n < 60; ++n) {
    const double middle = std::sqrt(low * high);
    (quantile_at(middle) > quantile.chi3 ? low : high) = middle;
  }
  noise.position_m = std::sqrt(high);
  return noise;
}

std::vector<std::vector<int>> repeats(const NormalizedActions& actions) {
  if (actions.moving().empty() || actions.blocks().is_stream()) return {};
  std::map<std::vector<long>, std::vector<int>> groups;
  for (int t = 0; t < actions.num_samples(); ++t) {
    std::vector<long> key;
    for (const int s : actions.moving()) key.push_back(std::lround(actions(t, s) * 1e6));
    groups[key].push_back(t);
  }
  std::vector<std::vector<int>> result;
  for (auto& [key, members] : groups) result.push_back(std::move(members));
  return result;
}

std::optional<Noise> noise_from_repeats(const std::vector<ActionPoseSample>& samples,
                                        const NormalizedActions& actions) {
  const std::set<int> fixed = fixed_parts(samples);
  std::vector<NoiseResidual> residuals;
  for (const std::vector<int>& members : repeats(actions)) {
    std::map<int, std::vector<Pose>> poses;
    for (const int t : members)
      for (const PartObservation& o : samples[t].parts)
        if (!fixed.contains(o.part)) poses[o.part].push_back(o.X_CB);
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

std::optional<Noise> noise_from_neighbours(const std::vector<ActionPoseSample>& samples,
                                           const NormalizedActions& actions) {
  if (!actions.blocks().is_stream()) return std::nullopt;
  const std::set<int> fixed = fixed_parts(samples);
  std::vector<NoiseResidual> residuals;
  for (std::size_t t = 1; t + 1 < samples.size(); ++t)
    for (const PartObservation& o : samples[t].parts) {
      const PartObservation* before = samples[t - 1].find(o.part);
      const PartObservation* after = samples[t + 1].find(o.part);
      if (!before || !after || fixed.contains(o.part)) continue;
      const Pose inverse = o.X_CB.inverse();
      residuals.push_back({log(inverse * before->X_CB) + log(inverse * after->X_CB),
                           Eigen::Vector3d::Zero(), 6.0});  // variance of (1, −2, 1)
    }
  if (residuals.size() < 10) return std::nullopt;
  return noise_from(residuals);
}

}  // namespace bodyschema
