#include "processes/model_monitor/learned_edge.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <optional>

#include "common/estimation/quantile.h"
#include "common/estimation/student_t.h"
#include "processes/model_monitor/tree_filter.h"

namespace bodyschema {
namespace {

using Form = BodyChange::Form;

/// In half ranges of a signal.
constexpr double kLengths[] = {0.3, 0.6, 1.2, 2.4};
constexpr double kScreenedLength = 0.8;
/// Variance of the function, in squared typical values of it (at least of the noise).
constexpr double kVariances[] = {1, 5, 25};
/// Where the samples show nothing, in variances of the noise: what is too little to be seen in one.
constexpr double kLeastVariance = 0.05;
/// Of each form; the rest is not fitted.
constexpr std::size_t kFitted = 2;
/// Single signals of which pairs are made.
constexpr std::size_t kPaired = 3;
constexpr int kRounds = 5;
constexpr double kMostOutliers = 0.25;
/// Cells that the samples do not tell apart [nats].
constexpr double kAsLikely = 2;
/// Of the old model's cost on measurements that were left out.
constexpr double kForeseen = 0.5;
/// Makes a process certain without a change of its mean.
constexpr double kCertain = 1e-9;

std::vector<int> signals_of(const BodyChange& change) {
  std::vector<int> signals{change.signal};
  if (change.second_signal >= 0) signals.push_back(change.second_signal);
  return signals;
}

/// What one form makes of the measurements: k functions of the signals, seen n times.
struct Targets {
  BodyChange change;
  Edge edge;                                      ///< without the functions
  Eigen::Matrix<double, 6, Eigen::Dynamic> into;  ///< 6×k: ρ of the functions' values
  Eigen::MatrixXd y;                              ///< k×n
  Eigen::VectorXd noise;                          ///< k, variances
  Eigen::VectorXd scales;                         ///< n: of the noise of each measurement
  /// n: log density of what the functions say nothing of, and its squared distance.
  Eigen::VectorXd log_rest, distance_rest;
  /// n: student_cost() of what stood.
  Eigen::VectorXd old_cost;

  Eigen::Index num_functions() const { return y.rows(); }
  Eigen::Index num_samples() const { return y.cols(); }
};

/// Heavy-tailed: of a squared distance, above that of a typical right prediction [nats].
double student_cost(double squared_distance) {
  return 0.5 * (kStudentNu + 6) * std::log((kStudentNu + squared_distance) / (kStudentNu + 6));
}

double log_normal_constant(const Matrix6d& S) {
  return -S.llt().matrixLLT().diagonal().array().log().sum() - 3 * std::log(2 * M_PI);
}

/// ρ = Log(Δ⁻¹ z) of a measurement, in the place that the residual has in the edge, and its
/// covariance.
void residual_of(const Edge& edge, const EdgeMeasurement& m, Vector6d* rho, Matrix6d* covariance) {
  const Pose to_right = edge.predict(m.displacements) * edge.right.inverse();
  *rho = log(to_right.inverse() * m.z * edge.right.inverse());
  const Matrix6d A = right_jacobian_inverse(*rho) * adjoint(edge.right);
  *covariance = A * m.covariance * A.transpose();
}

Targets all_coordinates(const BodyChange& change, const Edge& edge,
                        const std::vector<EdgeMeasurement>& measurements) {
  const auto n = static_cast<Eigen::Index>(measurements.size());
  Targets targets;
  targets.change = change;
  targets.edge = edge;
  targets.into = Matrix6d::Identity();
  targets.y.resize(6, n);
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
Targets one_displacement(const BodyChange& change, const Edge& edge,
                         const std::vector<EdgeMeasurement>& measurements) {
  const auto n = static_cast<Eigen::Index>(measurements.size());
  const ScrewJoint& joint = edge.joints.back();
  Vector6d screw = Vector6d::Zero();
  screw(2) = joint.slide;
  screw(5) = joint.turn;
  const Vector6d along = adjoint(joint.X_after.inverse()) * screw;
  Targets targets;
  targets.change = change;
  targets.edge = edge;
  targets.into = along;
  targets.y.resize(1, n);
  targets.noise.resize(1);
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
                          const std::vector<EdgeMeasurement>& measurements) {
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
Eigen::VectorXd typical_variances(const Targets& targets) {
  Eigen::VectorXd result(targets.num_functions());
  for (Eigen::Index c = 0; c < result.size(); ++c) {
    std::vector<double> squares;
    for (Eigen::Index t = 0; t < targets.num_samples(); ++t)
      squares.push_back(targets.y(c, t) * targets.y(c, t));
    result(c) = std::max(upper_median(std::move(squares)) / 0.455 - targets.noise(c),
                         kLeastVariance * targets.noise(c));
  }
  return result;
}

/// How well a signal set may do, for all functions with one ratio of variance to noise and without
/// a look at outliers, which are the same for all sets.
double screen(const Targets& targets, const Eigen::VectorXd& variances, const Eigen::MatrixXd& x,
              const Eigen::VectorXd& half_ranges) {
  const Kernel unit(SquaredExponential{1, kScreenedLength * half_ranges});
  double ratio = 0;
  for (Eigen::Index c = 0; c < targets.num_functions(); ++c)
    ratio = std::max(ratio, kVariances[1] * variances(c) / targets.noise(c));
  Eigen::MatrixXd K = ratio * unit.covariance(x, x);
  K.diagonal() += targets.scales;
  const Eigen::LLT<Eigen::MatrixXd> llt(K);
  double sum = 0;
  for (Eigen::Index c = 0; c < targets.num_functions(); ++c) {
    // Of a heavy-tailed scale: that of closed form.
    const double d2 =
        llt.matrixL().solve(targets.y.row(c).transpose()).squaredNorm() / targets.noise(c);
    const auto n = static_cast<double>(targets.num_samples());
    sum -= 0.5 * n * std::log1p(d2 / n);
  }
  return sum - static_cast<double>(targets.num_functions()) *
                   llt.matrixLLT().diagonal().array().log().sum();
}

class Fitter {
 public:
  Fitter(const Targets& targets, Eigen::VectorXd typical, Eigen::MatrixXd x, Eigen::VectorXd half,
         double outlier_rate)
      : targets_(targets),
        typical_(std::move(typical)),
        x_(std::move(x)),
        half_(std::move(half)),
        log_inlier_(std::log1p(-outlier_rate)),
        log_outlier_(std::log(outlier_rate) + log_flat_density()) {
    for (Eigen::Index t = 0; t < targets_.num_samples(); ++t) inliers_.push_back(t);
  }

  /// std::nullopt if the process says nothing of the measurements that it was not told.
  std::optional<LearnedEdge> fit() {
    maximize();
    for (int round = 0; round < kRounds; ++round) {
      if (!drop_outliers()) break;
      maximize();
    }
    if (!foresees()) return std::nullopt;
    return result();
  }

 private:
  struct Cell {
    Eigen::VectorXd lengths;  // in units of the inputs
    double factor = 1;        // on the typical variances
    double log_likelihood = 0;
    double doubt() const { return factor / lengths.array().square().prod(); }
  };

  int num_cells() const {
    return static_cast<int>(std::size(kVariances) * std::pow(std::size(kLengths), x_.rows()));
  }

  double variance(const Cell& cell, Eigen::Index c) const { return cell.factor * typical_(c); }

  Eigen::MatrixXd covariance(const Eigen::MatrixXd& unit, const Cell& cell, Eigen::Index c) const {
    Eigen::MatrixXd K = variance(cell, c) * unit;
    K.diagonal() += targets_.noise(c) * targets_.scales(inliers_);
    return K;
  }

  // Functions of the inliers, over the whole grid.
  void maximize() {
    const Eigen::MatrixXd x = x_(Eigen::all, inliers_);
    const auto n = static_cast<double>(inliers_.size());
    std::vector<Cell> cells;  // from short to long
    double best = -std::numeric_limits<double>::infinity();
    const auto try_lengths = [&](const Eigen::VectorXd& lengths) {
      const Eigen::MatrixXd unit = Kernel(SquaredExponential{1, lengths}).covariance(x, x);
      for (const double factor : kVariances) {
        Cell cell{lengths, factor, 0};
        for (Eigen::Index c = 0; c < targets_.num_functions(); ++c) {
          const Eigen::LLT<Eigen::MatrixXd> llt(covariance(unit, cell, c));
          cell.log_likelihood -=
              0.5 * llt.matrixL().solve(targets_.y(c, inliers_).transpose()).squaredNorm() +
              llt.matrixLLT().diagonal().array().log().sum() + 0.5 * n * std::log(2 * M_PI);
        }
        best = std::max(best, cell.log_likelihood);
        cells.push_back(std::move(cell));
      }
    };
    Eigen::VectorXd lengths(half_.size());
    for (const double first : kLengths) {
      lengths(0) = first * half_(0);
      if (half_.size() == 1) {
        try_lengths(lengths);
        continue;
      }
      for (const double second : kLengths) {
        lengths(1) = second * half_(1);
        try_lengths(lengths);
      }
    }
    // Of about as likely ones the least sure of itself where no sample is.
    cell_ = *std::max_element(cells.begin(), cells.end(), [&](const Cell& a, const Cell& b) {
      return std::pair(a.log_likelihood > best - kAsLikely, a.doubt()) <
             std::pair(b.log_likelihood > best - kAsLikely, b.doubt());
    });
  }

  // What the other inliers say of each (Rasmussen and Williams, eq. 5.12): k×n.
  void leave_one_out(Eigen::MatrixXd* residual, Eigen::MatrixXd* variance) const {
    const Eigen::MatrixXd x = x_(Eigen::all, inliers_);
    const Eigen::MatrixXd unit = Kernel(SquaredExponential{1, cell_.lengths}).covariance(x, x);
    const auto n = static_cast<Eigen::Index>(inliers_.size());
    residual->resize(targets_.num_functions(), n);
    variance->resize(targets_.num_functions(), n);
    for (Eigen::Index c = 0; c < targets_.num_functions(); ++c) {
      const Eigen::MatrixXd precision =
          covariance(unit, cell_, c).llt().solve(Eigen::MatrixXd::Identity(n, n));
      variance->row(c) = precision.diagonal().cwiseInverse().transpose();
      residual->row(c) = (precision * targets_.y(c, inliers_).transpose())
                             .cwiseQuotient(precision.diagonal())
                             .transpose();
    }
  }

  // A process that is as short as the samples are apart agrees with anything: what is left out must
  // be predicted clearly better than by what stood.
  bool foresees() const {
    Eigen::MatrixXd residual, variance;
    leave_one_out(&residual, &variance);
    double cost = 0;
    for (std::size_t t = 0; t < inliers_.size(); ++t) {
      const double d2 = residual.col(static_cast<Eigen::Index>(t))
                            .cwiseAbs2()
                            .cwiseQuotient(targets_.noise)
                            .sum() /
                        targets_.scales(inliers_[t]);
      cost += student_cost(d2 + targets_.distance_rest(inliers_[t]));
    }
    return cost < kForeseen * targets_.old_cost(inliers_).sum();
  }

  // Of those that the others speak against, the worst few. False if there is none.
  bool drop_outliers() {
    Eigen::MatrixXd residual, variance;
    leave_one_out(&residual, &variance);
    const auto n = static_cast<Eigen::Index>(inliers_.size());
    Eigen::VectorXd log_density = targets_.log_rest(inliers_).array() + log_inlier_;
    for (Eigen::Index t = 0; t < n; ++t)
      for (Eigen::Index c = 0; c < targets_.num_functions(); ++c)
        log_density(t) -= 0.5 * (residual(c, t) * residual(c, t) / variance(c, t) +
                                 std::log(2 * M_PI * variance(c, t)));
    const auto most =
        static_cast<std::size_t>(kMostOutliers * static_cast<double>(targets_.num_samples()));
    const std::size_t num_out = static_cast<std::size_t>(targets_.num_samples()) - inliers_.size();
    std::vector<std::pair<double, Eigen::Index>> refuted;
    for (Eigen::Index t = 0; t < n; ++t)
      if (log_density(t) < log_outlier_) refuted.emplace_back(log_density(t), inliers_[t]);
    std::sort(refuted.begin(), refuted.end());
    // One outlier makes its neighbours look like some.
    const std::size_t num = std::min({refuted.size(), std::max<std::size_t>(1, refuted.size() / 2),
                                      most > num_out ? most - num_out : 0});
    for (std::size_t k = 0; k < num; ++k) std::erase(inliers_, refuted[k].second);
    return num > 0;
  }

  LearnedEdge result() const {
    LearnedEdge learned;
    learned.change = targets_.change;
    const Eigen::MatrixXd x = x_(Eigen::all, inliers_);
    const Eigen::MatrixXd unit = Kernel(SquaredExponential{1, cell_.lengths}).covariance(x, x);
    learned.log_prior = targets_.change.log_odds() - std::log(num_cells());
    for (Eigen::Index c = 0; c < targets_.num_functions(); ++c) {
      const Eigen::MatrixXd K = covariance(unit, cell_, c);
      const Eigen::LLT<Eigen::MatrixXd> llt(K);
      const Eigen::VectorXd alpha = llt.solve(targets_.y(c, inliers_).transpose());
      const Eigen::VectorXd noise = targets_.noise(c) * targets_.scales(inliers_);
      // −½ fᵀK_f⁻¹f − ½ log |I + K_f N⁻¹| at the posterior mean f = K_f α.
      const Eigen::VectorXd f = targets_.y(c, inliers_).transpose() - noise.cwiseProduct(alpha);
      learned.log_prior -= 0.5 * alpha.dot(f) + llt.matrixLLT().diagonal().array().log().sum() -
                           0.5 * noise.array().log().sum();
    }
    const auto num_out =
        static_cast<double>(targets_.num_samples()) - static_cast<double>(inliers_.size());
    learned.log_evidence = targets_.change.log_odds() - std::log(num_cells()) +
                           cell_.log_likelihood +
                           (targets_.log_rest(inliers_).array() + log_inlier_).sum();
    if (num_out > 0) learned.log_evidence += num_out * log_outlier_;
    learned.edge = learned.certain = targets_.edge;
    learned.edge.residual_gp = process(1);
    learned.certain.residual_gp = process(kCertain);
    return learned;
  }

  std::shared_ptr<const ResidualGp> process(double certainty) const {
    ResidualGp::Prior prior{cell_.lengths, {}, {}};
    prior.variances.setZero();
    prior.noise_variances.setZero();
    for (Eigen::Index c = 0; c < targets_.num_functions(); ++c) {
      const Vector6d squares = targets_.into.col(c).cwiseAbs2();
      prior.variances += variance(cell_, c) * squares;
      prior.noise_variances += targets_.noise(c) * squares;
    }
    // A coordinate that is not moved at all is zero, and as good as certain.
    prior.variances = certainty * prior.variances.cwiseMax(1e-18);
    prior.noise_variances = certainty * prior.noise_variances.cwiseMax(1e-18);
    return std::make_shared<const ResidualGp>(signals_of(targets_.change), x_(Eigen::all, inliers_),
                                              targets_.into * targets_.y(Eigen::all, inliers_),
                                              targets_.scales(inliers_), prior);
  }

  const Targets& targets_;
  const Eigen::VectorXd typical_;
  const Eigen::MatrixXd x_;
  const Eigen::VectorXd half_;
  const double log_inlier_, log_outlier_;
  std::vector<Eigen::Index> inliers_;
  Cell cell_;
};

/// The measurement in the midst of all others.
Pose middle_of(const std::vector<EdgeMeasurement>& measurements) {
  double least = std::numeric_limits<double>::infinity();
  Pose middle = Pose::Identity();
  for (const EdgeMeasurement& a : measurements) {
    double sum = 0;
    for (const EdgeMeasurement& b : measurements) {
      const Pose T = a.z.inverse() * b.z;
      sum += T.translation().norm() + 0.3 * rotation_angle(T);
    }
    if (sum >= least) continue;
    least = sum;
    middle = a.z;
  }
  return middle;
}

}  // namespace

std::vector<LearnedEdge> learn_edge(const BodySchema& base, int part,
                                    const std::vector<EdgeMeasurement>& measurements,
                                    double outlier_rate) {
  std::vector<LearnedEdge> result;
  const Edge* const old = edge_to(base, part);
  if (!old || measurements.size() > ResidualGp::kMaxSamples) return result;
  const std::vector<int> own = old->signals();
  std::vector<Targets> forms;
  const auto has_enough = [&](const BodyChange& change) {
    return static_cast<int>(measurements.size()) >= change.fewest_samples();
  };
  const bool has_process = old->residual_gp || old->matrix_gp;
  if (const BodyChange change{Form::kNonlinear, part};
      has_enough(change) && !has_process && !old->joints.empty())
    forms.push_back(one_displacement(change, *old, measurements));
  if (const BodyChange change{Form::kResidual, part};
      has_enough(change) && !has_process && !old->joints.empty())
    forms.push_back(all_coordinates(change, *old, measurements));
  if (const BodyChange change{Form::kFresh, part}; has_enough(change)) {
    Edge fresh = *old;
    fresh.left = middle_of(measurements);
    fresh.right = Pose::Identity();
    fresh.joints.clear();
    fresh.matrix_gp.reset();
    fresh.residual_gp.reset();
    fresh.parameter_covariance = Eigen::MatrixXd::Zero(6, 6);
    forms.push_back(all_coordinates(change, fresh, measurements));
  }
  Eigen::VectorXd old_cost(measurements.size());
  for (std::size_t t = 0; t < measurements.size(); ++t) {
    const EdgeMeasurement& m = measurements[t];
    const Vector6d r = log(old->predict(m.displacements).inverse() * m.z);
    old_cost(static_cast<Eigen::Index>(t)) = student_cost(r.dot(m.covariance.llt().solve(r)));
  }
  for (Targets& targets : forms) {
    targets.old_cost = old_cost;
    const Eigen::VectorXd typical = typical_variances(targets);
    const BodyChange form = targets.change;
    const auto with = [&](int first, int second) {
      BodyChange change = form;
      change.signal = first;
      change.second_signal = second;
      // A refined model has its own signals in it as well.
      std::vector<int> all = signals_of(change);
      if (form.form != Form::kFresh)
        for (const int s : own)
          if (std::find(all.begin(), all.end(), s) == all.end()) all.push_back(s);
      change.proximity = structural_proximity(all, own);
      return change;
    };
    struct Screened {
      double score;
      BodyChange change;
    };
    std::vector<Screened> screened;
    const auto look = [&](int first, int second) {
      const BodyChange change = with(first, second);
      const std::vector<int> signals = signals_of(change);
      screened.push_back(
          {change.log_odds() + screen(targets, typical, inputs_of(signals, measurements),
                                      half_ranges(base, signals)),
           change});
    };
    const auto sort = [&] {
      std::stable_sort(screened.begin(), screened.end(),
                       [](const Screened& a, const Screened& b) { return a.score > b.score; });
    };
    for (int s = 0; s < static_cast<int>(base.signals.size()); ++s) look(s, -1);
    sort();
    std::vector<int> paired = own;
    for (std::size_t k = 0; k < screened.size() && k < kPaired; ++k)
      if (const int s = screened[k].change.signal;
          std::find(paired.begin(), paired.end(), s) == paired.end())
        paired.push_back(s);
    for (std::size_t a = 0; a < paired.size(); ++a)
      for (int s = 0; s < static_cast<int>(base.signals.size()); ++s) {
        const bool is_done =
            std::find(paired.begin(), paired.begin() + static_cast<std::ptrdiff_t>(a) + 1, s) !=
            paired.begin() + static_cast<std::ptrdiff_t>(a) + 1;
        if (!is_done) look(std::min(paired[a], s), std::max(paired[a], s));
      }
    sort();
    for (std::size_t k = 0; k < screened.size() && k < kFitted; ++k) {
      targets.change = screened[k].change;
      const std::vector<int> signals = signals_of(targets.change);
      auto learned = Fitter(targets, typical, inputs_of(signals, measurements),
                            half_ranges(base, signals), outlier_rate)
                         .fit();
      if (learned) result.push_back(std::move(*learned));
    }
  }
  std::stable_sort(result.begin(), result.end(), [](const LearnedEdge& a, const LearnedEdge& b) {
    return a.log_evidence > b.log_evidence;
  });
  return result;
}

}  // namespace bodyschema
