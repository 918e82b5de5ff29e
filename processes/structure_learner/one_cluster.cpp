#include "processes/structure_learner/one_cluster.h"

#include <algorithm>
#include <cmath>
#include <map>

#include "common/estimation/chi_square.h"
#include "common/estimation/quantile.h"
#include "common/geometry/angle.h"

namespace bodyschema {
namespace {

// Chosen. Noise alone has a spread of one; a signal at random over ± 1 rad moves a part by 0.58 rad
// rms, 5.4 times the chapter's noise of 6.1°.
constexpr double kLeastSpread = 3;
// Chosen: of arms whose joints have 120°, a twentieth.
constexpr double kLeastSweep_rad = 5 * kDegree, kLeastSweep_m = 0.01;

// Standard deviations per axis, whatever outliers do.
Noise spread_of(const std::vector<Pose>& poses) {
  Noise least{INFINITY, INFINITY};
  static const double kMedian = chi_square_median(3);
  // The middle is one of the poses: that around which the others are nearest.
  constexpr std::size_t kCentres = 12;
  const std::size_t num_centres = std::min(kCentres, poses.size());
  for (std::size_t c = 0; c < num_centres; ++c) {
    const Pose inverse = poses[c * poses.size() / num_centres].inverse();
    std::vector<double> position, rotation;
    for (const Pose& X : poses) {
      const Vector6d d = log(inverse * X);
      position.push_back(d.head<3>().squaredNorm() / kMedian);
      rotation.push_back(d.tail<3>().squaredNorm() / kMedian);
    }
    least.position_m = std::min(least.position_m, std::sqrt(upper_median(std::move(position))));
    least.rotation_rad = std::min(least.rotation_rad, std::sqrt(upper_median(std::move(rotation))));
  }
  return least;
}

bool stays_in_noise(const std::vector<ActionPoseSample>& samples, const Noise& noise) {
  std::map<int, std::vector<Pose>> poses;
  for (const ActionPoseSample& sample : samples)
    for (const PartObservation& o : sample.parts) poses[o.part].push_back(o.X_CB);
  return std::all_of(poses.begin(), poses.end(), [&](const auto& of_part) {
    const Noise spread = spread_of(of_part.second);
    return spread.position_m <= kLeastSpread * noise.position_m &&
           spread.rotation_rad <= kLeastSpread * noise.rotation_rad;
  });
}

}  // namespace

bool is_one_cluster(const BodySchema& schema, const std::vector<ActionPoseSample>& samples) {
  if (samples.empty()) return false;
  Eigen::VectorXd lower = samples.front().action, upper = lower;
  for (const ActionPoseSample& sample : samples) {
    lower = lower.cwiseMin(sample.action);
    upper = upper.cwiseMax(sample.action);
  }
  const Eigen::VectorXd range = upper - lower;
  if (range.size() == 0 || !(range.maxCoeff() > 0)) return false;
  if (stays_in_noise(samples, schema.noise)) return true;
  bool any_joint = false;
  for (const Edge& edge : schema.edges) {
    if (edge.residual_gp || edge.matrix_gp) return false;
    for (const ScrewJoint& joint : edge.joints) {
      const double swept = std::abs(joint.gain) * range(joint.signal);
      if (std::abs(joint.turn) * swept > kLeastSweep_rad ||
          std::abs(joint.slide) * swept > kLeastSweep_m)
        return false;
      any_joint = true;
    }
  }
  return any_joint;
}

}  // namespace bodyschema
