#include "processes/console/engineered_place.h"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <stdexcept>
#include <vector>

#include "common/estimation/quantile.h"
#include "common/geometry/angle.h"
#include "processes/structure_learner/pair_data.h"
#include "processes/structure_learner/root_pose.h"

namespace bodyschema {
namespace {

/// A point of a part: by the model, and as it was seen.
struct Point {
  Eigen::Vector3d p_RP, p_CP;
};

/// Of a pose also points on two of its axes.
std::vector<Point> points_of(const BodySchema& schema,
                             const std::vector<ActionPoseSample>& samples) {
  constexpr double kArm_m = 0.2;  // a radian counts as much as 0.2 m
  std::vector<Point> points;
  for (const ActionPoseSample& sample : samples) {
    const std::map<int, Pose> X_RB = schema.predict_all(sample.action);
    for (const PartObservation& seen : sample.parts) {
      const auto predicted = X_RB.find(seen.part);
      if (predicted == X_RB.end()) continue;
      std::vector<Eigen::Vector3d> p_BP = {Eigen::Vector3d::Zero()};
      if (seen.has_rotation)
        p_BP.insert(p_BP.end(),
                    {kArm_m * Eigen::Vector3d::UnitX(), kArm_m * Eigen::Vector3d::UnitY()});
      for (const Eigen::Vector3d& p : p_BP)
        points.push_back({predicted->second * p, seen.X_CB * p});
    }
  }
  return points;
}

/// Rotation and translation of least weighted squares (Kabsch 1976). @throws std::invalid_argument
/// where the points lie on a line.
Pose weighted_fit(const std::vector<Point>& points, const std::vector<double>& weights) {
  double sum = 0;
  Eigen::Vector3d mean_R = Eigen::Vector3d::Zero(), mean_C = Eigen::Vector3d::Zero();
  for (std::size_t n = 0; n < points.size(); ++n) {
    sum += weights[n];
    mean_R += weights[n] * points[n].p_RP;
    mean_C += weights[n] * points[n].p_CP;
  }
  mean_R /= sum;
  mean_C /= sum;
  Eigen::Matrix3d M = Eigen::Matrix3d::Zero();
  for (std::size_t n = 0; n < points.size(); ++n)
    M += weights[n] * (points[n].p_CP - mean_C) * (points[n].p_RP - mean_R).transpose();
  Pose X_CR = Pose::Identity();
  X_CR.linear() = nearest_rotation(M);
  X_CR.translation() = mean_C - X_CR.linear() * mean_R;
  return X_CR;
}

/// By weights of a Cauchy distribution of the distances' own median.
Pose robust_fit(const std::vector<Point>& points) {
  constexpr int kIterations = 30;
  std::vector<double> weights(points.size(), 1);
  Pose X_CR = weighted_fit(points, weights);
  for (int iteration = 0; iteration < kIterations; ++iteration) {
    std::vector<double> distances;
    for (const Point& point : points) distances.push_back((point.p_CP - X_CR * point.p_RP).norm());
    const double scale = std::max(median(distances), 1e-9);
    for (std::size_t n = 0; n < points.size(); ++n)
      weights[n] = 1 / (1 + std::pow(distances[n] / scale, 2));
    X_CR = weighted_fit(points, weights);
  }
  return X_CR;
}

}  // namespace

void place_in_camera(const Recording& recording, BodySchema* schema) {
  MeasurementModel measurement = recording.measurement;
  if (!recording.has_noise) measurement.noise = Noise{0.001, 0.2 * kDegree};  // weights alone
  schema->calibration_id = recording.samples.front().calibration_id;
  const std::vector<int> alone = parts_without_rotation(recording.samples);
  for (const int part : schema->parts)
    if (part != schema->root && std::ranges::binary_search(alone, part) &&
        std::ranges::none_of(schema->edges, [&](const Edge& edge) { return edge.from == part; }))
      schema->position_parts.push_back(part);
  estimate_root_pose(recording.samples, measurement, schema);
  if (!schema->X_CR_covariance.isZero(0)) return;
  const std::vector<Point> points = points_of(*schema, recording.samples);
  if (points.empty()) throw std::runtime_error("no part of the model is ever seen");
  try {
    schema->X_CR = robust_fit(points);
  } catch (const std::invalid_argument&) {
    throw std::runtime_error(
        "what is seen lies on a line, which does not tell how the camera stands");
  }
}

}  // namespace bodyschema
