#include "processes/structure_learner/residual_fit.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <set>
#include <tuple>

#include "common/gp/minimize_in_box.h"
#include "common/statistics/median.h"

namespace bodyschema {
namespace {

constexpr int kMaxFrames = 600;
// Fewer independent frames than this per signal say too little of a function of them.
constexpr int kLeastFrames = 30;
constexpr int kMaxInputs = 12;
constexpr std::size_t kLeastSamples = 10;
constexpr double kMedianChi6 = 5.348;
constexpr int kIterations = 15, kDropIterations = 8;  // of the marginal likelihood
// A signal stays if the blocks left out miss it by this [nats] and by so many of its standard
// errors: what few blocks say may be noise. Of 150 chains with a signal without effect two kept it
// by 17 and 12 nats, 1.6 and 0.8 errors; signals with an effect have 2.3 and more.
constexpr double kMissed = 10, kMissedErrors = 2;
// Trace of the whitened covariance of a prediction: 6 is that of a measurement.
constexpr double kLargestUncertainty = 6;
constexpr int kScreenFrames = 150;
constexpr std::size_t kPairsTried = 3;  // between two components

struct Blocks {
  std::vector<int> of_frame;  // ascending from 0
  int count = 0;
};

Blocks blocks_of(const PairData& pair, const TimeBlocks& time) {
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

// The tangent-space residuals of one choice of readings, and what they are trusted with.
struct Targets {
  std::vector<FrameFit> frames;
  ResidualGp::Residuals rho;  // 6×n
  Eigen::VectorXd weights;    // n
  Vector6d noise;             // mean variance of a reading, per coordinate
};

// Instants that cover the inputs (D×n) evenly: each the one farthest from all before.
std::vector<int> spread_evenly(const Eigen::MatrixXd& inputs, const std::vector<int>& candidates) {
  std::vector<int> chosen;
  if (candidates.size() <= ResidualGp::kMaxSamples) return candidates;
  Eigen::VectorXd distance =
      Eigen::VectorXd::Constant(inputs.cols(), std::numeric_limits<double>::infinity());
  int next = candidates.front();
  for (const int c : candidates)
    if (inputs.col(c).squaredNorm() < inputs.col(next).squaredNorm()) next = c;
  while (chosen.size() < ResidualGp::kMaxSamples) {
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

// Hyper-parameters over normalised inputs.
struct Shape {
  Eigen::VectorXd log_lengths;
  Vector6d log_variances;
  double log_noise = 0;  // factor on Targets::noise
};

class Fitter {
 public:
  Fitter(const LocalModel& screws, const PairData& pair, const NormalizedActions& actions)
      : screws_(&screws),
        pair_(&pair),
        actions_(&actions),
        blocks_(blocks_of(pair, actions.blocks())) {
    const Fit fit = evaluate(screws, pair, actions);
    std::vector<double> distances;
    for (const FrameFit& f : fit.frames) distances.push_back(f.squared_distance);
    // Against the model's own errors, not the noise: what it cannot explain is no outlier yet.
    const double scale = std::max(1.0, upper_median(distances) / kMedianChi6);
    targets_.frames = fit.frames;
    set_targets();
    for (int t = 0; t < pair.size(); ++t) targets_.weights(t) = robust_weight(distances[t] / scale);
  }

  int num_blocks() const { return blocks_.count; }

  // Signals by how much of the residuals a line in them explains, most first.
  std::vector<int> ranked_signals() const {
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

  // Whether the blocks that were left out, most of them, were predicted better with all signals.
  bool misses(const Fitter& fewer) const {
    double sum = 0, squares = 0;
    for (std::size_t b = 0; b < block_density_.size(); ++b) {
      const double by = block_density_[b] - fewer.block_density_[b];
      sum += by;
      squares += by * by;
    }
    const double error =
        std::sqrt(std::max(0.0, squares - sum * sum / static_cast<double>(block_density_.size())));
    return sum > kMissed && sum > kMissedErrors * error;
  }

  // Hyper-parameters and judgement for this Q. False: too few instants are no outliers.
  bool fit(const std::vector<int>& signals, const Shape* start, int max_iterations) {
    signals_ = signals;
    inputs_.resize(static_cast<Eigen::Index>(signals.size()), pair_->size());
    for (std::size_t d = 0; d < signals.size(); ++d)
      inputs_.row(static_cast<Eigen::Index>(d)) = input_row(signals[d]).transpose();
    choose_samples();
    if (samples_.size() < kLeastSamples) return false;
    maximize(start, max_iterations);
    judge();
    return true;
  }
  // Readings and weights from the judgement.
  void reweigh() {
    for (int t = 0; t < pair_->size(); ++t) {
      targets_.frames[t] = judged_.frames[t];
      targets_.weights(t) = robust_weight(judged_.squared_distance[t]);
    }
    set_targets(false);
  }

  const Shape& shape() const { return shape_; }
  const SoftFit& judged() const { return judged_; }
  const std::vector<int>& signals() const { return signals_; }

  std::shared_ptr<const ResidualGp> residual_gp() const {
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

 private:
  Eigen::VectorXd input_row(int signal) const {
    Eigen::VectorXd x(pair_->size());
    for (int t = 0; t < pair_->size(); ++t) x(t) = (*actions_)(pair_->frames[t].sample, signal);
    return x;
  }

  void set_targets(bool first = true) {
    const int n = pair_->size();
    targets_.rho.resize(6, n);
    if (first) targets_.weights = Eigen::VectorXd::Ones(n);
    targets_.noise.setZero();
    for (int t = 0; t < n; ++t) {
      const PairHypothesis& h = pair_->hypotheses[targets_.frames[t].hypothesis];
      targets_.rho.col(t) =
          log(screws_->predict(*actions_, pair_->frames[t].sample).inverse() * h.z);
      const Matrix6d L = h.whitening.triangularView<Eigen::Lower>().solve(Matrix6d::Identity());
      targets_.noise += L.rowwise().squaredNorm() / n;
    }
  }

  Eigen::VectorXd noise_scales() const {
    Eigen::VectorXd scales(samples_.size());
    for (std::size_t n = 0; n < samples_.size(); ++n)
      scales(static_cast<Eigen::Index>(n)) = 1 / targets_.weights(samples_[n]);
    return scales;
  }

  // Among the frames that are no outliers, as far as one can tell.
  void choose_samples() {
    std::vector<int> candidates;
    const double least = robust_weight(kOutlierThreshold);
    for (int t = 0; t < pair_->size(); ++t)
      if (targets_.weights(t) >= least) candidates.push_back(t);
    samples_ = spread_evenly(inputs_, candidates);
  }

  void maximize(const Shape* start, int max_iterations) {
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
    lower.head(D).setConstant(std::log(0.3));
    upper.head(D).setConstant(std::log(30.0));
    for (int c = 0; c < 6; ++c) {
      const double largest = std::max(spread(c), targets_.noise(c));
      lower(D + c) = std::log(1e-3 * targets_.noise(c));
      upper(D + c) = std::log(1e3 * largest);
      v(D + c) = std::log(std::max(spread(c), 2e-3 * targets_.noise(c)));
    }
    lower(D + 6) = std::log(1e-2);
    upper(D + 6) = std::log(4.0);
    v(D + 6) = 0;
    if (start) {
      v << start->log_lengths, start->log_variances, start->log_noise;
      v = v.cwiseMax(lower).cwiseMin(upper);
    } else {
      double best = std::numeric_limits<double>::infinity();
      Eigen::VectorXd trial = v;
      for (const double length : {1.0, 3.0, 9.0}) {
        trial.head(D).setConstant(std::log(length));
        const double value = objective(trial, nullptr);
        if (!(value < best)) continue;
        best = value;
        v.head(D) = trial.head(D);
      }
    }
    shape_ = unpack(minimize_in_box(objective, v, lower, upper, 1e-2, 1.5, max_iterations).x);
  }

  // What the model says about every frame without the frame's block, in closed form: with
  // P = K⁻¹, the precision of the remaining samples is P_RR − P_RB P_BB⁻¹ P_BR.
  void judge() {
    const int n = pair_->size();
    const auto N = static_cast<Eigen::Index>(samples_.size());
    const Eigen::VectorXd lengths = shape_.log_lengths.array().exp();
    const Kernel unit(SquaredExponential{1, lengths});
    const Eigen::MatrixXd x = inputs_(Eigen::all, samples_);
    const Eigen::MatrixXd K = unit.covariance(x, x);
    const Eigen::MatrixXd k = unit.covariance(x, inputs_);  // N×n
    const Eigen::VectorXd scales = noise_scales();
    ResidualGp::Residuals mean(6, n), variance(6, n);
    for (int c = 0; c < 6; ++c) {
      const double v = std::exp(shape_.log_variances(c));
      Eigen::MatrixXd K_c = v * K;
      K_c.diagonal() += std::exp(shape_.log_noise) * targets_.noise(c) * scales;
      K_c.diagonal().array() += 1e-10 * v;
      const Eigen::MatrixXd P = K_c.llt().solve(Eigen::MatrixXd::Identity(N, N));
      const Eigen::VectorXd alpha = P * targets_.rho(c, samples_).transpose();
      for (int first = 0, last = 0; first < n; first = last) {
        const int block = blocks_.of_frame[first];
        while (last < n && blocks_.of_frame[last] == block) ++last;
        std::vector<Eigen::Index> out;
        for (Eigen::Index s = 0; s < N; ++s)
          if (blocks_.of_frame[samples_[s]] == block) out.push_back(s);
        Eigen::MatrixXd P_R = P;
        Eigen::VectorXd alpha_R = alpha;
        if (!out.empty()) {
          const Eigen::MatrixXd P_B = P(Eigen::all, out);  // N×B
          const Eigen::LLT<Eigen::MatrixXd> P_BB(P(out, out));
          P_R -= P_B * P_BB.solve(P_B.transpose());
          alpha_R -= P_B * P_BB.solve(alpha(out));
        }
        for (int t = first; t < last; ++t) {
          mean(c, t) = v * k.col(t).dot(alpha_R);
          variance(c, t) = std::max(0.0, v - v * v * k.col(t).dot(P_R * k.col(t)));
        }
      }
    }
    judged_ = SoftFit{};
    judged_.frames.resize(n);
    judged_.squared_distance.resize(n);
    judged_.residual.resize(n);
    block_density_.assign(static_cast<std::size_t>(blocks_.count), 0);
    double distances = 0, uncertainty = 0;
    int inliers = 0;
    const double share = static_cast<double>(blocks_.count) / n;
    for (int t = 0; t < n; ++t) {
      const Pose prediction =
          screws_->predict(*actions_, pair_->frames[t].sample) * exp(mean.col(t));
      FrameFit& frame = judged_.frames[t];
      frame = best_reading(*pair_, t, prediction);
      const PairHypothesis& h = pair_->hypotheses[frame.hypothesis];
      // To first order the variance of ρ is one of the pose, moved by the right Jacobian.
      const Matrix6d G = h.whitening * right_jacobian_inverse(mean.col(t)).inverse();
      const Matrix6d S = G * variance.col(t).asDiagonal() * G.transpose();
      const Eigen::LLT<Matrix6d> llt(Matrix6d::Identity() + S);
      const double d2 = frame.residual.dot(llt.solve(frame.residual));
      const double density = -share * (0.5 * std::min(d2, 2 * kOutlierThreshold) +
                                       llt.matrixLLT().diagonal().array().log().sum());
      judged_.log_density += density;
      block_density_[static_cast<std::size_t>(blocks_.of_frame[t])] += density;
      judged_.squared_distance[t] = d2;
      judged_.residual[t] = h.whitening.triangularView<Eigen::Lower>().solve(frame.residual);
      if (d2 > kOutlierThreshold) {
        ++judged_.num_outliers;
        continue;
      }
      ++inliers;
      distances += d2;
      uncertainty += S.trace();
      judged_.score -= 0.5 * (frame.squared_distance + h.log_det);
    }
    if (inliers == 0) return;
    judged_.mean_inlier = distances / inliers;
    judged_.mean_uncertainty = uncertainty / inliers;
    judged_.score /= inliers;
  }

  std::vector<double> block_density_;  // what judged_.log_density is the sum of
  const LocalModel* screws_;
  const PairData* pair_;
  const NormalizedActions* actions_;
  Blocks blocks_;
  Targets targets_;
  std::vector<int> signals_;
  Eigen::MatrixXd inputs_;    // D×n
  std::vector<int> samples_;  // indices into the frames
  Shape shape_;
  SoftFit judged_;
};

// The screws that leave least: rigid, the best joint or the best two.
LocalModel best_screws(const PairData& pair, const NormalizedActions& actions, int max_signals,
                       SearchResult* counted) {
  std::vector<Start> starts{screen_rigid(pair, actions)};
  const RelativeMotions motions = relative_motions(pair, 300);
  if (max_signals >= 1) {
    const auto regressions = screen_one_joint(motions, actions);
    if (!regressions.empty())
      starts.push_back(one_joint_start(regressions[0], pair, actions, motions.sigma_rad));
  }
  if (max_signals >= 2) {
    const std::vector<std::vector<double>> turns(actions.num_signals(), default_turns());
    for (Start& s : screen_two_joints(pair, actions, motions, turns, 2))
      starts.push_back(std::move(s));
  }
  std::optional<Fit> best;
  double best_cost = 0;
  for (const Start& start : starts) {
    Fit fit = fit_local_model(start.model, pair, actions, 20, 1e-2);
    ++counted->num_fits;
    const double cost = fit.cost + 6 * fit.model.num_joints * std::log(6.0 * pair.size());
    if (best && cost >= best_cost) continue;
    best_cost = cost;
    best = std::move(fit);
  }
  return best->model;
}

}  // namespace

std::optional<SoftFit> fit_soft_model(const LocalModel& screws, const PairData& pair,
                                      const NormalizedActions& actions,
                                      const ValidityOptions& options,
                                      const std::vector<int>& signals) {
  if (actions.moving().empty() || pair.size() == 0) return std::nullopt;
  Fitter fitter(screws, pair, actions);
  const int num_independent = fitter.num_blocks();
  if (num_independent < kLeastFrames) return std::nullopt;
  std::vector<int> chosen = signals;
  if (chosen.empty()) {
    chosen = fitter.ranked_signals();
    if (chosen.size() > kMaxInputs) chosen.resize(kMaxInputs);
    std::sort(chosen.begin(), chosen.end());
  }
  if (!fitter.fit(chosen, nullptr, kIterations)) return std::nullopt;
  fitter.reweigh();
  Shape shape = fitter.shape();
  if (!fitter.fit(chosen, &shape, kIterations)) return std::nullopt;
  // Backwards: the signal that is missed least goes first.
  while (signals.empty() && chosen.size() > 1) {
    const Fitter full = fitter;
    std::optional<Fitter> best;
    for (std::size_t d = 0; d < chosen.size(); ++d) {
      Fitter without = full;
      std::vector<int> fewer = chosen;
      fewer.erase(fewer.begin() + static_cast<std::ptrdiff_t>(d));
      shape = full.shape();
      Eigen::VectorXd lengths(fewer.size());
      for (std::size_t n = 0; n < fewer.size(); ++n)
        lengths(static_cast<Eigen::Index>(n)) =
            shape.log_lengths(static_cast<Eigen::Index>(n < d ? n : n + 1));
      shape.log_lengths = lengths;
      if (!without.fit(fewer, &shape, kDropIterations)) continue;
      if (!best || without.judged().log_density > best->judged().log_density)
        best.emplace(std::move(without));
    }
    if (!best || full.misses(*best)) break;
    fitter = std::move(*best);
    chosen = fitter.signals();
  }

  SoftFit result = fitter.judged();
  result.model.screws = screws;
  result.model.residual_gp = fitter.residual_gp();
  for (int d = 0; d < screws.num_joints; ++d) result.model.signals.push_back(screws.signal[d]);
  for (const int s : chosen)
    if (!screws.uses(s)) result.model.signals.push_back(s);

  const double share = static_cast<double>(num_independent) / pair.size();
  const int inliers = pair.size() - result.num_outliers;
  const double max_outliers =
      std::min(binomial_quantile(num_independent, pair_outlier_rate(options), 0.9997) / share,
               0.35 * pair.size());
  const double max_mean = 1.2 * 5.964 + 3 * std::sqrt(11.309 / std::max(1.0, share * inliers));
  if (result.num_outliers > max_outliers || result.mean_inlier > max_mean)
    result.verdict = Verdict::kRefuted;
  else
    result.verdict =
        result.mean_uncertainty > kLargestUncertainty ? Verdict::kNotEnoughData : Verdict::kValid;
  return result;
}

void connect_soft_parts(const std::vector<ActionPoseSample>& samples,
                        const NormalizedActions& actions, const std::vector<int>& parts,
                        const SearchOptions& options, SearchResult* found) {
  // Components by their lowest part.
  std::map<int, int> component;
  for (const int part : parts) component[part] = part;
  const auto join = [&](int a, int b) {
    const int from = std::max(component[a], component[b]);
    const int to = std::min(component[a], component[b]);
    for (auto& [part, c] : component)
      if (c == from) c = to;
  };
  for (const AcceptedModel& m : found->models) join(m.part_i, m.part_j);

  struct Open {
    double cost;  // of the best screws, a frame
    int i, j;
    LocalModel screws;
  };
  std::map<std::pair<int, int>, std::vector<Open>> open;
  std::set<std::pair<int, int>> undecided;
  for (const auto& [pair, record] : found->records) {
    const auto components = std::minmax(component[pair.first], component[pair.second]);
    if (components.first == components.second) continue;
    if (!record.undecided.empty()) undecided.insert(components);
    if (record.num_common >= kLeastFrames)
      open[components].push_back({0, pair.first, pair.second, {}});
  }
  std::vector<AcceptedModel> candidates;
  for (auto& [components, pairs] : open) {
    if (undecided.count(components)) continue;
    for (Open& o : pairs) {
      const PairData data = make_pair_data(samples, o.i, o.j, options.measurement, kScreenFrames);
      if (blocks_of(data, actions.blocks()).count < kLeastFrames) {
        o.cost = std::numeric_limits<double>::infinity();
        continue;
      }
      o.screws = best_screws(data, actions, options.max_signals, found);
      o.cost = evaluate(o.screws, data, actions).cost / data.size();
    }
    std::stable_sort(pairs.begin(), pairs.end(),
                     [](const Open& x, const Open& y) { return x.cost < y.cost; });
    if (pairs.size() > kPairsTried) pairs.resize(kPairsTried);
    for (const Open& o : pairs) {
      if (!std::isfinite(o.cost)) continue;
      const PairData data = make_pair_data(samples, o.i, o.j, options.measurement, kMaxFrames);
      std::optional<SoftFit> best;
      std::vector<LocalModel> bases{screen_rigid(data, actions).model};
      if (o.screws.num_joints > 0) bases.push_back(o.screws);
      for (const LocalModel& base : bases) {
        const auto fit = fit_soft_model(fit_local_model(base, data, actions, 30, 1e-3).model, data,
                                        actions, options.validity);
        ++found->num_fits;
        found->records[{o.i, o.j}].was_soft_tried |= fit.has_value();
        if (fit && (!best || fit->log_density > best->log_density)) best = fit;
      }
      if (!best || best->verdict != Verdict::kValid) continue;
      candidates.push_back({o.i, o.j, best->model.screws, best->score, best->model.signals});
    }
  }
  std::stable_sort(candidates.begin(), candidates.end(), [](const auto& x, const auto& y) {
    return std::make_tuple(-x.score, x.part_i, x.part_j) <
           std::make_tuple(-y.score, y.part_i, y.part_j);
  });
  for (AcceptedModel& c : candidates) {
    if (component[c.part_i] == component[c.part_j]) continue;
    join(c.part_i, c.part_j);
    found->models.push_back(std::move(c));
  }
}

}  // namespace bodyschema
