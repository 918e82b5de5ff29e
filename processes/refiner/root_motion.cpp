#include "processes/refiner/root_motion.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>

#include "common/estimation/chi_square.h"
#include "common/estimation/quantile.h"
#include "processes/refiner/refinement_problem.h"

namespace bodyschema {
namespace {

/// Observed poses of the root.
struct SeenRoot {
  std::vector<const PartObservation*> seen;
  std::vector<std::int64_t> indices;  ///< of their samples
};
SeenRoot seen_root(const BodySchema& schema, const std::vector<RefinerSample>& samples) {
  SeenRoot result;
  for (const RefinerSample& sample : samples)
    if (const PartObservation* o = sample.sample.find(schema.root); o && o->has_rotation) {
      result.seen.push_back(o);
      result.indices.push_back(index_of(sample));
    }
  return result;
}

/// The sample from which on it was seen elsewhere, if there is one.
std::optional<std::int64_t> step_of(const SeenRoot& root, const MeasurementModel& measurement) {
  // Chosen: [nats] beside the price of six numbers and of the sample; wild poses are bounded.
  constexpr double kSure = 10, kMostSigma = 4;
  const auto num = std::ssize(root.seen);
  if (num < 4) return std::nullopt;
  Eigen::Matrix<double, 6, Eigen::Dynamic> errors(6, num);  // whitened, from the first pose
  for (Eigen::Index n = 0; n < num; ++n) {
    const PartObservation& o = *root.seen[static_cast<std::size_t>(n)];
    errors.col(n) = measurement.covariance(o).llt().matrixL().solve(
        log(root.seen.front()->X_CB.inverse() * o.X_CB));
  }
  for (Eigen::Index row = 0; row < 6; ++row) {
    const double middle =
        median(std::vector<double>(errors.row(row).begin(), errors.row(row).end()));
    errors.row(row) = (errors.row(row).array() - middle).cwiseMax(-kMostSigma).cwiseMin(kMostSigma);
  }
  double most = 0;
  Eigen::Index at = 1;
  for (Eigen::Index t = 1; t < num; ++t) {
    const Vector6d step =
        errors.rightCols(num - t).rowwise().mean() - errors.leftCols(t).rowwise().mean();
    const double gain =
        0.5 * step.squaredNorm() * static_cast<double>(t * (num - t)) / static_cast<double>(num);
    if (gain > most) {
      most = gain;
      at = t;
    }
  }
  // Of noise that is larger than told, or lasts from sample to sample (AR(1)), it is less.
  errors.leftCols(at).colwise() -= Vector6d(errors.leftCols(at).rowwise().mean());
  errors.rightCols(num - at).colwise() -= Vector6d(errors.rightCols(num - at).rowwise().mean());
  const double squares = std::max(errors.squaredNorm(), 1e-300);
  const double correlation = std::clamp(
      errors.leftCols(num - 1).cwiseProduct(errors.rightCols(num - 1)).sum() / squares, 0.0, 0.99);
  const double worth =
      (1 - correlation) / (1 + correlation) * std::min(1.0, 6 * static_cast<double>(num) / squares);
  if (worth * most < kSure + 4 * std::log(num)) return std::nullopt;
  return root.indices[static_cast<std::size_t>(at)];
}

/// Do its poses differ by more than their noise is told to be?
bool differs(const std::vector<const PartObservation*>& seen, const MeasurementModel& measurement) {
  if (seen.empty()) return false;
  // The one that most of the others agree with.
  double best = std::numeric_limits<double>::infinity();
  const std::size_t num_candidates = std::min<std::size_t>(seen.size(), 8);
  for (std::size_t n = 0; n < num_candidates; ++n) {
    const Pose& X = seen[n * seen.size() / num_candidates]->X_CB;
    std::vector<double> distances;
    for (const PartObservation* o : seen)
      distances.push_back(
          squared_mahalanobis(log(X.inverse() * o->X_CB), measurement.covariance(*o)));
    best = std::min(best, median(distances));
  }
  // Twice: both poses have noise.
  return best > 2 * chi_square_quantile(6, 1e-4);
}

}  // namespace

RootMotion root_motion(const BodySchema& schema, const std::vector<RefinerSample>& samples,
                       const std::optional<RigCalibration>& rig, const RefineOptions& options) {
  const SeenRoot root = seen_root(schema, samples);
  RootMotion result{false, step_of(root, options.measurement)};
  if (!result.step && !differs(root.seen, options.measurement)) return result;
  double log_likelihoods[2];
  double num_residuals = 0;
  for (const bool moves : {false, true}) {
    RefinementProblem problem(schema, samples, rig, options, moves);
    problem.solve();
    log_likelihoods[moves ? 1 : 0] = problem.log_likelihood();
    num_residuals = problem.num_residuals();
  }
  const double num_more = 6 * (static_cast<double>(samples.size()) - 1);
  const double price = result.step ? 1 : std::log(num_residuals) / 2;
  result.moves = log_likelihoods[1] - log_likelihoods[0] > num_more * price;
  return result;
}

}  // namespace bodyschema
