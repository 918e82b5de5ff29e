#include "processes/structure_learner/residual_fitter.h"

#include <Eigen/Cholesky>
#include <Eigen/QR>
#include <algorithm>
#include <array>
#include <boost/math/distributions/fisher_f.hpp>
#include <cmath>
#include <limits>
#include <numeric>

#include "common/estimation/quantile.h"
#include "common/estimation/student_t.h"
#include "common/gp/minimize_in_box.h"
#include "processes/structure_learner/wrong_commands.h"

namespace bodyschema {
namespace {

constexpr std::size_t kLeastSamples = 10;
// Instants that tell hyper-parameters and signals. Chosen: each step costs the cube of their
// number.
constexpr std::size_t kShapeSamples = 64;
// Length scales [half ranges]. Longest: over the range the kernel falls by 0.2 %. Shortest: a joint
// that turns once around has errors that come back each third of a turn.
constexpr double kShortest = 0.1, kLongest = 30;
// From one of them most likelihoods are local maxima: all that is left may be noise as well. Two
// screws of a positioner leave 0.39 mm; processes from the start that is likeliest before a step
// leave as much, those from the likeliest end 0.17 mm.
constexpr std::array kStartLengths = {1.0, 3.0, 9.0};

// Chance of so many outliers in a row at any end of the signals' ranges below which they are no
// wild readings: that the only two of 80 are there has one of 1 in 800 for two signals.
constexpr double kLogChanceAtEnd = -4.6;  // 1e-2
// d² of outliers from which on they are wild wherever they are, as tags that are read turned over:
// 45 deviations, chosen.
const double kWild = 100 * kOutlierThreshold;

// At most so many instants that cover the inputs (D×n) evenly: each the one farthest from all
// before.
std::vector<int> spread_evenly(const Eigen::MatrixXd& inputs, const std::vector<int>& candidates,
                               std::size_t most) {
  std::vector<int> chosen;
  if (candidates.size() <= most) return candidates;
  Eigen::VectorXd distance =
      Eigen::VectorXd::Constant(inputs.cols(), std::numeric_limits<double>::infinity());
  int next = candidates.front();
  for (const int c : candidates)
    if (inputs.col(c).squaredNorm() < inputs.col(next).squaredNorm()) next = c;
  while (chosen.size() < most) {
    chosen.push_back(next);
    int farthest = -1;
    for (const int c : candidates) {
      distance(c) =
          std::min(distance(c), (inputs.col(c) - inputs.col(chosen.back())).squaredNorm());
      if (farthest < 0 || distance(c) > distance(farthest)) farthest = c;
    }
    next = farthest;
    if (!(distance(next) > 0)) break;
  }
  std::sort(chosen.begin(), chosen.end());
  return chosen;
}

// The predictive distribution of a whitened residual, about zero.
class Predicted {
 public:
  explicit Predicted(const Matrix6d& covariance) : llt_(covariance) {}
  double squared_distance(const Vector6d& residual) const {
    return residual.dot(llt_.solve(residual));
  }
  double log_density(const Vector6d& residual) const {
    return bounded_log_density(squared_distance(residual),
                               2 * llt_.matrixLLT().diagonal().array().log().sum());
  }

 private:
  Eigen::LLT<Matrix6d> llt_;
};

}  // namespace

double bounded_log_density(double squared_distance, double log_det) {
  return -0.5 * (std::min(squared_distance, 2 * kOutlierThreshold) + log_det);
}

ResidualFitter::Blocks ResidualFitter::blocks_of(const PairData& pair, const TimeBlocks& time) {
  Blocks blocks;
  int previous = -1;
  for (const PairFrame& frame : pair.frames) {
    const int block = time.block_of(frame.sample);
    if (block != previous) ++blocks.count;
    previous = block;
    blocks.of_frame.push_back(blocks.count - 1);
  }
  return blocks;
}

ResidualFitter::ResidualFitter(const LocalModel& screws, const PairData& pair,
                               const NormalizedActions& actions)
    : screws_(&screws),
      pair_(&pair),
      actions_(&actions),
      blocks_(blocks_of(pair, actions.blocks())) {
  const Fit fit = evaluate(screws, pair, actions);
  std::vector<double> distances;
  for (const FrameFit& f : fit.frames) distances.push_back(f.squared_distance);
  // Against the model's own errors, not the noise: what it cannot explain is no outlier yet.
  const double scale = std::max(1.0, upper_median(distances) / chi_square_median(6));
  targets_.frames = fit.frames;
  set_targets();
  for (int t = 0; t < pair.size(); ++t) targets_.weights(t) = robust_weight(distances[t] / scale);
}

std::vector<int> ResidualFitter::ranked_signals() const {
  std::vector<std::pair<double, int>> ranked;
  for (const int s : actions_->moving()) {
    const Eigen::VectorXd x = input_row(s);
    const double W = targets_.weights.sum(), mean = targets_.weights.dot(x) / W;
    const Eigen::VectorXd wx = targets_.weights.cwiseProduct((x.array() - mean).matrix());
    const double norm = wx.dot((x.array() - mean).matrix());
    const Vector6d b = targets_.rho * wx / std::max(norm, 1e-300);
    ranked.emplace_back(-(b.cwiseAbs2().cwiseQuotient(targets_.noise)).sum() * norm, s);
  }
  std::sort(ranked.begin(), ranked.end());
  std::vector<int> result;
  for (const auto& [gain, s] : ranked) result.push_back(s);
  return result;
}

ResidualFitter::Gain ResidualFitter::gain_over(const ResidualFitter& fewer) const {
  double sum = 0, squares = 0;
  for (std::size_t b = 0; b < block_density_.size(); ++b) {
    const double by = block_density_[b] - fewer.block_density_[b];
    sum += by;
    squares += by * by;
  }
  return {sum, std::sqrt(std::max(
                   0.0, squares - sum * sum / static_cast<double>(block_density_.size())))};
}

void ResidualFitter::set_signals(const std::vector<int>& signals) {
  signals_ = signals;
  inputs_.resize(static_cast<Eigen::Index>(signals.size()), pair_->size());
  for (std::size_t d = 0; d < signals.size(); ++d)
    inputs_.row(static_cast<Eigen::Index>(d)) = input_row(signals[d]).transpose();
}

bool ResidualFitter::fit(const std::vector<int>& signals, const Shape* start, int max_iterations) {
  set_signals(signals);
  choose_samples(kShapeSamples);
  if (samples_.size() < kLeastSamples) return false;
  maximize(start, max_iterations);
  judge();
  return true;
}

ResidualFitter ResidualFitter::without(int place, int max_iterations) const {
  ResidualFitter result = *this;
  std::vector<int> fewer = signals_;
  fewer.erase(fewer.begin() + place);
  result.set_signals(fewer);
  Shape start = shape_;
  const Eigen::Index rest = shape_.log_lengths.size() - 1 - place;
  start.log_lengths.resize(rest + place);
  start.log_lengths << shape_.log_lengths.head(place), shape_.log_lengths.tail(rest);
  result.maximize(&start, max_iterations);
  result.judge();
  return result;
}

bool ResidualFitter::is_straight(int place) const {
  return shape_.log_lengths(place) > std::log(0.9 * kLongest);
}

double ResidualFitter::log_chance_of_line(int signal) const {
  const Eigen::Index n = pair_->size(), D = inputs_.rows();
  Eigen::MatrixXd lines(n, D + 1);
  lines << Eigen::VectorXd::Ones(n), inputs_.transpose();
  Eigen::VectorXd x = input_row(signal);
  x -= lines * lines.colPivHouseholderQr().solve(x);
  Eigen::Matrix<double, 6, Eigen::Dynamic> scores =
      Eigen::Matrix<double, 6, Eigen::Dynamic>::Zero(6, blocks_.count);
  for (Eigen::Index t = 0; t < n; ++t)
    if (judged_.squared_distance[t] <= kOutlierThreshold)
      scores.col(blocks_.of_frame[t]) += x(t) * judged_.frames[t].residual;
  const Vector6d sum = scores.rowwise().sum();
  Matrix6d squares = scores * scores.transpose();
  squares.diagonal().array() += 1e-9 * squares.trace() + 1e-300;
  const double T = sum.dot(squares.llt().solve(sum)), B = blocks_.count;
  const double f = (B - 6) / 6 * T / std::max(1e-9, B - T);
  return std::log(std::max(
      1e-300, boost::math::cdf(complement(boost::math::fisher_f(6, B - 6), std::max(0.0, f)))));
}

void ResidualFitter::use_all_samples() {
  choose_samples(ResidualGp::kMaxSamples);
  judge();
}

bool ResidualFitter::reweigh() {
  for (int t = 0; t < pair_->size(); ++t) {
    targets_.frames[t] = judged_.frames[t];
    targets_.weights(t) = robust_weight(judged_.squared_distance[t]);
  }
  const std::vector<int> at_ends = outliers_at_ends();
  for (const int t : at_ends) targets_.weights(t) = 1;
  set_targets(false);
  return !at_ends.empty();
}

std::vector<int> ResidualFitter::outliers_at_ends() const {
  std::vector<int> result, order(static_cast<std::size_t>(pair_->size()));
  if (actions_->blocks().is_stream()) return result;
  const double log_trials = std::log(2.0 * static_cast<double>(inputs_.rows()));
  const auto& d2 = judged_.squared_distance;
  for (Eigen::Index d = 0; d < inputs_.rows(); ++d)
    for (const double sign : {-1.0, 1.0}) {
      const auto place = [&](int t) { return sign * inputs_(d, t); };
      std::iota(order.begin(), order.end(), 0);
      std::ranges::stable_sort(order, {}, place);
      const auto inlier =
          std::ranges::find_if(order, [&](int t) { return d2[t] <= kOutlierThreshold; });
      if (inlier == order.end()) return {};
      // Beyond all inliers, not where the signal often is.
      const double first = place(*inlier) - kResting;
      const auto end =
          std::ranges::find_if(order, [&](int t) { return place(t) >= first || d2[t] > kWild; });
      const auto num = static_cast<int>(end - order.begin());
      if (num > 0 &&
          log_trials + log_hypergeometric(num, num, judged_.num_outliers, pair_->size()) <
              kLogChanceAtEnd)
        result.insert(result.end(), order.begin(), end);
    }
  return result;
}

std::shared_ptr<const ResidualGp> ResidualFitter::residual_gp() const {
  ResidualGp::Prior prior;
  const auto D = static_cast<Eigen::Index>(signals_.size());
  const auto N = static_cast<Eigen::Index>(samples_.size());
  prior.length_scales.resize(D);
  Eigen::MatrixXd inputs(D, N);
  for (Eigen::Index d = 0; d < D; ++d) {
    const double half = actions_->half_range(signals_[d]);
    prior.length_scales(d) = std::exp(shape_.log_lengths(d)) * half;
    inputs.row(d) = inputs_(d, samples_).array() * half + actions_->centre(signals_[d]);
  }
  prior.variances = shape_.log_variances.array().exp();
  prior.noise_variances = std::exp(shape_.log_noise) * targets_.noise;
  return std::make_shared<const ResidualGp>(signals_, inputs, targets_.rho(Eigen::all, samples_),
                                            noise_scales(), prior);
}

Eigen::VectorXd ResidualFitter::input_row(int signal) const {
  Eigen::VectorXd x(pair_->size());
  for (int t = 0; t < pair_->size(); ++t) x(t) = (*actions_)(pair_->frames[t].sample, signal);
  return x;
}

void ResidualFitter::set_targets(bool first) {
  const int n = pair_->size();
  targets_.rho.resize(6, n);
  if (first) targets_.weights = Eigen::VectorXd::Ones(n);
  targets_.noise.setZero();
  for (int t = 0; t < n; ++t) {
    const PairHypothesis& h = pair_->hypotheses[targets_.frames[t].hypothesis];
    targets_.rho.col(t) = log(screws_->predict(*actions_, pair_->frames[t].sample).inverse() * h.z);
    const Matrix6d L = h.whitening.triangularView<Eigen::Lower>().solve(Matrix6d::Identity());
    targets_.noise += L.rowwise().squaredNorm() / n;
  }
}

Eigen::VectorXd ResidualFitter::noise_scales() const {
  Eigen::VectorXd scales(samples_.size());
  for (std::size_t n = 0; n < samples_.size(); ++n)
    scales(static_cast<Eigen::Index>(n)) = 1 / targets_.weights(samples_[n]);
  return scales;
}

void ResidualFitter::choose_samples(std::size_t most) {
  std::vector<int> candidates;
  const double least = robust_weight(kOutlierThreshold);
  for (int t = 0; t < pair_->size(); ++t)
    if (targets_.weights(t) >= least) candidates.push_back(t);
  samples_ = spread_evenly(inputs_, candidates, most);
}

void ResidualFitter::maximize(const Shape* start, int max_iterations) {
  const auto D = static_cast<Eigen::Index>(signals_.size());
  const Eigen::MatrixXd x = inputs_(Eigen::all, samples_);
  const ResidualGp::Residuals y = targets_.rho(Eigen::all, samples_);
  const Eigen::VectorXd scales = noise_scales();
  const Vector6d spread = y.rowwise().squaredNorm() / static_cast<double>(y.cols());
  const auto unpack = [&](const Eigen::VectorXd& v) {
    return Shape{v.head(D), v.segment<6>(D), v(D + 6)};
  };
  const auto objective = [&](const Eigen::VectorXd& v, Eigen::VectorXd* gradient) {
    const Shape s = unpack(v);
    double value = 0;
    if (gradient) gradient->setZero(v.size());
    for (int c = 0; c < 6; ++c) {
      const FittedGp gp(
          GpPrior{0.0,
                  SquaredExponential{std::exp(s.log_variances(c)), s.log_lengths.array().exp()},
                  std::exp(s.log_noise) * targets_.noise(c)},
          x, y.row(c).transpose(), scales);
      value -= gp.log_marginal_likelihood();
      if (!gradient) continue;
      const Eigen::VectorXd g = gp.log_marginal_likelihood_gradient();
      gradient->segment(D + c, 1) -= g.head(1);
      gradient->head(D) -= g.segment(1, D);
      (*gradient)(D + 6) -= g(D + 1);
    }
    return value;
  };
  Eigen::VectorXd lower(D + 7), upper(D + 7), v(D + 7);
  lower.head(D).setConstant(std::log(kShortest));
  upper.head(D).setConstant(std::log(kLongest));
  for (int c = 0; c < 6; ++c) {
    const double largest = std::max(spread(c), targets_.noise(c));
    lower(D + c) = std::log(1e-3 * targets_.noise(c));
    upper(D + c) = std::log(1e3 * largest);
    v(D + c) = std::log(std::max(spread(c), 2e-3 * targets_.noise(c)));
  }
  lower(D + 6) = std::log(kLeastNoise);
  upper(D + 6) = std::log(kMostNoise);
  v(D + 6) = 0;
  const auto minimum_from = [&](const Eigen::VectorXd& from) {
    return minimize_in_box(objective, from, lower, upper, 1e-2, 1.5, max_iterations);
  };
  if (start) {
    v << start->log_lengths, start->log_variances, start->log_noise;
    shape_ = unpack(minimum_from(v.cwiseMax(lower).cwiseMin(upper)).x);
    return;
  }
  double best = std::numeric_limits<double>::infinity();
  for (const double length : kStartLengths) {
    v.head(D).setConstant(std::log(length));
    const BoxMinimum found = minimum_from(v);
    if (!(found.value < best)) continue;
    best = found.value;
    shape_ = unpack(found.x);
  }
}

void ResidualFitter::leave_blocks_out(ResidualGp::Residuals* mean,
                                      ResidualGp::Residuals* variance) const {
  const int n = pair_->size();
  const auto N = static_cast<Eigen::Index>(samples_.size());
  const Kernel unit(SquaredExponential{1, shape_.log_lengths.array().exp()});
  const Eigen::MatrixXd x = inputs_(Eigen::all, samples_);
  const Eigen::MatrixXd K = unit.covariance(x, x);
  const Eigen::MatrixXd k = unit.covariance(x, inputs_);  // N×n
  const Eigen::VectorXd scales = noise_scales();
  for (int c = 0; c < 6; ++c) {
    const double v = std::exp(shape_.log_variances(c));
    Eigen::MatrixXd K_c = v * K;
    K_c.diagonal() += std::exp(shape_.log_noise) * targets_.noise(c) * scales;
    K_c.diagonal().array() += 1e-10 * v;
    const Eigen::MatrixXd P = K_c.llt().solve(Eigen::MatrixXd::Identity(N, N));
    const Eigen::VectorXd alpha = P * targets_.rho(c, samples_).transpose();
    const Eigen::MatrixXd Pk = P * k;
    for (int first = 0, last = 0; first < n; first = last) {
      const int block = blocks_.of_frame[first];
      while (last < n && blocks_.of_frame[last] == block) ++last;
      std::vector<Eigen::Index> out;
      for (Eigen::Index s = 0; s < N; ++s)
        if (blocks_.of_frame[samples_[s]] == block) out.push_back(s);
      const Eigen::LLT<Eigen::MatrixXd> P_BB(P(out, out));
      const Eigen::VectorXd alpha_B = alpha(out);
      for (int t = first; t < last; ++t) {
        const Eigen::VectorXd Pk_B = Pk(out, t);
        const Eigen::VectorXd solved = P_BB.solve(Pk_B);
        (*mean)(c, t) = v * (k.col(t).dot(alpha) - solved.dot(alpha_B));
        const double known = k.col(t).dot(Pk.col(t)) - solved.dot(Pk_B);
        (*variance)(c, t) = std::max(0.0, v - v * v * known);
      }
    }
  }
}

void ResidualFitter::judge() {
  const int n = pair_->size();
  ResidualGp::Residuals mean(6, n), variance(6, n);
  leave_blocks_out(&mean, &variance);
  judged_ = SoftFit{};
  judged_.frames.resize(n);
  judged_.squared_distance.resize(n);
  judged_.residual.resize(n);
  block_density_.assign(static_cast<std::size_t>(blocks_.count), 0);
  double distances = 0, uncertainty = 0;
  int inliers = 0;
  const double share = static_cast<double>(blocks_.count) / n;
  for (int t = 0; t < n; ++t) {
    const Pose prediction = screws_->predict(*actions_, pair_->frames[t].sample) * exp(mean.col(t));
    FrameFit& frame = judged_.frames[t];
    frame = best_reading(*pair_, t, prediction);
    const PairHypothesis& h = pair_->hypotheses[frame.hypothesis];
    // To first order the variance of ρ is one of the pose, moved by the right Jacobian.
    const Matrix6d G = h.whitening * right_jacobian_inverse(mean.col(t)).inverse();
    const Matrix6d S = G * variance.col(t).asDiagonal() * G.transpose();
    const double d2 = Predicted(Matrix6d::Identity() + S).squared_distance(frame.residual);
    // The noise that is told has room for signals that are missed: the one that fits tells more.
    const Predicted predicted(std::exp(shape_.log_noise) * Matrix6d::Identity() + S);
    const double density = predicted.log_density(frame.residual);
    judged_.log_density += share * density;
    block_density_[static_cast<std::size_t>(blocks_.of_frame[t])] += share * density;
    judged_.squared_distance[t] = d2;
    judged_.residual[t] = h.whitening.triangularView<Eigen::Lower>().solve(frame.residual);
    if (d2 > kOutlierThreshold) {
      ++judged_.num_outliers;
      continue;
    }
    ++inliers;
    distances += d2;
    uncertainty += S.trace();
    judged_.score += density - 0.5 * h.log_det;
  }
  if (inliers == 0) return;
  judged_.mean_inlier = distances / inliers;
  judged_.mean_uncertainty = uncertainty / inliers;
  judged_.score /= inliers;
}

}  // namespace bodyschema
