#include "processes/motor_babbler/action_choice.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "common/geometry/angle.h"

namespace bodyschema {
namespace {

constexpr double kViewWidth_rad = 15 * kDegree;
constexpr double kSignalWidth = 0.4;     // rms over the signals, of half ranges
constexpr double kPriorCount = 1;        // past actions that the overall share counts for
constexpr double kPotentialPrior = 0.1;  // Λ: a tenth of one sample

/// Signals, −1..1 over their ranges.
Eigen::VectorXd normalized(const std::vector<Signal>& signals, const Eigen::VectorXd& action) {
  Eigen::VectorXd x(action.size());
  for (Eigen::Index s = 0; s < x.size(); ++s) {
    const Signal& signal = signals[static_cast<std::size_t>(s)];
    x(s) = (2 * action(s) - signal.lower - signal.upper) / (signal.upper - signal.lower);
  }
  return x;
}

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

VisibilityModel::VisibilityModel(const BodySchema& schema, const std::vector<SeenAction>& past)
    : schema_(schema) {
  for (const SeenAction& seen : past) {
    past_.push_back(view_at(seen.action));
    past_.back().parts = seen.parts;
  }
}

VisibilityModel::View VisibilityModel::view_at(const Eigen::VectorXd& action) const {
  View view;
  view.x = normalized(schema_.signals, action);
  for (const auto& [part, X_RB] : schema_.predict_all(action))
    view.directions[part] = (schema_.X_CR * X_RB).inverse().translation().normalized();
  return view;
}

std::map<int, double> VisibilityModel::probabilities(const Eigen::VectorXd& action) const {
  const View here = view_at(action);
  std::set<int> parts(schema_.parts.begin(), schema_.parts.end());
  for (const UnconnectedPart& part : schema_.unconnected) parts.insert(part.part);
  std::map<int, double> result;
  for (const int part : parts) {
    const auto direction = here.directions.find(part);
    double num_seen = 0, seen = 0, all = 0;
    for (const View& before : past_) {
      double distance2 = 0;
      if (direction != here.directions.end()) {
        const double cosine = direction->second.dot(before.directions.at(part));
        distance2 = std::pow(std::acos(std::clamp(cosine, -1.0, 1.0)) / kViewWidth_rad, 2);
      } else if (here.x.size() > 0) {
        distance2 = (here.x - before.x).squaredNorm() /
                    (static_cast<double>(here.x.size()) * kSignalWidth * kSignalWidth);
      }
      const double weight = std::exp(-0.5 * distance2);
      const bool is_seen = before.parts.count(part) > 0;
      all += weight;
      seen += is_seen ? weight : 0;
      num_seen += is_seen;
    }
    // Without similar actions: the share overall, with one seen and one unseen added.
    const double share = (num_seen + 1) / (static_cast<double>(past_.size()) + 2);
    result[part] = (seen + kPriorCount * share) / (all + kPriorCount);
  }
  return result;
}

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
      if (!seen.parts.count(edge.from) || !seen.parts.count(edge.to)) continue;
      of_edge[e].add(phi);
      // The schema's covariance includes the samples that it rests on.
      if (seen.sample_index <= schema.last_sample_index || !has_parameters(edge)) continue;
      const Eigen::MatrixXd JC = edge.parameter_jacobian(theta) * edge.parameter_covariance;
      const Matrix6d S = noise_of(edge, theta) + edge.prediction_covariance(theta);
      edge.parameter_covariance -= JC.transpose() * S.llt().solve(JC);
    }
    for (std::size_t u = 0; u < of_part.size(); ++u)
      if (seen.parts.count(schema.unconnected[u].part)) of_part[u].add(phi);
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
