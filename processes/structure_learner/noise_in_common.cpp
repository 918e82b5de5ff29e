#include "processes/structure_learner/noise_in_common.h"

#include <algorithm>
#include <cmath>

#include "common/kinematics/screw_chain.h"
#include "common/schema/standard_deviations.h"
#include "processes/structure_learner/noise_estimate.h"
#include "processes/structure_learner/told_noise.h"

namespace bodyschema {
namespace {

// Pairs of residuals below which the estimate is too rough: with as many it is known to a fifth.
constexpr int kFewest = 40;
// Residuals above this multiple of their root mean square are outliers (chosen).
constexpr double kWild = 4;
// A fit leaves this share of the leave-one-out residuals at least.
constexpr double kLeastShare = 1.0 / 3;

// What an edge leaves of a sample, as if its part at either end were off by it.
struct Residual {
  Vector6d at_from, at_to;
};

struct Residuals {
  std::vector<std::optional<Residual>> of_samples;
  double share = 1;  ///< of the leave-one-out residuals
};

Residuals residuals_of(const Edge& edge, const std::vector<ActionPoseSample>& displaced) {
  Residuals result;
  double square = 0;
  int count = 0;
  for (const ActionPoseSample& sample : displaced) {
    std::optional<Residual>& residual = result.of_samples.emplace_back();
    const PartObservation *from = sample.find(edge.from), *to = sample.find(edge.to);
    if (!from || !to || !from->has_rotation || !to->has_rotation) continue;
    const Pose X = edge.predict(sample.action);
    const Vector6d error = log(X.inverse() * from->X_CB.inverse() * to->X_CB);
    const double limit = kWild * kWild;
    if (error.tail<3>().squaredNorm() > limit * edge.rotation_rms_rad * edge.rotation_rms_rad ||
        error.head<3>().squaredNorm() > limit * edge.position_rms_m * edge.position_rms_m)
      continue;
    residual = {-(adjoint(X) * error), error};
    square += error.tail<3>().squaredNorm();
    ++count;
  }
  if (count > 0 && edge.rotation_rms_rad > 0)
    result.share = std::clamp(std::sqrt(square / count) / edge.rotation_rms_rad, kLeastShare, 1.0);
  return result;
}

}  // namespace

std::optional<Noise> noise_in_common(const BodySchema& schema,
                                     const std::vector<ActionPoseSample>& displaced) {
  const std::set<int> fixed = fixed_parts(displaced);
  std::vector<Residuals> residuals;
  for (const Edge& edge : schema.edges) residuals.push_back(residuals_of(edge, displaced));
  // Of the products, x and y being off by the same.
  struct Sums {
    double once = 0, squared = 0;
    void add(double product) {
      once += product;
      squared += product * product;
    }
  } position, rotation;
  int count = 0;
  for (std::size_t a = 0; a < residuals.size(); ++a)
    for (std::size_t b = a + 1; b < residuals.size(); ++b)
      for (const int part : {schema.edges[b].from, schema.edges[b].to}) {
        const bool ends_there = schema.edges[a].to == part;
        if ((!ends_there && schema.edges[a].from != part) || fixed.contains(part)) continue;
        for (std::size_t t = 0; t < displaced.size(); ++t) {
          const auto &of_a = residuals[a].of_samples[t], &of_b = residuals[b].of_samples[t];
          if (!of_a || !of_b) continue;
          const Vector6d x = ends_there ? of_a->at_to : of_a->at_from;
          const Vector6d y = schema.edges[b].to == part ? of_b->at_to : of_b->at_from;
          const double share = residuals[a].share * residuals[b].share;
          position.add(x.head<3>().dot(y.head<3>()) / share);
          rotation.add(x.tail<3>().dot(y.tail<3>()) / share);
          ++count;
        }
      }
  if (count < kFewest) return std::nullopt;
  // The largest that one standard error of the mean allows.
  const auto deviation = [count](const Sums& sums, double least) {
    const double most = (sums.once + std::sqrt(sums.squared)) / (3 * count);
    return std::sqrt(std::max(most, least * least));
  };
  return Noise{deviation(position, kNoiseFloor.position_m),
               deviation(rotation, kNoiseFloor.rotation_rad)};
}

bool add_unexplained(const Noise& noise, const std::set<int>& fixed_parts, BodySchema* schema) {
  // Above so many times what is explained it is no noise of markers that differ (chosen).
  constexpr double kMuch = 2;
  bool any = false;
  for (Edge& edge : schema->edges) {
    if (edge.residual_gp || edge.matrix_gp || edge.parameter_covariance.size() == 0) continue;
    const Eigen::VectorXd middle = schema->displacements(mid_range(schema->signals));
    const Vector6d whole = edge.empirical_covariance().diagonal();
    const Matrix6d scatter = edge.scatter_covariance(middle);
    Vector6d explained = fixed_parts.contains(edge.from)
                             ? isotropic(noise).diagonal().eval()
                             : noise_of_pair(edge.predict(middle), noise);
    explained.head<3>().array() += scatter.topLeftCorner<3, 3>().trace() / 3;
    explained.tail<3>().array() += scatter.bottomRightCorner<3, 3>().trace() / 3;
    const int last = ScrewChainLayout::transform(static_cast<int>(edge.joints.size()));
    for (int axis = 0; axis < 6; ++axis) {
      if (whole(axis) <= kMuch * explained(axis)) continue;
      edge.parameter_covariance(last + axis, last + axis) += whole(axis) - explained(axis);
      any = true;
    }
  }
  return any;
}

bool tell_noise_from_body(Noise of_markers, const std::set<int>& fixed_parts, BodySchema* schema) {
  // The estimate is 1.2 times too large; known to a fifth.
  constexpr double kRefuted = 1.5;
  Noise& noise = schema->noise;
  if (noise.position_m >= kRefuted * of_markers.position_m ||
      noise.rotation_rad >= kRefuted * of_markers.rotation_rad) {
    noise.position_m = std::clamp(of_markers.position_m, kNoiseFloor.position_m, noise.position_m);
    noise.rotation_rad =
        std::clamp(of_markers.rotation_rad, kNoiseFloor.rotation_rad, noise.rotation_rad);
    of_markers = noise;
  }
  return add_unexplained(of_markers, fixed_parts, schema);
}

}  // namespace bodyschema
