#include "processes/refiner/informative_samples.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <functional>
#include <numeric>
#include <utility>

#include "processes/refiner/expected_information.h"

namespace bodyschema {
namespace {

/// The largest share that a sample may count so that `most` shares make all of it.
double share_of_each(std::vector<double> told, std::size_t most) {
  std::sort(told.begin(), told.end(), std::greater<>());
  double rest = std::accumulate(told.begin(), told.end(), 0.0);
  for (std::size_t n = 0; n < most; ++n) {
    const double share = rest / static_cast<double>(most - n);
    if (told[n] <= share) return share;
    rest -= told[n];
  }
  return told[most];
}

}  // namespace

std::vector<RefinerSample> informative(std::vector<RefinerSample> samples, const BodySchema& schema,
                                       const std::optional<RigCalibration>& rig,
                                       const RefineOptions& options, bool root_moves) {
  const auto most = static_cast<std::size_t>(options.config.max_samples);
  if (samples.size() <= most) return samples;
  const std::vector<RefinerSample> even = thinned(samples, most);
  RefinementProblem problem(schema, even, rig, options, root_moves);
  const Information information(problem, options.measurement);
  const InformationLayout layout(problem, information);
  const ExpectedSights sights(schema, rig, even, problem);
  const Forecast forecast(layout, sights, problem, rig.has_value(), information.worth());
  Eigen::MatrixXd A = layout.scaled(information.curvature())(layout.core, layout.core);
  A.diagonal() += layout.prior;
  const Eigen::LLT<Eigen::MatrixXd> llt(A);
  if (llt.info() != Eigen::Success) return even;

  std::vector<double> told;
  for (const RefinerSample& seen : samples) {
    const Expectation expected = forecast.of(seen);
    Eigen::MatrixXd J = expected.core;
    if (expected.has_instant) expected.noise.llt().matrixL().solveInPlace(J);
    told.push_back(llt.matrixL().solve(J.transpose()).squaredNorm());
  }
  const double share = share_of_each(told, most);
  if (!(share > 0)) return even;
  std::vector<RefinerSample> result;
  double sum = 0;
  for (std::size_t n = 0; n < samples.size(); ++n) {
    sum += std::min(told[n] / share, 1.0);
    // Rounding may leave the last a little below its turn.
    if (sum + 1e-9 < static_cast<double>(result.size() + 1)) continue;
    result.push_back(std::move(samples[n]));
  }
  return result;
}

}  // namespace bodyschema
