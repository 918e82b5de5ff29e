#include "processes/structure_learner/command_warp.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <optional>
#include <set>
#include <utility>

#include "common/schema/warp_process.h"
#include "processes/structure_learner/screen.h"

namespace bodyschema {
namespace {

constexpr int kWarpFrames = 150;      // a pair, evenly chosen
constexpr int kMaxModelsASignal = 4;  // the most precise ones
constexpr int kMaxRounds = 12;
/// Slack along the motion, in half ranges: far more than any warp, far less than the range. Of a
/// joint, in radians: no more than its motion is straight for.
constexpr double kSlack = 0.3, kMostSlack_rad = 0.8;
/// The pair with Σ_z + J σ² Jᵀ in place of Σ_z.
PairData with_slack(const PairData& pair, const LocalModel& model,
                    const NormalizedActions& actions) {
  PairData result = pair;
  for (const PairFrame& frame : pair.frames) {
    MotionJacobian J = motion_jacobian(model, actions, frame.sample);
    for (int d = 0; d < model.num_joints(); ++d)
      J.col(d) *=
          std::min(kSlack, kMostSlack_rad / std::max(std::abs(model.joints[d].turn), 1e-12));
    for (int n = 0; n < frame.num_hypotheses; ++n) {
      PairHypothesis& h = result.hypotheses[frame.first_hypothesis + n];
      // Whitened, Σ_z is the identity: (1 + V Vᵀ) with V = L⁻¹ J.
      const MotionJacobian V = h.whitening * J;
      const Eigen::LLT<Matrix6d> llt(Matrix6d::Identity() + V * V.transpose());
      h.whitening = llt.matrixL().solve(h.whitening);
      h.log_det += 2 * llt.matrixLLT().diagonal().array().log().sum();
    }
  }
  return result;
}

/// A model's measurement of θ of one of its signals at one instant.
struct Reading {
  int sample = 0;
  double theta = 0;             ///< [half ranges], in the model's own line
  double precision = 0;         ///< [1 / half range²]
  double squared_distance = 0;  ///< of its pose, across the motion

  /// Heavy-tailed: of a pose that is so far from where its model and that displacement have it.
  double weight(double theta_error) const {
    return robust_weight(squared_distance + precision * theta_error * theta_error);
  }
};

/// A local model that is asked for the displacements of its signals.
struct Witness {
  PairData pair;
  LocalModel model;
  std::map<int, std::vector<Reading>> readings;  ///< by signal

  /// Total information on a signal's displacement; 0: none.
  double information(int signal) const {
    const auto found = readings.find(signal);
    if (found == readings.end()) return 0;
    double sum = 0;
    for (const Reading& r : found->second) sum += r.weight(0) * r.precision;
    return sum;
  }
};

/// Fits with slack and reads the displacements. False if the model is refuted even so.
bool ask(const NormalizedActions& actions, Witness* witness) {
  Fit fit;
  for (int round = 0; round < 3; ++round) {
    const PairData slack = with_slack(witness->pair, witness->model, actions);
    fit = fit_local_model(witness->model, slack, actions, 30, 1e-6);
    witness->model = fit.model;
  }
  const int n = witness->pair.size();
  int num_outliers = 0;
  double inlier_sum = 0;
  for (const FrameFit& frame : fit.frames) {
    if (frame.squared_distance > kOutlierThreshold)
      ++num_outliers;
    else
      inlier_sum += frame.squared_distance;
  }
  if (3 * num_outliers > n || inlier_sum > 9.0 * (n - num_outliers)) return false;

  witness->readings.clear();
  const LocalModel& model = witness->model;
  for (int t = 0; t < n; ++t) {
    const int sample = witness->pair.frames[t].sample;
    const PairHypothesis& h = witness->pair.hypotheses[fit.frames[t].hypothesis];
    const MotionJacobian V = h.whitening * motion_jacobian(model, actions, sample);
    const Vector6d r = h.whitening * log(model.predict(actions, sample).inverse() * h.z);
    const Eigen::MatrixXd information = V.transpose() * V;
    const Eigen::LDLT<Eigen::MatrixXd> ldlt(information);
    if (!(ldlt.vectorD().minCoeff() > 1e-12 * ldlt.vectorD().maxCoeff())) continue;
    const Eigen::VectorXd delta = ldlt.solve(V.transpose() * r);
    const Eigen::MatrixXd covariance =
        ldlt.solve(Eigen::MatrixXd::Identity(model.num_joints(), model.num_joints()));
    for (int d = 0; d < model.num_joints(); ++d) {
      if (!(covariance(d, d) > 0)) continue;
      witness->readings[model.joints[d].signal].push_back(
          {sample, actions(sample, model.joints[d].signal) + delta(d), 1 / covariance(d, d),
           fit.frames[t].squared_distance});
    }
  }
  return true;
}

struct Regression {
  /// Weights of the basis over the models' mean slope b: a model's own gain drops out.
  Eigen::VectorXd weights;
  double evidence = 0;  ///< log marginal likelihood over that of lines alone [nats]
};

/// Readings of one signal by several models: those of one model after the other.
class Readings {
 public:
  Readings(const std::vector<const std::vector<Reading>*>& models,
           const std::vector<double>& x_of_sample)
      : num_lines_(2 * static_cast<Eigen::Index>(models.size())) {
    for (const auto* of_model : models)
      readings_.insert(readings_.end(), of_model->begin(), of_model->end());
    const auto n = static_cast<Eigen::Index>(readings_.size());
    rows_ = Eigen::MatrixXd::Zero(n, num_lines_ + kWarpSize);
    theta_.resize(n);
    for (Eigen::Index m = 0, r = 0; 2 * m < num_lines_; ++m)
      for (const Reading& reading : *models[static_cast<std::size_t>(m)]) {
        const double x = x_of_sample[reading.sample];
        rows_(r, 2 * m) = 1;
        rows_(r, 2 * m + 1) = x;
        rows_.row(r).tail(kWarpSize) = warp_basis(x, kWarpSize).transpose();
        theta_(r++) = reading.theta;
      }
  }
  Eigen::Index size() const { return theta_.size(); }
  Eigen::VectorXd errors(const Eigen::VectorXd& mean) const { return theta_ - rows_ * mean; }
  /// Of the poses, by how far the readings are off.
  Eigen::VectorXd weights(const Eigen::VectorXd& errors) const {
    Eigen::VectorXd result(errors.size());
    for (Eigen::Index r = 0; r < errors.size(); ++r)
      result(r) = readings_[static_cast<std::size_t>(r)].weight(errors(r));
    return result;
  }
  /// The process with the largest marginal likelihood, if one rises with its command.
  std::optional<WarpProcess> likeliest(Eigen::VectorXd weights) const {
    for (Eigen::Index r = 0; r < weights.size(); ++r)
      weights(r) *= readings_[static_cast<std::size_t>(r)].precision;
    const Eigen::MatrixXd A = rows_.transpose() * weights.asDiagonal() * rows_;
    const Eigen::VectorXd b = rows_.transpose() * weights.cwiseProduct(theta_);
    std::optional<WarpProcess> best;
    for (WarpProcess& process : warp_processes(A, b, static_cast<int>(num_lines_)))
      if (mean_slope(process) > 0 && (!best || process.evidence > best->evidence))
        best = std::move(process);
    return best;
  }
  /// Of the models' lines.
  double mean_slope(const WarpProcess& process) const {
    double sum = 0;
    for (Eigen::Index m = 1; m < num_lines_; m += 2) sum += process.mean(m);
    return 2 * sum / static_cast<double>(num_lines_);
  }

 private:
  Eigen::Index num_lines_;
  std::vector<Reading> readings_;
  Eigen::MatrixXd rows_;  // readings × (two of each line, then the weights)
  Eigen::VectorXd theta_;
};

/// θ_m(q) = a_m + b_m q + φ(q)ᵀw over the readings of all models m: the amplitude and length of the
/// process with the largest marginal likelihood. A wild pose whose error is along the motion, where
/// the slack hides it, shows only by how far its reading is from the others': it counts by that,
/// too.
Regression regress(const std::vector<const std::vector<Reading>*>& models,
                   const std::vector<double>& x_of_sample) {
  // The most that is worth the time; weights of at most 2.5 are as good as still sooner.
  constexpr int kMaxReweighings = 10;
  constexpr double kSmallChange = 1e-3;
  const Readings readings(models, x_of_sample);
  Regression result;
  result.evidence = -std::numeric_limits<double>::infinity();
  Eigen::VectorXd weights = readings.weights(Eigen::VectorXd::Zero(readings.size()));
  for (int n = 0; n < kMaxReweighings; ++n) {
    const std::optional<WarpProcess> process = readings.likeliest(weights);
    if (!process) break;
    result = {process->mean.tail(kWarpSize) / readings.mean_slope(*process), process->evidence};
    const Eigen::VectorXd before =
        std::exchange(weights, readings.weights(readings.errors(process->mean)));
    if ((weights - before).cwiseAbs().maxCoeff() < kSmallChange) break;
  }
  return result;
}

int count_positions(const std::vector<const std::vector<Reading>*>& models,
                    const std::vector<double>& x_of_sample) {
  std::vector<double> x;
  for (const auto* readings : models)
    for (const Reading& reading : *readings) x.push_back(x_of_sample[reading.sample]);
  return num_positions_apart(std::move(x));
}

class WarpEstimate {
 public:
  WarpEstimate(const std::vector<ActionPoseSample>& samples, const std::vector<int>& parts,
               const SearchOptions& options, std::vector<Signal>* signals)
      : samples_(samples), parts_(parts), options_(options), signals_(*signals) {}

  bool run(const SearchResult& found) {
    const std::vector<Signal> before = signals_;
    const NormalizedActions actions = normalized();
    std::vector<Witness> witnesses;
    for (const AcceptedModel& m : found.models) {
      if (m.model.num_joints() == 0) continue;
      Witness witness{pair_data(m.part_i, m.part_j), m.model, {}};
      if (ask(actions, &witness)) witnesses.push_back(std::move(witness));
    }
    const bool spans = found.models.size() + 1 >= parts_.size();
    if (!spans || any_bent(witnesses, actions)) {
      add_single_joints(found, actions, &witnesses);
      settle(&witnesses);
    }
    for (std::size_t s = 0; s < signals_.size(); ++s)
      if (signals_[s].warp != before[s].warp) return true;
    return false;
  }

 private:
  NormalizedActions normalized() const {
    return NormalizedActions(displaced(samples_, signals_), static_cast<int>(signals_.size()));
  }

  PairData pair_data(int part_i, int part_j) const {
    return make_pair_data(samples_, part_i, part_j, options_.measurement, kWarpFrames);
  }

  /// Position of every sample within the signal's limits, −1 … 1.
  std::vector<double> positions(int s) const {
    const double half = 0.5 * (signals_[s].upper - signals_[s].lower);
    std::vector<double> x;
    for (const ActionPoseSample& sample : samples_)
      x.push_back(std::clamp((sample.action(s) - signals_[s].lower) / half - 1, -1.0, 1.0));
    return x;
  }

  /// The most precise witnesses of a signal, no two with a common part.
  std::vector<const std::vector<Reading>*> witnesses_of(int signal,
                                                        const std::vector<Witness>& all) const {
    std::vector<const Witness*> order;
    for (const Witness& witness : all)
      if (witness.information(signal) > 0) order.push_back(&witness);
    std::stable_sort(order.begin(), order.end(), [signal](const Witness* a, const Witness* b) {
      return a->information(signal) > b->information(signal);
    });
    std::set<int> used;
    std::vector<const std::vector<Reading>*> result;
    for (const Witness* witness : order) {
      if (used.contains(witness->pair.part_i) || used.contains(witness->pair.part_j)) continue;
      used.insert({witness->pair.part_i, witness->pair.part_j});
      result.push_back(&witness->readings.at(signal));
      if (result.size() == kMaxModelsASignal) break;
    }
    return result;
  }

  std::map<int, Regression> regressions(const std::vector<Witness>& witnesses,
                                        const NormalizedActions& actions) const {
    std::map<int, Regression> result;
    for (const int s : actions.moving()) {
      if (!(signals_[s].upper > signals_[s].lower)) continue;
      const auto models = witnesses_of(s, witnesses);
      const std::vector<double> x = positions(s);
      if (count_positions(models, x) >= kFewestWarpPositions) result[s] = regress(models, x);
    }
    return result;
  }

  bool any_bent(const std::vector<Witness>& witnesses, const NormalizedActions& actions) const {
    for (const auto& [s, regression] : regressions(witnesses, actions))
      if (regression.evidence > kWarpEvidence) return true;
    return false;
  }

  /// The best single joint of every pair that `found` does not connect rigidly.
  void add_single_joints(const SearchResult& found, const NormalizedActions& actions,
                         std::vector<Witness>* witnesses) const {
    constexpr int kFewest = 6;  // frames, below which a bent command cannot be told from noise
    std::set<std::pair<int, int>> known;
    for (const AcceptedModel& m : found.models)
      if (m.model.num_joints() <= 1) known.insert(std::minmax(m.part_i, m.part_j));
    struct Promise {
      int i, j;
      ScrewRegression regression;
    };
    std::vector<Promise> promises;
    for (std::size_t i = 0; i < parts_.size(); ++i) {
      for (std::size_t j = i + 1; j < parts_.size(); ++j) {
        if (known.contains(std::minmax(parts_[i], parts_[j]))) continue;
        const PairData pair = pair_data(parts_[i], parts_[j]);
        if (pair.size() < kFewest) continue;
        const auto screened = screen_one_joint(relative_motions(pair, 150), actions);
        if (!screened.empty()) promises.push_back({parts_[i], parts_[j], screened.front()});
      }
    }
    constexpr std::size_t kMost = 100;
    std::stable_sort(promises.begin(), promises.end(), [](const Promise& a, const Promise& b) {
      return a.regression.score < b.regression.score;
    });
    if (promises.size() > kMost) promises.resize(kMost);
    for (const Promise& promise : promises) {
      Witness witness{pair_data(promise.i, promise.j), {}, {}};
      const double sigma_rad = relative_motions(witness.pair, 1).sigma_rad;
      witness.model = one_joint_start(promise.regression, witness.pair, actions, sigma_rad).model;
      if (ask(actions, &witness)) witnesses->push_back(std::move(witness));
    }
  }

  /// Warps and models in turn until the warps stand still.
  void settle(std::vector<Witness>* witnesses) {
    for (int round = 0; round < kMaxRounds; ++round) {
      const NormalizedActions actions = normalized();
      std::vector<Witness> heard;
      for (Witness& witness : *witnesses)
        if (ask(actions, &witness)) heard.push_back(std::move(witness));
      *witnesses = std::move(heard);
      double largest_change = 0;
      for (const auto& [s, regression] : regressions(*witnesses, actions)) {
        if (regression.evidence <= kWarpEvidence) continue;
        Signal bent = signals_[s];
        const double half = 0.5 * (bent.upper - bent.lower);
        const Eigen::VectorXd weights = half * regression.weights;
        bent.warp.assign(weights.data(), weights.data() + weights.size());
        for (const ActionPoseSample& sample : samples_) {
          const double q = sample.action(s);
          largest_change = std::max(
              largest_change, std::abs(bent.displacement(q) - signals_[s].displacement(q)) / half);
        }
        signals_[s] = bent;
      }
      if (largest_change < 1e-7) break;
    }
  }

  const std::vector<ActionPoseSample>& samples_;
  const std::vector<int>& parts_;
  const SearchOptions& options_;
  std::vector<Signal>& signals_;
};

}  // namespace

std::vector<ActionPoseSample> displaced(std::vector<ActionPoseSample> samples,
                                        const std::vector<Signal>& signals) {
  for (ActionPoseSample& sample : samples)
    for (std::size_t s = 0; s < signals.size(); ++s) {
      double& q = sample.action(static_cast<Eigen::Index>(s));
      q = signals[s].displacement(q);
    }
  return samples;
}

bool estimate_warps(const std::vector<ActionPoseSample>& samples, const std::vector<int>& parts,
                    const SearchResult& found, const SearchOptions& options,
                    std::vector<Signal>* signals) {
  return WarpEstimate(samples, parts, options, signals).run(found);
}

}  // namespace bodyschema
