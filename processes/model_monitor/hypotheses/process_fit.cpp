#include "processes/model_monitor/hypotheses/process_fit.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <span>

#include "processes/model_monitor/likelihood/tree_filter.h"

namespace bodyschema {
namespace {

/// In half ranges of a signal.
constexpr double kLengths[] = {0.3, 0.6, 1.2, 2.4};
/// Variance of the function, in squared typical values of it (at least of the noise).
constexpr double kVariances[] = {1, 5, 25};
constexpr int kRounds = 5;
constexpr double kMostOutliers = 0.25;
/// Cells that the samples do not tell apart [nats].
constexpr double kAsLikely = 2;
/// Largest cost of left-out measurements, as a share of the old model's.
constexpr double kForeseen = 0.5;
/// Makes a process certain without a change of its mean.
constexpr double kCertain = 1e-9;

class ProcessFit {
 public:
  ProcessFit(const ProcessTargets& targets, Eigen::VectorXd typical, Eigen::MatrixXd x,
             Eigen::VectorXd half, double outlier_rate)
      : targets_(targets),
        typical_(std::move(typical)),
        x_(std::move(x)),
        half_(std::move(half)),
        log_inlier_(std::log1p(-outlier_rate)),
        log_outlier_(std::log(outlier_rate) + log_flat_density()) {
    for (Eigen::Index t = 0; t < targets_.num_samples(); ++t) inliers_.push_back(t);
  }

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

  // Of the inliers, for a variance of 1.
  Eigen::MatrixXd unit_covariance(const Eigen::VectorXd& lengths) const {
    const Eigen::MatrixXd x = x_(Eigen::all, inliers_);
    return Kernel(SquaredExponential{1, lengths}).covariance(x, x);
  }

  // Functions of the inliers, over the whole grid.
  void maximize() {
    const auto n = static_cast<double>(inliers_.size());
    std::vector<Cell> cells;  // from short to long
    double best = -std::numeric_limits<double>::infinity();
    const auto try_lengths = [&](const Eigen::VectorXd& lengths) {
      const Eigen::MatrixXd unit = unit_covariance(lengths);
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
    const std::span seconds =
        std::span(kLengths).first(half_.size() == 1 ? 1 : std::size(kLengths));
    for (const double first : kLengths)
      for (const double second : seconds)
        try_lengths(half_.cwiseProduct(Eigen::Vector2d(first, second).head(half_.size())));
    // Among cells about as likely, the one least sure of itself where no sample is.
    cell_ = *std::ranges::max_element(cells, [&](const Cell& a, const Cell& b) {
      return std::pair(a.log_likelihood > best - kAsLikely, a.doubt()) <
             std::pair(b.log_likelihood > best - kAsLikely, b.doubt());
    });
  }

  // Each predicted by the other inliers (Rasmussen and Williams, eq. 5.12): k×n.
  void leave_one_out(Eigen::MatrixXd* residual, Eigen::MatrixXd* variance) const {
    const Eigen::MatrixXd unit = unit_covariance(cell_.lengths);
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

  // Drops the worst few that the others speak against. False if there is none.
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
    std::ranges::sort(refuted);
    // One outlier makes its neighbours look like some.
    const std::size_t num = std::min({refuted.size(), std::max<std::size_t>(1, refuted.size() / 2),
                                      most > num_out ? most - num_out : 0});
    for (std::size_t k = 0; k < num; ++k) std::erase(inliers_, refuted[k].second);
    return num > 0;
  }

  LearnedEdge result() const {
    LearnedEdge learned;
    learned.change = targets_.change;
    const Eigen::MatrixXd unit = unit_covariance(cell_.lengths);
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

  const ProcessTargets& targets_;
  const Eigen::VectorXd typical_;
  const Eigen::MatrixXd x_;
  const Eigen::VectorXd half_;
  const double log_inlier_, log_outlier_;
  std::vector<Eigen::Index> inliers_;
  Cell cell_;
};

}  // namespace

std::vector<int> signals_of(const BodyChange& change) {
  std::vector<int> signals{change.signal};
  if (change.second_signal >= 0) signals.push_back(change.second_signal);
  return signals;
}

std::optional<LearnedEdge> fit_process(const ProcessTargets& targets,
                                       const Eigen::VectorXd& typical, const Eigen::MatrixXd& x,
                                       const Eigen::VectorXd& half_ranges, double outlier_rate) {
  return ProcessFit(targets, typical, x, half_ranges, outlier_rate).fit();
}

}  // namespace bodyschema
