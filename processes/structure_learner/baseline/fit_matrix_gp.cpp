#include "processes/structure_learner/baseline/fit_matrix_gp.h"

#include <algorithm>
#include <stdexcept>

#include "common/gp/marginal_likelihood.h"

namespace bodyschema {
namespace {

// Beside an unknown mean a constant process changes nothing; its variance is as good as any.
std::vector<GpPrior> constants(const Eigen::MatrixXd& targets) {
  std::vector<GpPrior> priors;
  for (const auto& column : targets.colwise()) {
    const double variance =
        std::max((column.array() - column.mean()).square().sum() / (column.size() - 1.0),
                 HyperParameterRange{}.least_variance);
    priors.push_back({std::nullopt, SquaredExponential{variance, {}}, variance});
  }
  return priors;
}

}  // namespace

MatrixGp fit_matrix_gp(const std::vector<int>& signals, const Eigen::MatrixXd& inputs,
                       const std::vector<Pose>& poses) {
  const auto N = static_cast<Eigen::Index>(poses.size());
  if (N < 2) throw std::invalid_argument("matrix GP: to learn it takes two samples");
  if (inputs.cols() != N || inputs.rows() != static_cast<Eigen::Index>(signals.size()))
    throw std::invalid_argument("matrix GP: one input per signal and pose");
  Eigen::MatrixXd targets(N, MatrixGp::kNumEntries);
  for (Eigen::Index t = 0; t < N; ++t)
    targets.row(t) = poses[t].matrix().topRows<3>().reshaped().transpose();
  if (!targets.allFinite()) throw std::invalid_argument("matrix GP: a pose is not finite");
  return {signals, inputs, poses,
          signals.empty() ? constants(targets) : maximize_marginal_likelihood(inputs, targets)};
}

Edge fit_matrix_gp_edge(int from, int to, const std::vector<int>& signals,
                        const std::vector<const ActionPoseSample*>& samples) {
  Edge edge;
  edge.from = from;
  edge.to = to;
  Eigen::MatrixXd inputs(signals.size(), samples.size());
  std::vector<Pose> poses;
  for (std::size_t n = 0; n < samples.size(); ++n) {
    inputs.col(static_cast<Eigen::Index>(n)) = samples[n]->action(signals);
    poses.push_back(samples[n]->find(from)->X_CB.inverse() * samples[n]->find(to)->X_CB);
  }
  edge.matrix_gp = std::make_shared<const MatrixGp>(fit_matrix_gp(signals, inputs, poses));
  return edge;
}

}  // namespace bodyschema
