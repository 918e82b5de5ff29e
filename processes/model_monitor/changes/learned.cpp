#include "processes/model_monitor/changes/learned.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <functional>
#include <limits>
#include <set>

#include "common/estimation/chi_square.h"
#include "common/estimation/quantile.h"
#include "processes/model_monitor/hypotheses/process_fit.h"

namespace bodyschema {
namespace {

using Form = BodyChange::Form;

constexpr double kScreenedLength = 0.8;  // in half ranges of a signal
/// Variance of the function when sets are screened, in squared typical values of it.
constexpr double kScreenedVariance = 5;
/// Least variance of a function, in variances of the noise: too little to be seen in one sample.
constexpr double kLeastVariance = 0.05;
/// Signal sets of each form that are fitted.
constexpr std::size_t kFitted = 2;
/// Single signals of which pairs are made.
constexpr std::size_t kPaired = 3;

double log_normal_constant(const Matrix6d& S) {
  return -S.llt().matrixLLT().diagonal().array().log().sum() - 3 * std::log(2 * M_PI);
}

/// ρ = Log(Δ⁻¹ z) of a measurement, in the place that the residual has in the edge, and its
/// covariance.
void residual_of(const Edge& edge, const PlaceMeasurement& m, Vector6d* rho, Matrix6d* covariance) {
  const Pose to_right = edge.predict(m.displacements) * edge.right.inverse();
  *rho = log(to_right.inverse() * m.z * edge.right.inverse());
  const Matrix6d A = right_jacobian_inverse(*rho) * adjoint(edge.right);
  *covariance = A * m.covariance * A.transpose();
}

ProcessTargets all_coordinates(const BodyChange& change, const Edge& edge,
                               const std::vector<PlaceMeasurement>& measurements) {
  const auto n = static_cast<Eigen::Index>(measurements.size());
  ProcessTargets targets{change, edge, Matrix6d::Identity(), Eigen::MatrixXd(6, n)};
  targets.log_rest = targets.distance_rest = Eigen::VectorXd::Zero(n);
  Eigen::MatrixXd variances(6, n);
  for (Eigen::Index t = 0; t < n; ++t) {
    Vector6d rho;
    Matrix6d covariance;
    residual_of(edge, measurements[static_cast<std::size_t>(t)], &rho, &covariance);
    targets.y.col(t) = rho;
    variances.col(t) = covariance.diagonal();
  }
  targets.noise = variances.rowwise().mean();
  targets.scales =
      (targets.noise.cwiseInverse().asDiagonal() * variances).colwise().mean().transpose();
  return targets;
}

/// Along the screw of the last joint alone.
ProcessTargets one_displacement(const BodyChange& change, const Edge& edge,
                                const std::vector<PlaceMeasurement>& measurements) {
  const auto n = static_cast<Eigen::Index>(measurements.size());
  const ScrewJoint& joint = edge.joints.back();
  const Vector6d along = displacement_twist(joint);
  ProcessTargets targets{change, edge, along, Eigen::MatrixXd(1, n), Eigen::VectorXd(1)};
  targets.scales = targets.log_rest = targets.distance_rest = Eigen::VectorXd(n);
  for (Eigen::Index t = 0; t < n; ++t) {
    Vector6d rho;
    Matrix6d covariance;
    residual_of(edge, measurements[static_cast<std::size_t>(t)], &rho, &covariance);
    const Eigen::LLT<Matrix6d> llt(covariance);
    const double information = along.dot(llt.solve(along));
    const double y = along.dot(llt.solve(rho)) / information;
    const Vector6d rest = rho - y * along;
    targets.y(0, t) = y;
    targets.scales(t) = 1 / information;
    targets.distance_rest(t) = rest.dot(llt.solve(rest));
    targets.log_rest(t) = log_normal_constant(covariance) - 0.5 * targets.distance_rest(t) +
                          0.5 * std::log(2 * M_PI / information);
  }
  targets.noise(0) = targets.scales.mean();
  targets.scales /= targets.noise(0);
  return targets;
}

Eigen::MatrixXd inputs_of(const std::vector<int>& signals,
                          const std::vector<PlaceMeasurement>& measurements) {
  Eigen::MatrixXd x(signals.size(), measurements.size());
  for (std::size_t t = 0; t < measurements.size(); ++t)
    x.col(static_cast<Eigen::Index>(t)) = measurements[t].displacements(signals);
  return x;
}

Eigen::VectorXd half_ranges(const BodySchema& schema, const std::vector<int>& signals) {
  Eigen::VectorXd result(signals.size());
  for (std::size_t d = 0; d < signals.size(); ++d) {
    const Signal& s = schema.signals[static_cast<std::size_t>(signals[d])];
    result(static_cast<Eigen::Index>(d)) = std::max(0.5 * (s.upper - s.lower), 1e-9);
  }
  return result;
}

/// The functions' typical variances: robust, and not below what cannot be seen.
Eigen::VectorXd typical_variances(const ProcessTargets& targets) {
  Eigen::VectorXd result(targets.num_functions());
  for (Eigen::Index c = 0; c < result.size(); ++c) {
    std::vector<double> squares;
    for (Eigen::Index t = 0; t < targets.num_samples(); ++t)
      squares.push_back(targets.y(c, t) * targets.y(c, t));
    result(c) = std::max(upper_median(std::move(squares)) / chi_square_median(1) - targets.noise(c),
                         kLeastVariance * targets.noise(c));
  }
  return result;
}

/// How well a signal set may do, for all functions with one ratio of variance to noise and without
/// a look at outliers, which are the same for all sets.
double screen(const ProcessTargets& targets, const Eigen::VectorXd& variances,
              const Eigen::MatrixXd& x, const Eigen::VectorXd& half_ranges) {
  const Kernel unit(SquaredExponential{1, kScreenedLength * half_ranges});
  double ratio = 0;
  for (Eigen::Index c = 0; c < targets.num_functions(); ++c)
    ratio = std::max(ratio, kScreenedVariance * variances(c) / targets.noise(c));
  Eigen::MatrixXd K = ratio * unit.covariance(x, x);
  K.diagonal() += targets.scales;
  const Eigen::LLT<Eigen::MatrixXd> llt(K);
  double sum = 0;
  for (Eigen::Index c = 0; c < targets.num_functions(); ++c) {
    // Heavy-tailed in the common scale: closed form.
    const double d2 =
        llt.matrixL().solve(targets.y.row(c).transpose()).squaredNorm() / targets.noise(c);
    const auto n = static_cast<double>(targets.num_samples());
    sum -= 0.5 * n * std::log1p(d2 / n);
  }
  return sum - static_cast<double>(targets.num_functions()) *
                   llt.matrixLLT().diagonal().array().log().sum();
}

/// The measurement in the midst of all others.
Pose middle_of(const std::vector<PlaceMeasurement>& measurements) {
  double least = std::numeric_limits<double>::infinity();
  Pose middle = Pose::Identity();
  for (const PlaceMeasurement& a : measurements) {
    double sum = 0;
    for (const PlaceMeasurement& b : measurements) {
      const Pose T = a.z.inverse() * b.z;
      sum += T.translation().norm() + 0.3 * rotation_angle(T);
    }
    if (sum >= least) continue;
    least = sum;
    middle = a.z;
  }
  return middle;
}

// The measurements as each form takes them that the edge may have; signals still open.
std::vector<ProcessTargets> possible_forms(const Edge& old, int part,
                                           const std::vector<PlaceMeasurement>& measurements) {
  Eigen::VectorXd old_cost(measurements.size());
  for (std::size_t t = 0; t < measurements.size(); ++t) {
    const PlaceMeasurement& m = measurements[t];
    const Vector6d r = log(old.predict(m.displacements).inverse() * m.z);
    old_cost(static_cast<Eigen::Index>(t)) = student_cost(r.dot(m.covariance.llt().solve(r)));
  }
  const bool has_screws = !old.residual_gp && !old.matrix_gp && !old.joints.empty();
  std::vector<ProcessTargets> forms;
  for (const Form form : {Form::kNonlinear, Form::kResidual, Form::kFresh}) {
    const BodyChange change{form, part};
    const bool is_fresh = form == Form::kFresh;
    if (std::ssize(measurements) < change.fewest_samples() || !(is_fresh || has_screws)) continue;
    Edge edge = old;
    if (is_fresh) make_constant(middle_of(measurements), &edge);
    forms.push_back(form == Form::kNonlinear ? one_displacement(change, edge, measurements)
                                             : all_coordinates(change, edge, measurements));
    forms.back().old_cost = old_cost;
  }
  return forms;
}

// The form with each of the likeliest signal sets, of one or two, by one factorisation each.
std::vector<BodyChange> likeliest(const BodySchema& base, const ProcessTargets& targets,
                                  const Eigen::VectorXd& typical, const std::vector<int>& own,
                                  const std::vector<PlaceMeasurement>& measurements) {
  const int num_signals = static_cast<int>(base.signals.size());
  std::vector<std::pair<double, BodyChange>> screened;  // by score
  const auto contains = [](const std::vector<int>& values, int value) {
    return std::ranges::find(values, value) != values.end();
  };
  const auto look = [&](int first, int second) {
    BodyChange change = targets.change;
    change.signal = first;
    change.second_signal = second;
    const std::vector<int> signals = signals_of(change);
    // A refined model has its own signals in it as well.
    std::vector<int> all = signals;
    if (change.form != Form::kFresh) all.insert(all.end(), own.begin(), own.end());
    change.share = structural_proximity(all, own);
    const double score =
        screen(targets, typical, inputs_of(signals, measurements), half_ranges(base, signals));
    screened.emplace_back(change.log_odds() + score, change);
  };
  const auto sort = [&screened] {
    std::ranges::stable_sort(screened, std::greater(), [](const auto& s) { return s.first; });
  };
  for (int s = 0; s < num_signals; ++s) look(s, -1);
  sort();
  std::vector<int> paired = own;
  for (std::size_t k = 0; k < screened.size() && k < kPaired; ++k)
    if (const int s = screened[k].second.signal; !contains(paired, s)) paired.push_back(s);
  std::vector<int> done;
  for (const int first : paired) {
    done.push_back(first);
    for (int s = 0; s < num_signals; ++s)
      if (!contains(done, s)) look(std::min(first, s), std::max(first, s));
  }
  sort();
  std::vector<BodyChange> result;
  for (std::size_t k = 0; k < screened.size() && k < kFitted; ++k)
    result.push_back(screened[k].second);
  return result;
}

}  // namespace

std::vector<LearnedEdge> learn_edge(const BodySchema& base, int part,
                                    const std::vector<PlaceMeasurement>& measurements,
                                    double outlier_rate) {
  std::vector<LearnedEdge> result;
  const Edge* const old = edge_to(base, part);
  if (!old || measurements.size() > kMostMeasurements) return result;
  const std::vector<int> own = old->signals();
  for (ProcessTargets& targets : possible_forms(*old, part, measurements)) {
    const Eigen::VectorXd typical = typical_variances(targets);
    for (const BodyChange& change : likeliest(base, targets, typical, own, measurements)) {
      targets.change = change;
      const std::vector<int> signals = signals_of(change);
      auto learned = fit_process(targets, typical, inputs_of(signals, measurements),
                                 half_ranges(base, signals), outlier_rate);
      if (learned) result.push_back(std::move(*learned));
    }
  }
  std::ranges::stable_sort(result, std::greater(), &LearnedEdge::log_evidence);
  return result;
}

double structural_proximity(const std::vector<int>& signals, const std::vector<int>& other) {
  const std::set<int> a(signals.begin(), signals.end()), b(other.begin(), other.end());
  const auto num_shared = std::ranges::count_if(a, [&](int s) { return b.contains(s); });
  const auto num_all = std::ssize(a) + std::ssize(b) - num_shared;
  return (2 + static_cast<double>(num_shared)) / (2 + static_cast<double>(num_all));
}

}  // namespace bodyschema
