#include "common/camera/corner_likelihood.h"

#include <limits>
#include <map>
#include <optional>

#include "common/estimation/chi_square.h"
#include "common/estimation/student_t.h"

namespace bodyschema {
namespace {

constexpr double kChance = 0.02;

/// Predicted corners of a tag minus those seen [px]: u, v of each; none if one is behind the
/// camera.
std::optional<Eigen::Matrix<double, 8, 1>> errors_of(const Pose& X_CM, double size_m,
                                                     const TagSight& sight, const Lens& lens) {
  Eigen::Matrix<double, 8, 1> errors;
  const std::vector<Eigen::Vector3d> corners = tag_corners(size_m);
  for (int c = 0; c < 4; ++c) {
    const Eigen::Vector3d p_C = X_CM * corners[c];
    if (!(p_C.z() > 0)) return std::nullopt;
    errors.segment<2>(2 * c) =
        lens.project(p_C.head<2>() / p_C.z()) - sight.corners_px.segment<2>(2 * c);
  }
  return errors;
}

}  // namespace

CornerErrors corner_errors(const BodySchema& schema, const Eigen::VectorXd& action,
                           const std::vector<TagSight>& tags, const Markers& markers,
                           const Lens& lens, const CornerNoise& corner_noise) {
  CornerErrors result;
  const std::map<int, Pose> X_RB = schema.predict_all(action);
  for (const TagSight& sight : tags) {
    const TagPlacement* tag = markers.find(sight.tag);
    if (!tag || !X_RB.contains(tag->part)) continue;
    const Pose X_CM = schema.X_CR * X_RB.at(tag->part) * tag->X_BM.value_or(Pose::Identity());
    const auto errors = errors_of(X_CM, tag->size_m, sight, lens);
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

bool is_likelier(const std::vector<double>& costs, const std::vector<double>& costs_of_other) {
  if (costs.size() != costs_of_other.size()) return false;
  int num_better = 0;
  for (std::size_t n = 0; n < costs.size(); ++n) num_better += costs[n] < costs_of_other[n];
  return num_better > binomial_quantile(static_cast<int>(costs.size()), 0.5, 1 - kChance);
}

}  // namespace bodyschema
