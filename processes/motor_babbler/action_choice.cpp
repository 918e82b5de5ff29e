#include "processes/motor_babbler/action_choice.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <map>
#include <stdexcept>

namespace bodyschema {
namespace {

constexpr double kPotentialPrior = 0.1;  // Λ: a tenth of one sample

/// φ: 1, x_s, and x_s² without its mean.
Eigen::VectorXd potential_terms(const Eigen::VectorXd& x) {
  Eigen::VectorXd phi(1 + 2 * x.size());
  phi << 1, x, x.array().square() - 1.0 / 3;
  return phi;
}

double log_determinant(const Matrix6d& M) {
  return 2 * Eigen::Matrix<double, 6, 6>(M.llt().matrixL()).diagonal().array().log().sum();
}

bool has_parameters(const Edge& edge) {
  return !edge.matrix_gp && edge.parameter_covariance.cols() == edge.num_parameters();
}

/// Growth of log det of six regressions on φ, and the φ they were taken at.
class PotentialInformation {
 public:
  explicit PotentialInformation(Eigen::Index num_terms)
      : information_(kPotentialPrior * Eigen::MatrixXd::Identity(num_terms, num_terms)),
        factors_(information_) {}
  void add(const Eigen::VectorXd& phi) { information_ += phi * phi.transpose(); }
  void factorize() { factors_.compute(information_); }
  double gain(const Eigen::VectorXd& phi) const {
    return 6 * std::log1p(phi.dot(factors_.solve(phi)));
  }

 private:
  Eigen::MatrixXd information_;
  Eigen::LLT<Eigen::MatrixXd> factors_;
};

}  // namespace

std::size_t choose_action(const BodySchema& schema, const std::vector<SeenAction>& past,
                          const std::vector<Eigen::VectorXd>& candidates) {
  if (candidates.empty()) throw std::invalid_argument("there is no action to choose from");
  const VisibilityModel visibility(schema, past);

  Vector6d variances;
  variances << Eigen::Vector3d::Constant(std::pow(schema.noise.position_m, 2)),
      Eigen::Vector3d::Constant(std::pow(schema.noise.rotation_rad, 2));
  const Matrix6d marker_noise = variances.asDiagonal();
  const auto noise_of = [&](const Edge& edge, const Eigen::VectorXd& theta) {
    return relative_covariance(edge.predict(theta), marker_noise, marker_noise);
  };

  std::vector<Edge> edges = schema.edges;
  const auto num_terms = static_cast<Eigen::Index>(1 + 2 * schema.signals.size());
  std::vector<PotentialInformation> of_edge(edges.size(), PotentialInformation(num_terms));
  std::vector<PotentialInformation> of_part(schema.unconnected.size(),
                                            PotentialInformation(num_terms));
  for (const SeenAction& seen : past) {
    if (!seen.is_learned_from) continue;
    const Eigen::VectorXd theta = schema.displacements(seen.action);
    const Eigen::VectorXd phi = potential_terms(normalized(schema.signals, seen.action));
    for (std::size_t e = 0; e < edges.size(); ++e) {
      Edge& edge = edges[e];
      if (!seen.parts.contains(edge.from) || !seen.parts.contains(edge.to)) continue;
      of_edge[e].add(phi);
      // The schema's covariance includes the samples that it rests on.
      if (seen.sample_index <= schema.last_sample_index || !has_parameters(edge)) continue;
      const Eigen::MatrixXd JC = edge.parameter_jacobian(theta) * edge.parameter_covariance;
      const Matrix6d S = noise_of(edge, theta) + edge.prediction_covariance(theta);
      edge.parameter_covariance -= JC.transpose() * S.llt().solve(JC);
    }
    for (std::size_t u = 0; u < of_part.size(); ++u)
      if (seen.parts.contains(schema.unconnected[u].part)) of_part[u].add(phi);
  }
  for (PotentialInformation& information : of_edge) information.factorize();
  for (PotentialInformation& information : of_part) information.factorize();

  std::vector<double> values;
  for (const Eigen::VectorXd& candidate : candidates) {
    const Eigen::VectorXd theta = schema.displacements(candidate);
    const Eigen::VectorXd phi = potential_terms(normalized(schema.signals, candidate));
    const std::map<int, double> probability = visibility.probabilities(candidate);
    double value = 0;
    for (std::size_t e = 0; e < edges.size(); ++e) {
      const Matrix6d noise = noise_of(edges[e], theta);
      const Matrix6d model = edges[e].prediction_covariance(theta);
      const double gain = log_determinant(noise + model) - log_determinant(noise);
      value += probability.at(edges[e].from) * probability.at(edges[e].to) *
               (gain + of_edge[e].gain(phi));
    }
    for (std::size_t u = 0; u < of_part.size(); ++u)
      value += probability.at(schema.unconnected[u].part) * of_part[u].gain(phi);
    values.push_back(value);
  }
  return static_cast<std::size_t>(std::max_element(values.begin(), values.end()) - values.begin());
}

}  // namespace bodyschema
