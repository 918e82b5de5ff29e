#include "processes/refiner/held_out.h"

#include <algorithm>
#include <cmath>

#include "common/camera/corner_likelihood.h"
#include "common/camera/fit_pose.h"
#include "common/estimation/chi_square.h"
#include "common/estimation/quantile.h"
#include "processes/refiner/calibrated_lens.h"

namespace bodyschema {
namespace {

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

/// A root that is never seen is where the schema has it.
void see_root(const BodySchema& schema, std::vector<ActionPoseSample>* samples) {
  if (std::any_of(samples->begin(), samples->end(),
                  [&](const auto& sample) { return sample.find(schema.root); }))
    return;
  PartObservation root;
  root.part = schema.root;
  root.X_CB = schema.X_CR;
  for (ActionPoseSample& sample : *samples)
    sample.parts.insert(std::lower_bound(sample.parts.begin(), sample.parts.end(), root.part,
                                         [](const auto& seen, int id) { return seen.part < id; }),
                        root);
}

/// The samples with all poses solved anew.
std::vector<ActionPoseSample> poses_through(const RigCalibration& rig,
                                            const std::vector<RefinerSample>& samples) {
  const Lens lens = lens_of(rig.camera);
  std::vector<ActionPoseSample> result;
  for (const RefinerSample& seen : samples)
    for (PartObservation& observation : result.emplace_back(seen.sample).parts)
      observation.X_CB = solved_anew(observation, seen.tags, rig, lens);
  return result;
}

/// Root mean square of those below kWild times the median.
double inlier_rms(const std::vector<double>& errors) {
  constexpr double kWild = 4;  // chosen
  const double limit = kWild * median(errors);
  double squares = 0;
  int count = 0;
  for (const double error : errors) {
    if (error > limit) continue;
    squares += error * error;
    ++count;
  }
  return std::sqrt(squares / std::max(count, 1));
}

}  // namespace

void set_residuals(const std::vector<RefinerSample>& samples, const RigCalibration& rig,
                   BodySchema* schema) {
  const std::vector<ActionPoseSample> poses = poses_through(rig, samples);
  for (Edge& edge : schema->edges) {
    std::vector<double> position, rotation;
    for (const ActionPoseSample& sample : poses) {
      const PartObservation *from = sample.find(edge.from), *to = sample.find(edge.to);
      if (!from || !to || !from->has_rotation || !to->has_rotation) continue;
      const Pose X = edge.predict(schema->displacements(sample.action));
      const Vector6d error = log(X.inverse() * from->X_CB.inverse() * to->X_CB);
      position.push_back(error.head<3>().norm());
      rotation.push_back(error.tail<3>().norm());
    }
    const double num = 6 * static_cast<double>(position.size());
    const auto num_fitted = static_cast<double>(edge.num_parameters());
    if (num <= 2 * num_fitted) continue;
    const double lost = std::sqrt(num / (num - num_fitted));
    edge.position_rms_m = lost * inlier_rms(position);
    edge.rotation_rms_rad = lost * inlier_rms(rotation);
  }
}

HeldOutErrors held_out_errors(const BodySchema& schema, const std::vector<RefinerSample>& samples,
                              const std::optional<RigCalibration>& rig,
                              const CornerNoise& corner_noise) {
  HeldOutErrors errors;
  errors.num_samples = static_cast<int>(samples.size());
  std::vector<ActionPoseSample> poses;
  for (const RefinerSample& seen : samples) poses.push_back(seen.sample);
  if (rig) {
    poses = poses_through(*rig, samples);
    const Lens lens = lens_of(rig->camera);
    std::vector<double> distances;
    for (const RefinerSample& seen : samples) {
      const CornerErrors here =
          corner_errors(schema, seen.sample.action, seen.tags, rig->markers, lens, corner_noise);
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
  see_root(schema, &poses);
  errors.parts = evaluate(schema, poses);
  return errors;
}

std::map<int, double> normalized_held_out_errors(const BodySchema& schema,
                                                 const std::vector<RefinerSample>& samples,
                                                 const MeasurementModel& measurement,
                                                 double noise_scale) {
  constexpr std::size_t kFewest = 10;  // chosen
  std::map<int, std::vector<double>> squares;
  for (const RefinerSample& seen : samples) {
    const PartObservation* root = seen.sample.find(schema.root);
    if (!root || !root->has_rotation) continue;
    for (const PartObservation& o : seen.sample.parts) {
      if (o.part == schema.root || !o.has_rotation || !schema.has_rotation(o.part)) continue;
      const auto predicted =
          schema.predict(schema.root, o.part, seen.sample.action, Variance::kOneAction);
      if (!predicted) continue;
      const Pose X_RB = root->X_CB.inverse() * o.X_CB;
      const Matrix6d to_part = adjoint(X_RB.inverse());
      const Matrix6d noise =
          measurement.covariance(o) + to_part * measurement.covariance(*root) * to_part.transpose();
      squares[o.part].push_back(
          squared_mahalanobis(log(predicted->X_AB.inverse() * X_RB),
                              predicted->covariance + std::pow(noise_scale, 2) * noise));
    }
  }
  std::map<int, double> result;
  for (const auto& [part, d2] : squares)
    if (d2.size() >= kFewest) result[part] = std::sqrt(median(d2) / chi_square_median(6));
  return result;
}

bool predicts_corners_better(const HeldOutErrors& model, const HeldOutErrors& other) {
  return is_likelier(model.corner_costs, other.corner_costs);
}

}  // namespace bodyschema
