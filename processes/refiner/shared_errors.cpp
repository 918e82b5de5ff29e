#include "processes/refiner/shared_errors.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <map>

#include "common/geometry/angle.h"

namespace bodyschema {
namespace {

/// Where a part was, to within which its views are alike: pixels of a tag change with less, what a
/// lens adds changes slowly. Chosen, as the learner's: a part that rests has one view, one that
/// moves many.
constexpr double kSamePosition_m = 5e-3, kSameRotation_rad = 2 * kDegree;
/// Share of a pose's noise that such views have in common, where a systematic error is told: SAMPLE
/// tells one frame's covariance for the mean of two. With it d² of X_CR has the mean 2.2 over 60
/// views of ideal rigs (`./run experiment rig_table … --move-camera`).
constexpr double kViewShare = 0.1;

bool is_alike(const PartObservation& one, const PartObservation& other) {
  return one.part == other.part && one.tags == other.tags &&
         (one.X_CB.translation() - other.X_CB.translation()).norm() < kSamePosition_m &&
         rotation_angle(one.X_CB.inverse() * other.X_CB) < kSameRotation_rad;
}

/// By datum: the first that is a view alike, itself where there is none.
std::vector<int> views_of(const std::vector<RefinementProblem::Datum>& data) {
  std::vector<int> result(data.size());
  std::map<int, std::vector<int>> firsts;  // by part
  for (std::size_t n = 0; n < data.size(); ++n) {
    std::vector<int>& known = firsts[data[n].part];
    const auto alike = std::find_if(known.begin(), known.end(), [&](int first) {
      return is_alike(*data[first].observation, *data[n].observation);
    });
    result[n] = alike == known.end() ? static_cast<int>(n) : *alike;
    if (alike == known.end()) known.push_back(result[n]);
  }
  return result;
}

}  // namespace

std::vector<std::vector<SharedError>> shared_errors(RefinementProblem& problem,
                                                    const MeasurementModel& measurement) {
  const std::vector<RefinementProblem::Datum>& data = problem.data();
  std::vector<std::vector<SharedError>> result(data.size());
  const bool has_systematic =
      measurement.systematic.position_m > 0 || measurement.systematic.rotation_rad > 0;
  if (data.front().observation == nullptr) return result;
  const std::vector<int> views = views_of(data);
  std::vector<int> sizes(data.size(), 0);
  for (const int view : views) ++sizes[view];
  const auto num_data = static_cast<int>(data.size());
  for (std::size_t n = 0; n < data.size(); ++n) {
    const PartObservation& observation = *data[n].observation;
    if (data[n].num_residuals != 6) continue;
    const Matrix6d whitener = Eigen::LLT<Matrix6d>(measurement.covariance(observation))
                                  .matrixL()
                                  .solve(Matrix6d::Identity()) /
                              problem.scale();
    const Eigen::Matrix<double, 6, 7> tag =
        measurement.effect_of_tag(observation.X_CB, observation.tags.size());
    if (!tag.isZero(0))
      for (const int id : observation.tags) result[n].emplace_back(num_data + id, whitener * tag);
    if (!has_systematic || sizes[views[n]] == 1) continue;
    const Matrix6d common = measurement.systematic_covariance() +
                            kViewShare * measurement.noise_covariance(observation);
    result[n].emplace_back(views[n], whitener * common.llt().matrixL().toDenseMatrix());
  }
  return result;
}

}  // namespace bodyschema
