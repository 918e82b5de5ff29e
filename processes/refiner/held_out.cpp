#include "processes/refiner/held_out.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "common/camera/fit_pose.h"
#include "common/estimation/chi_square.h"
#include "common/estimation/quantile.h"
#include "common/estimation/student_t.h"
#include "processes/refiner/calibrated_lens.h"

namespace bodyschema {
namespace {

constexpr double kChance = 0.02;

Eigen::Vector2d corner_px(const TagSight& sight, int corner) {
  return sight.corners_px.segment<2>(2 * corner);
}

const TagSight* find(const std::vector<TagSight>& tags, int id) {
  const auto sight =
      std::find_if(tags.begin(), tags.end(), [id](const TagSight& t) { return t.tag == id; });
  return sight == tags.end() ? nullptr : &*sight;
}

/// X_CB from the corners of the tags that the observation rests on; where that fails as it was.
Pose solved_anew(const PartObservation& observation, const std::vector<TagSight>& tags,
                 const RigCalibration& rig, const Lens& lens) {
  std::vector<Eigen::Vector3d> p_BP;
  std::vector<ImagePoint> measured;
  for (const int id : observation.tags) {
    const TagPlacement* tag = rig.markers.find(id);
    const TagSight* sight = find(tags, id);
    if (!tag || !sight) continue;
    const std::vector<Eigen::Vector3d> corners = tag_corners(tag->size_m);
    for (int c = 0; c < 4; ++c) {
      const auto point = lens.straighten(corner_px(*sight, c));
      if (!point) continue;
      p_BP.push_back(tag->X_BM.value_or(Pose::Identity()) * corners[c]);
      measured.push_back(*point);
    }
  }
  const auto fit = fit_pose(observation.X_CB, p_BP, measured);
  return fit ? fit->X_CB : observation.X_CB;
}

/// Predicted corners of a tag minus those seen [px]: u, v of each; none if one is behind the
/// camera.
std::optional<Eigen::Matrix<double, 8, 1>> corner_errors(const Pose& X_CM, double size_m,
                                                         const TagSight& sight, const Lens& lens) {
  Eigen::Matrix<double, 8, 1> errors;
  const std::vector<Eigen::Vector3d> corners = tag_corners(size_m);
  for (int c = 0; c < 4; ++c) {
    const Eigen::Vector3d p_C = X_CM * corners[c];
    if (!(p_C.z() > 0)) return std::nullopt;
    errors.segment<2>(2 * c) = lens.project(p_C.head<2>() / p_C.z()) - corner_px(sight, c);
  }
  return errors;
}

struct CornerErrors {
  int num_tags = 0;
  std::vector<double> distances_px;  ///< of tags that are predicted before the camera
  double cost = 0;
};

CornerErrors corner_errors(const BodySchema& schema, const RefinerSample& seen,
                           const RigCalibration& rig, const Lens& lens,
                           const CornerNoise& corner_noise) {
  CornerErrors result;
  const std::map<int, Pose> X_RB = schema.predict_all(seen.sample.action);
  for (const TagSight& sight : seen.tags) {
    const TagPlacement* tag = rig.markers.find(sight.tag);
    if (!tag || !X_RB.contains(tag->part)) continue;
    const Pose X_CM = schema.X_CR * X_RB.at(tag->part) * tag->X_BM.value_or(Pose::Identity());
    const auto errors = corner_errors(X_CM, tag->size_m, sight, lens);
    ++result.num_tags;
    if (!errors) {
      result.cost = std::numeric_limits<double>::infinity();
      continue;
    }
    for (int c = 0; c < 4; ++c) result.distances_px.push_back(errors->segment<2>(2 * c).norm());
    const Matrix8d whitener = whitener_of(covariance_of(sight, corner_noise));
    result.cost += robust_cost((whitener * *errors).squaredNorm(), 8);
  }
  return result;
}

}  // namespace

HeldOutErrors held_out_errors(const BodySchema& schema, const std::vector<RefinerSample>& samples,
                              const std::optional<RigCalibration>& rig,
                              const CornerNoise& corner_noise) {
  HeldOutErrors errors;
  errors.num_samples = static_cast<int>(samples.size());
  std::vector<ActionPoseSample> poses;
  for (const RefinerSample& seen : samples) poses.push_back(seen.sample);
  if (rig) {
    const Lens lens = lens_of(rig->camera);
    for (std::size_t n = 0; n < samples.size(); ++n)
      for (PartObservation& observation : poses[n].parts)
        observation.X_CB = solved_anew(observation, samples[n].tags, *rig, lens);
    std::vector<double> distances;
    for (const RefinerSample& seen : samples) {
      const CornerErrors here = corner_errors(schema, seen, *rig, lens, corner_noise);
      if (here.num_tags == 0) continue;
      errors.corner_costs.push_back(here.cost);
      distances.insert(distances.end(), here.distances_px.begin(), here.distances_px.end());
    }
    if (!distances.empty()) {
      double sum = 0;
      for (const double distance : distances) sum += distance * distance;
      errors.px_rms = std::sqrt(sum / (2 * static_cast<double>(distances.size())));
      errors.px_median = median(distances);
    }
  }
  errors.parts = evaluate(schema, poses);
  return errors;
}

bool predicts_corners_better(const HeldOutErrors& model, const HeldOutErrors& other) {
  const std::vector<double>&ours = model.corner_costs, &theirs = other.corner_costs;
  if (ours.size() != theirs.size()) return false;
  int num_better = 0;
  for (std::size_t n = 0; n < ours.size(); ++n) num_better += ours[n] < theirs[n];
  return num_better > binomial_quantile(static_cast<int>(ours.size()), 0.5, 1 - kChance);
}

}  // namespace bodyschema
