#include "processes/structure_learner/root_pose.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>
#include <map>

#include "common/estimation/chi_square.h"
#include "common/estimation/student_t.h"

namespace bodyschema {
namespace {

struct Reading {
  Pose X;
  Matrix6d information;
  const std::vector<int>* tags;
};

double squared_distance(const Reading& r, const Pose& X) {
  const Vector6d e = log(X.inverse() * r.X);
  return e.dot(r.information * e);
}

// Of at most 16 readings the one in the middle of all.
Pose best_reading(const std::vector<Reading>& readings) {
  const auto cost = [&](const Pose& X) {
    double sum = 0;
    for (const Reading& r : readings) sum += std::log1p(squared_distance(r, X) / kStudentNu);
    return sum;
  };
  Pose mean = readings.front().X;
  double best = std::numeric_limits<double>::infinity();
  const std::size_t candidates = std::min<std::size_t>(readings.size(), 16);
  for (std::size_t n = 0; n < candidates; ++n) {
    const Pose& X = readings[n * readings.size() / candidates].X;
    const double c = cost(X);
    if (c < best) {
      best = c;
      mean = X;
    }
  }
  return mean;
}

// Σ G Gᵀ over the tags, G the weighed effect of a tag's error on all readings by it.
Matrix6d effect_of_tags(const std::vector<Reading>& readings, const Pose& mean,
                        const MeasurementModel& measurement) {
  // What is off of a tag is the same at all its sights: no number of them averages it out.
  std::map<int, Eigen::Matrix<double, 6, 7>> of_tag;
  for (const Reading& r : readings) {
    const double w = robust_weight(squared_distance(r, mean));
    for (const int id : *r.tags) {
      auto& sum = of_tag.try_emplace(id, Eigen::Matrix<double, 6, 7>::Zero()).first->second;
      sum += w * r.information * measurement.effect_of_tag(r.X, r.tags->size());
    }
  }
  Matrix6d of_tags = Matrix6d::Zero();
  for (const auto& [id, sum] : of_tag) of_tags += sum * sum.transpose();
  return of_tags;
}

}  // namespace

double view_share(const MeasurementModel& measurement) {
  // With it d² of X_CR has the mean 2.2 over 60 views of ideal rigs
  // (`./run experiment rig_table … --move-camera`).
  constexpr double kViewShare = 0.1;
  const Noise& systematic = measurement.systematic;
  return systematic.position_m > 0 || systematic.rotation_rad > 0 ? kViewShare : 0;
}

void estimate_root_pose(const std::vector<ActionPoseSample>& samples,
                        const MeasurementModel& measurement, BodySchema* schema) {
  std::vector<Reading> readings;
  for (const auto& sample : samples) {
    const PartObservation* o = sample.find(schema->root);
    if (!o || !o->has_rotation) continue;
    readings.push_back({o->X_CB, measurement.covariance(*o).inverse(), &o->tags});
  }
  if (readings.empty()) return;
  Pose mean = best_reading(readings);
  Matrix6d H;
  double weight = 1;  // mean of the inliers'
  for (int iteration = 0; iteration < 30; ++iteration) {
    H.setZero();
    Vector6d g = Vector6d::Zero();
    double sum = 0;
    int inliers = 0;
    for (const Reading& r : readings) {
      const Vector6d e = log(mean.inverse() * r.X);
      const Vector6d Ie = r.information * e;
      const double d2 = e.dot(Ie), w = robust_weight(d2);
      if (d2 < kOutlierThreshold) {
        sum += w;
        ++inliers;
      }
      H += w * r.information;
      g += w * Ie;
    }
    if (inliers > 0) weight = sum / inliers;
    const Vector6d step = H.llt().solve(g);
    if (!step.allFinite()) break;
    mean = mean * exp(step);
    if (step.norm() < 1e-13) break;
  }
  schema->X_CR = mean;
  const double views = 1 + view_share(measurement) * static_cast<double>(readings.size());
  const Matrix6d inverse = H.inverse();
  const Matrix6d of_tags = effect_of_tags(readings, mean, measurement);
  schema->X_CR_covariance =
      views * weight * inverse + inverse * of_tags * inverse + measurement.systematic_covariance();
}

}  // namespace bodyschema
