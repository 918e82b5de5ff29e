#include "processes/model_monitor/hypotheses/change_fit.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>

#include "common/estimation/levenberg_marquardt.h"
#include "common/estimation/student_t.h"
#include "processes/model_monitor/changes/learned.h"

namespace bodyschema {
namespace {

constexpr int kIterations = 16;
constexpr double kLargestStep = 2.1;  // of θ, in prior standard deviations
/// Starts that are followed up.
constexpr std::size_t kClimbs = 4;
/// Evidence behind the best change of a place, by the place's measurements, that all observations
/// do not make up for [nats].
constexpr double kHopeless = 25;
/// Learned models that are held against all the observations.
constexpr std::size_t kLearnedJudged = 3;

}  // namespace

BodySchema with_edge_of(const BodySchema& schema, const BodySchema& other, int part) {
  BodySchema result = schema;
  if (part == schema.root) {
    result.X_CR = other.X_CR;
    result.X_CR_covariance = other.X_CR_covariance;
  } else if (const Edge* edge = edge_to(other, part)) {
    for (Edge& e : result.edges)
      if (e.to == part && e.from == edge->from) e = *edge;
  }
  return result;
}

bool is_possible(const FittedChange& fitted, const BodySchema& schema) {
  return form_of(fitted.change)
      .family.is_possible(fitted.origin ? *fitted.origin : schema, fitted.change);
}

BodySchema with_change(const BodySchema& schema, const FittedChange& fitted) {
  BodySchema result = schema;
  if (fitted.origin) {
    if (fitted.everywhere) {
      result = with_edge_of(result, *fitted.origin, result.root);
      for (const Edge& edge : fitted.origin->edges)
        result = with_edge_of(result, *fitted.origin, edge.to);
    } else {
      result = with_edge_of(result, *fitted.origin, fitted.change.part);
    }
  }
  return changed(result, fitted.change, fitted.theta, fitted.covariance);
}

BodySchema with_certain_change(const BodySchema& schema, const FittedChange& fitted) {
  FittedChange certain = fitted;
  certain.covariance.resize(0, 0);
  BodySchema result = with_change(schema, certain);
  if (fitted.certain) edge_at(&result, fitted.change.part) = *fitted.certain;
  return result;
}

double log_likelihood(const BodySchema& schema, const MeasurementModel& measurement,
                      const std::vector<const ActionPoseSample*>& samples) {
  const TreeFilter filter(schema, measurement);
  double sum = 0;
  for (const ActionPoseSample* sample : samples) sum += filter.log_likelihood(*sample);
  return sum;
}

PlaceEvidence::PlaceEvidence(const BodySchema& base, const MeasurementModel& measurement,
                             const ElementId& element, std::vector<const ActionPoseSample*> samples)
    : base_(base), measurement_(measurement), element_(element), samples_(std::move(samples)) {
  const TreeFilter filter(base_, measurement_);
  const int node = filter.node_of(element_.id);
  if (node < 0) return;
  for (const ActionPoseSample* sample : samples_) {
    const TreeFilter::Instant instant = filter.prepare(*sample);
    const auto of = element_.is_tag() ? filter.measure_marker(instant, node)
                                      : filter.measure_edge(instant, node);
    if (!of) continue;
    const Eigen::LLT<Matrix6d> llt(of->covariance);
    if (llt.info() != Eigen::Success) continue;
    // Correlated samples tell as much as fewer of them.
    measurements_.push_back(
        {base_.displacements(sample->action), of->z, of->covariance / measurement_.worth});
    whitenings_.push_back(std::sqrt(measurement_.worth) *
                          llt.matrixL().solve(Matrix6d::Identity()));
    log_norms_.push_back(-llt.matrixLLT().diagonal().array().log().sum() - 3 * std::log(2 * M_PI));
  }
  if (element_.is_tag()) return;
  const Edge* edge = edge_to(base_, element_.id);
  for (PlaceMeasurement& m : measurements_) {
    m.X = edge ? edge->predict(m.displacements) : base_.X_CR;
    m.links = link_poses(edge, m.displacements, m.X);
  }
}

Eigen::VectorXd PlaceEvidence::residuals(const BodyChange& change, const Eigen::VectorXd& theta,
                                         Eigen::MatrixXd* jacobian) const {
  const PlacePrediction predict = form_of(change).family.prediction(base_, change, theta);
  ChangeJacobian moves(6, change.size());
  Eigen::VectorXd r(6 * static_cast<Eigen::Index>(measurements_.size()));
  if (jacobian) jacobian->resize(r.size(), change.size());
  for (std::size_t n = 0; n < measurements_.size(); ++n) {
    const Eigen::Index at = 6 * static_cast<Eigen::Index>(n);
    const PlaceMeasurement& m = measurements_[n];
    const Vector6d xi = log(predict(m, jacobian ? &moves : nullptr).inverse() * m.z);
    r.segment<6>(at) = whitenings_[n] * xi;
    // log(Exp(−δ) Exp(ξ)) = ξ − J_l⁻¹(ξ) δ, and J_l(ξ) = J_r(−ξ).
    if (jacobian)
      jacobian->middleRows<6>(at) = -whitenings_[n] * right_jacobian_inverse(-xi) * moves;
  }
  return r;
}

double PlaceEvidence::log_flat_outlier() const {
  return std::log(measurement_.outlier_rate) + log_flat_density();
}

double PlaceEvidence::log_inlier(std::size_t n, double d2) const {
  return std::log1p(-measurement_.outlier_rate) - 0.5 * d2 + log_norms_[n];
}

double PlaceEvidence::cost(const BodyChange& change, const Eigen::VectorXd& theta,
                           bool robust) const {
  const double flat = log_flat_outlier();
  double sum = 0.5 * prior_of(change, base_).squared_distance(theta);
  const Eigen::VectorXd r = residuals(change, theta);
  for (std::size_t n = 0; n < measurements_.size(); ++n) {
    const double d2 = r.segment<6>(6 * static_cast<Eigen::Index>(n)).squaredNorm();
    if (robust) {
      sum += robust_cost(d2);
    } else {
      const double inlier = log_inlier(n, d2);
      sum -= std::max(inlier, flat) + std::log1p(std::exp(-std::abs(inlier - flat)));
    }
  }
  return sum;
}

PlaceEvidence::State PlaceEvidence::climb(const BodyChange& change, Eigen::VectorXd theta) const {
  const ChangePrior prior = prior_of(change, base_);
  const Eigen::VectorXd information = prior.sigma.cwiseAbs2().cwiseInverse();
  const double flat = log_flat_outlier();
  const std::size_t count = measurements_.size();
  State state;
  const LevenbergMarquardt fresh(1e-3, 1e-9, 5);
  LevenbergMarquardt optimizer = fresh;
  for (int iteration = 0; iteration < kIterations; ++iteration) {
    const bool robust = iteration < kIterations / 2;
    if (iteration == kIterations / 2) optimizer = fresh;
    Eigen::MatrixXd J;
    const Eigen::VectorXd r = residuals(change, theta, &J);
    Eigen::MatrixXd H = information.asDiagonal();
    Eigen::VectorXd g = information.cwiseProduct(theta - prior.mean);
    for (std::size_t n = 0; n < count; ++n) {
      const auto at = 6 * static_cast<Eigen::Index>(n);
      const double d2 = r.segment<6>(at).squaredNorm();
      const double w = robust ? robust_weight(d2)
                              : 1 / (1 + std::exp(std::min(flat - log_inlier(n, d2), 500.0)));
      H += w * J.middleRows<6>(at).transpose() * J.middleRows<6>(at);
      g += w * J.middleRows<6>(at).transpose() * r.segment<6>(at);
    }
    state.H = H;
    const double before = cost(change, theta, robust);
    state.theta = theta;
    state.cost = before;
    double gain = 0;
    const bool improved = optimizer.step(H, g, [&](Eigen::VectorXd step) {
      const double longest = step.cwiseQuotient(prior.sigma.cwiseMax(1e-9)).cwiseAbs().maxCoeff();
      if (longest > kLargestStep) step *= kLargestStep / longest;
      const double after = cost(change, theta + step, robust);
      if (!(after < before)) return false;
      theta += step;
      gain = before - after;
      return true;
    });
    if (!improved || gain < 1e-4) {
      if (!robust) break;
      iteration = std::max(iteration, kIterations / 2 - 1);
    }
  }
  state.cost = cost(change, theta, false);
  state.theta = theta;
  return state;
}

std::optional<FittedChange> PlaceEvidence::fit_place(const BodyChange& change) const {
  if (num_usable() < change.fewest_samples()) return std::nullopt;
  const Eigen::Index d = change.size();
  FittedChange best;
  best.change = change;
  best.theta = Eigen::VectorXd::Zero(d);
  best.log_prior = change.log_odds();
  if (d == 0) {
    best.log_evidence = change.log_odds() - cost(change, best.theta, false);
    return best;
  }
  // The most promising starts.
  std::vector<std::pair<double, Eigen::VectorXd>> promising;
  for (Eigen::VectorXd& start : form_of(change).family.starts(base_, change, measurements_))
    promising.emplace_back(cost(change, start, true), std::move(start));
  std::ranges::stable_sort(promising, {}, [](const auto& start) { return start.first; });
  if (promising.size() > kClimbs) promising.resize(kClimbs);
  std::optional<State> found;
  for (const auto& [unused, start] : promising) {
    const State state = climb(change, start);
    if (!state.theta.allFinite() || !std::isfinite(state.cost)) continue;
    if (!found || state.cost < found->cost) found = state;
  }
  if (!found) return std::nullopt;
  const Eigen::LLT<Eigen::MatrixXd> llt(found->H);
  if (llt.info() != Eigen::Success) return std::nullopt;
  best.theta = found->theta;
  best.covariance = llt.solve(Eigen::MatrixXd::Identity(d, d));
  const ChangePrior prior = prior_of(change, base_);
  // log prior + d/2 log 2π − ½ log|H|
  best.log_prior += prior.log_density(best.theta);
  best.log_prior -= llt.matrixLLT().diagonal().array().log().sum();
  best.log_evidence = best.log_prior + 0.5 * prior.squared_distance(best.theta) - found->cost;
  return best;
}

void PlaceEvidence::judge(FittedChange* fitted) const {
  // The likelihood at the most probable θ; the width of its peak is in the Laplace term, so the
  // model's new uncertainty must not be in it as well.
  fitted->log_evidence =
      fitted->log_prior +
      log_likelihood(changed(base_, fitted->change, fitted->theta), measurement_, samples_);
  fitted->schema = changed(base_, fitted->change, fitted->theta, fitted->covariance);
}

std::optional<FittedChange> PlaceEvidence::fit(const BodyChange& change) const {
  auto fitted = fit_place(change);
  if (fitted) judge(&*fitted);
  return fitted;
}

std::vector<FittedChange> PlaceEvidence::fit_likely(const std::vector<BodyChange>& changes) const {
  std::vector<FittedChange> fitted;
  double best = -std::numeric_limits<double>::infinity();
  for (const BodyChange& change : changes) {
    auto one = fit_place(change);
    if (!one) continue;
    best = std::max(best, one->log_evidence);
    fitted.push_back(std::move(*one));
  }
  std::erase_if(fitted,
                [best](const FittedChange& f) { return f.log_evidence < best - kHopeless; });
  for (FittedChange& f : fitted) judge(&f);
  return fitted;
}

std::vector<FittedChange> PlaceEvidence::learn() const {
  std::vector<FittedChange> result;
  if (element_.is_tag() || measurements_.empty()) return result;
  const auto with_edge = [this](const Edge& edge) {
    BodySchema schema = base_;
    edge_at(&schema, element_.id) = edge;
    return schema;
  };
  const std::vector<LearnedEdge> learned =
      learn_edge(base_, element_.id, measurements_, measurement_.outlier_rate);
  for (const LearnedEdge& one : learned) {
    if (one.log_evidence < learned.front().log_evidence - kHopeless ||
        result.size() == kLearnedJudged)
      break;
    FittedChange fitted;
    fitted.change = one.change;
    fitted.log_prior = one.log_prior;
    fitted.log_evidence =
        one.log_prior + log_likelihood(with_edge(one.certain), measurement_, samples_);
    fitted.schema = with_edge(one.edge);
    fitted.origin = fitted.schema;
    fitted.certain = one.certain;
    result.push_back(std::move(fitted));
  }
  return result;
}

FittedChange PlaceEvidence::judge_stored(const BodySchema& schema) const {
  FittedChange result;
  result.change = {BodyChange::Form::kStored, element_.id};
  result.schema = schema;
  result.log_prior = result.change.log_odds();
  result.log_evidence = result.log_prior + log_likelihood(schema, measurement_, samples_);
  return result;
}

}  // namespace bodyschema
