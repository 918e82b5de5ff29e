#include "processes/structure_learner/positions/position_leaves.h"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <functional>
#include <limits>
#include <numeric>
#include <optional>
#include <set>
#include <tuple>

#include "common/estimation/chi_square.h"
#include "common/estimation/quantile.h"
#include "common/geometry/angle.h"
#include "common/kinematics/kinematic_tree.h"
#include "common/text/text.h"
#include "processes/structure_learner/long_chain/coupled_joints.h"
#include "processes/structure_learner/long_chain/long_chain.h"
#include "processes/structure_learner/model_free_noise.h"
#include "processes/structure_learner/positions/position_screen.h"
#include "processes/structure_learner/search/withdrawal.h"
#include "processes/structure_learner/tree_fit.h"

namespace bodyschema {
namespace {

constexpr int kMaxFrames = 300;
/// Starts that are fitted: of two signals at one parent, and in all for a number of joints.
constexpr int kFitsOfSignals = 4;
constexpr std::size_t kMaxFits = 32;
/// Mean robust cost of a frame beyond which a local fit does not mend a start (positions, below the
/// 26 of poses in the share of their residuals).
constexpr double kMaxStartCost = 20;
/// Of two sets of signals that one does not contain the other the data must tell by so much [nats].
/// The largest of a few dozens of wrong ones, hence above kAmbiguityMargin of a pair of two.
constexpr double kRivalMargin = 8;
/// What a joint must have been seen to move a position by: kCommonTurn of withdrawal.cpp at 0.1 m.
constexpr double kLever_m = 0.1;
constexpr double kCommonMotion_m = 0.65 * kLever_m;
/// Independent positions a signal below which no chain is looked for: twice as many equations as it
/// has parameters.
constexpr int kPositionsPerJoint = 4;
/// Joints of a chain up to which one of its signals may move one more.
constexpr int kMostRepeated = 4;
/// Parents below which such a chain is looked for, those seen most often with the leaf.
constexpr std::size_t kMaxChainParents = 3;
/// More is no noise: as learn.cpp's kLargestGuess.
constexpr Noise kLargestGuess{0.01, 3 * kDegree};
constexpr double kSafety = 1.2;  // as noise_estimate.cpp
constexpr int kMinRepeats = 5;

std::vector<int> parts_with_rotation(const std::vector<ActionPoseSample>& samples) {
  const std::vector<int> all = seen_parts(samples), alone = parts_without_rotation(samples);
  std::vector<int> parts;
  std::set_difference(all.begin(), all.end(), alone.begin(), alone.end(),
                      std::back_inserter(parts));
  return parts;
}

/// The parts that leaves may hang on.
class Parents {
 public:
  Parents(const std::vector<ActionPoseSample>& samples, const NormalizedActions& actions, int root,
          const std::set<int>& resting, const MeasurementModel& measurement)
      : samples_(samples), measurement_(measurement) {
    if (!resting.empty()) at_rest_ = resting.contains(root) ? root : *resting.begin();
    for (const int part : parts_with_rotation(samples))
      if (part == at_rest_ || !resting.contains(part)) parts_.push_back(part);
    if (at_rest_ < 0) return;
    const PairData seen = make_part_data(samples, at_rest_, measurement, kMaxFrames);
    X_at_rest_ =
        fit_local_model(screen_rigid(seen, actions).model, seen, actions, 20, 1e-6).model.first;
  }

  const std::vector<int>& parts() const { return parts_; }
  /// The leaf's positions in the frame of the parent; of one that rests, in the camera's.
  PairData pair(int parent, int leaf, int max_frames) const {
    return parent == at_rest_ ? make_part_data(samples_, leaf, measurement_, max_frames)
                              : make_pair_data(samples_, parent, leaf, measurement_, max_frames);
  }
  /// A model of pair() in the frame of the parent.
  LocalModel in_parent(int parent, LocalModel model) const {
    if (parent == at_rest_) model.first = X_at_rest_.inverse() * model.first;
    return model;
  }
  int num_common(int leaf) const {
    int most = 0;
    for (const int parent : parts_) most = std::max(most, pair(parent, leaf, kMaxFrames).size());
    return most;
  }

 private:
  const std::vector<ActionPoseSample>& samples_;
  const MeasurementModel& measurement_;
  int at_rest_ = -1;
  Pose X_at_rest_ = Pose::Identity();
  std::vector<int> parts_;
};

/// The starts at all parents that deserve a fit, best first.
struct StartAt {
  std::size_t parent = 0;
  Start start;
};
std::vector<StartAt> starts_of(const std::vector<PairData>& pairs, const NormalizedActions& actions,
                               int num_joints, int* num_screens) {
  std::vector<StartAt> starts;
  for (std::size_t p = 0; p < pairs.size(); ++p)
    for (Start& start : position_starts(pairs[p], actions, num_joints, num_screens))
      if (start.score < kMaxStartCost) starts.push_back({p, std::move(start)});
  std::stable_sort(starts.begin(), starts.end(), [](const StartAt& x, const StartAt& y) {
    return x.start.score < y.start.score;
  });
  std::map<std::pair<std::size_t, std::set<int>>, int> taken;
  std::erase_if(starts, [&](const StartAt& s) {
    return ++taken[{s.parent, signal_set(s.start.model)}] > kFitsOfSignals;
  });
  starts.resize(std::min(starts.size(), kMaxFits));
  return starts;
}

/// The indices of a few pairs.
std::vector<std::size_t> most_often_seen(const std::vector<PairData>& pairs) {
  std::vector<std::size_t> result(pairs.size());
  std::iota(result.begin(), result.end(), 0);
  std::ranges::stable_sort(result, std::greater(), [&](std::size_t p) { return pairs[p].size(); });
  result.resize(std::min(result.size(), kMaxChainParents));
  return result;
}

/// An order is searched for where a leaf can hang on one part alone, from poses at rest; else it is
/// that of the signals, or the reverse.
JointOrder order_of_chains(const Parents& parents, const NormalizedActions& actions) {
  const bool is_searched = parents.parts().size() == 1 && !actions.blocks().is_stream();
  return is_searched ? JointOrder::kUnknown : JointOrder::kListed;
}

/// A chain on `signals` without the joints that do not pay, in the order that the positions prefer;
/// std::nullopt if they are too few, or so are the positions. `noise_m`: as fit_long_chain().
std::optional<Fit> fit_chain(const PairData& pair, const NormalizedActions& actions,
                             const std::vector<int>& signals, JointOrder order, double noise_m) {
  const int m = static_cast<int>(signals.size());
  const int num_independent =
      actions.blocks().count(pair.frames, [](const PairFrame& frame) { return frame.sample; });
  if (num_independent < kPositionsPerJoint * m) return std::nullopt;
  std::optional<Fit> fit = fit_long_chain(pair, actions, signals, order, noise_m);
  if (!fit) return fit;
  fit = without_idle_joints(with_pure_slides(*std::move(fit), pair, actions), pair, actions);
  if (fit->model.num_joints() <= kMostRepeated)
    fit = with_repeated_signal(*std::move(fit), pair, actions);
  return with_settled_order(*std::move(fit), pair, actions);
}

struct Contender {
  int parent = 0;
  LocalModel model;
  std::set<int> path;  ///< signals between the root and the leaf
  int component = 0;   ///< of the parent
  bool is_valid = true;
  double evidence = 0;
  double score = 0;

  bool contains(const Contender& other) const {
    return component == other.component &&
           std::includes(path.begin(), path.end(), other.path.begin(), other.path.end());
  }
};

class LeafSearch {
 public:
  LeafSearch(const std::vector<ActionPoseSample>& samples, const NormalizedActions& actions,
             int root, const std::vector<Signal>& signals, const SearchOptions& options,
             SearchResult* found)
      : actions_(actions),
        signals_(signals),
        options_(options),
        found_(*found),
        parents_(samples, actions, root, found->resting, options.measurement),
        components_(parts_with_rotation(samples)) {
    for (const AcceptedModel& m : found_.models) components_.join(m.part_i, m.part_j);
    const std::vector<int> posed = parts_with_rotation(samples);
    for (const int parent : parents_.parts()) {
      const bool is_connected = std::binary_search(posed.begin(), posed.end(), root) &&
                                components_.of(parent) == components_.of(root);
      const KinematicTree tree(ends_of(found_.models),
                               is_connected ? root : components_.of(parent));
      std::set<int>& path = paths_[parent];
      for (const int node : tree.path_to(tree.node_of(parent)))
        path.merge(signal_set(found_.models[tree.nodes()[node].edge].model));
    }
  }

  void search(int leaf, PositionLeaves* result) const {
    const std::vector<Contender> contenders = contenders_of(leaf);
    const auto open = [&](bool is_data_missing, const std::string& reason) {
      result->open[leaf] = {is_data_missing, reason};
    };
    if (contenders.empty()) {
      const int num_joints = std::min(
          {static_cast<int>(actions_.moving().size()), options_.max_signals, kMaxChainJoints});
      const bool are_few =
          parents_.num_common(leaf) < std::max(5 * kPosesPerJoint, kPositionsPerJoint * num_joints);
      return open(are_few, are_few ? "more samples are needed to trust a model"
                                   : "no model is valid for its positions alone: give "
                                     "orientations, as of three points of the part, the structure "
                                     "(refine --structure), or more noise (--noise) where links "
                                     "bend or joints have play");
    }
    const Contender& chosen = contenders.front();
    for (const Contender& other : contenders) {
      if (other.contains(chosen)) continue;
      if (!other.is_valid) return open(true, "more samples are needed to trust a model");
      return open(true, "its positions are explained about as well by " + name_of(chosen) +
                            " as by " + name_of(other) + ": give orientations, or more samples");
    }
    if (!chosen.is_valid) return open(true, "more samples are needed to trust a model");
    const PairData all = parents_.pair(chosen.parent, leaf, std::numeric_limits<int>::max());
    const Fit fit = fit_local_model(chosen.model, all, actions_, 30, 1e-3);
    ++found_.num_fits;
    const LeaveOneOut loo = leave_one_out(fit, all, actions_);
    if (check_validity(fit, loo, all, actions_, options_.validity).verdict != Verdict::kValid)
      return open(false, "no model is valid for its positions alone: give orientations");
    if (const std::string untold = untold_signals(fit, loo, all); !untold.empty())
      return open(true, "more samples are needed: too few yet to tell what moves with " + untold);
    result->models.push_back(
        {chosen.parent, leaf, parents_.in_parent(chosen.parent, fit.model), chosen.score});
  }

 private:
  // Those that the data do not tell from the best, fewest signals first.
  std::vector<Contender> contenders_of(int leaf) const {
    std::vector<PairData> pairs;
    for (const int parent : parents_.parts())
      pairs.push_back(parents_.pair(parent, leaf, kMaxFrames));
    std::vector<Contender> contenders;
    double best = -std::numeric_limits<double>::infinity();
    const auto consider = [&](std::size_t p, const Fit& fit) {
      ++found_.num_fits;
      std::optional<Contender> c = contender(parents_.parts()[p], fit, pairs[p]);
      if (!c) return;
      if (c->is_valid) best = std::max(best, c->evidence);
      contenders.push_back(*std::move(c));
    };
    for (int k = 0; k <= std::min(options_.max_signals, kMaxScreenedJoints); ++k)
      for (const StartAt& s : starts_of(pairs, actions_, k, &found_.num_screens))
        consider(s.parent, fit_local_model(s.start.model, pairs[s.parent], actions_, 60, 1e-3));
    if (!std::isfinite(best))
      for (const std::size_t p : most_often_seen(pairs))
        if (const auto fit = chain_below(p, pairs[p])) consider(p, *fit);
    std::erase_if(contenders, [&](const Contender& c) { return c.evidence < best - kRivalMargin; });
    std::stable_sort(
        contenders.begin(), contenders.end(), [](const Contender& x, const Contender& y) {
          return std::tuple(!x.is_valid, x.path.size(), x.model.num_joints(), -x.evidence) <
                 std::tuple(!y.is_valid, y.path.size(), y.model.num_joints(), -y.evidence);
        });
    return contenders;
  }

  // std::nullopt: refuted.
  std::optional<Contender> contender(int parent, const Fit& fit, const PairData& pair) const {
    const LeaveOneOut loo = leave_one_out(fit, pair, actions_);
    const Validity validity = check_validity(fit, loo, pair, actions_, options_.validity);
    if (validity.verdict == Verdict::kRefuted) return std::nullopt;
    Contender c{parent, fit.model, paths_.at(parent), components_.of(parent)};
    c.path.merge(signal_set(fit.model));
    c.is_valid = validity.verdict == Verdict::kValid;
    c.score = validity.score;
    c.evidence = -0.5 * pair.size() * (validity.mean_capped - 3) -
                 0.5 * loo.rank * std::log(3.0 * pair.size());
    return c;
  }

  // A chain of any number of joints, on the signals that move no other part; else on all that do
  // not move the parent.
  std::optional<Fit> chain_below(std::size_t p, const PairData& pair) const {
    std::set<int> used;
    for (const AcceptedModel& m : found_.models) used.merge(signal_set(m.model));
    const auto without = [this](const std::set<int>& signals) {
      std::vector<int> result;
      for (const int s : actions_.moving())
        if (!signals.contains(s)) result.push_back(s);
      return result;
    };
    std::vector<std::vector<int>> sets{without(used)};
    if (auto all = without(paths_.at(parents_.parts()[p])); all != sets.front())
      sets.push_back(std::move(all));
    const JointOrder order = order_of_chains(parents_, actions_);
    std::optional<Fit> best;
    for (const std::vector<int>& signals : sets) {
      if (static_cast<int>(signals.size()) > options_.max_signals) continue;
      auto fit = fit_chain(pair, actions_, signals, order, relative_motions(pair, 1).sigma_m);
      if (fit && (!best || fit->cost < best->cost)) best = std::move(fit);
      if (best && best->cost < 0.5 * kRightCost * pair.size()) break;
    }
    return best;
  }

  std::string name_of(const Contender& c) const {
    const std::set<int> used = signal_set(c.model);
    const std::string on =
        used.empty() ? "rigid" : "on " + listed(used, [&](int s) {
                                   return signals_[static_cast<std::size_t>(s)].name;
                                 });
    return "part " + std::to_string(c.parent) + " (" + on + ")";
  }

  // Signals that could move the leaf by kCommonMotion_m in some direction without being noticed.
  std::string untold_signals(const Fit& fit, const LeaveOneOut& loo, const PairData& pair) const {
    std::vector<int> untold;
    for (const int s : actions_.moving()) {
      if (fit.model.uses(s)) continue;
      double mean = 0;
      for (const PairFrame& f : pair.frames) mean += actions_(f.sample, s) / pair.size();
      Eigen::Matrix3d own = Eigen::Matrix3d::Zero();
      Eigen::MatrixXd shared = Eigen::MatrixXd::Zero(fit.model.num_parameters(), 3);
      ParameterJacobian J;
      for (int t = 0; t < pair.size(); ++t) {
        const FrameFit& frame = fit.frames[t];
        const PairHypothesis& h = pair.hypotheses[frame.hypothesis];
        const Pose X = predict_with_jacobian(fit.model, actions_, pair.frames[t].sample, &J);
        const Eigen::Matrix3d by_motion =
            (actions_(pair.frames[t].sample, s) - mean) * h.whitening.topLeftCorner<3, 3>();
        const Eigen::Matrix<double, 3, Eigen::Dynamic> by_parameters =
            -h.residual_jacobian(frame.error, X).topRows<3>() * J;
        own += frame.weight() * by_motion.transpose() * by_motion;
        shared += frame.weight() * by_parameters.transpose() * by_motion;
      }
      const Eigen::Matrix3d told = own - shared.transpose() * loo.parameter_covariance * shared;
      const double least =
          std::max(Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d>(told, Eigen::EigenvaluesOnly)
                       .eigenvalues()(0),
                   0.0);
      double& information =
          found_.joint_information.try_emplace(s, std::numeric_limits<double>::infinity())
              .first->second;
      information = std::min(information, least * kLever_m * kLever_m);
      if (least * kCommonMotion_m * kCommonMotion_m < kNoticed) untold.push_back(s);
    }
    return listed(untold, [&](int s) { return signals_[static_cast<std::size_t>(s)].name; });
  }

  const NormalizedActions& actions_;
  const std::vector<Signal>& signals_;
  const SearchOptions& options_;
  SearchResult& found_;
  const Parents parents_;
  Components components_;
  std::map<int, std::set<int>> paths_;
};

// Standard deviation per axis from lengths of residuals.
double deviation(std::vector<double> lengths) {
  return median(std::move(lengths)) / std::sqrt(chi_square_median(3));
}

std::optional<double> noise_of_repeats(const std::vector<ActionPoseSample>& samples,
                                       const std::vector<int>& leaves,
                                       const NormalizedActions& actions) {
  std::vector<double> lengths;
  for (const std::vector<int>& members : repeats(actions))
    for (const int leaf : leaves) {
      std::vector<Eigen::Vector3d> positions;
      for (const int t : members)
        if (const PartObservation* o = samples[static_cast<std::size_t>(t)].find(leaf))
          positions.push_back(o->X_CB.translation());
      const auto n = static_cast<double>(positions.size());
      if (n < kMinRepeats) continue;
      Eigen::Vector3d middle;
      for (int axis = 0; axis < 3; ++axis) {
        std::vector<double> values;
        for (const Eigen::Vector3d& p : positions) values.push_back(p(axis));
        middle(axis) = median(std::move(values));
      }
      for (const Eigen::Vector3d& p : positions)
        lengths.push_back(std::sqrt(n / (n - 1)) * (p - middle).norm());
    }
  if (lengths.size() < 10) return std::nullopt;
  return deviation(std::move(lengths));
}

// Of the model of a leaf that leaves least, for its parameters, of up to two joints; or of all.
std::optional<double> noise_of_best_model(int leaf, const Parents& parents,
                                          const NormalizedActions& actions, bool with_chains) {
  constexpr int kFrames = 120;
  constexpr std::size_t kFits = 8;
  // A chain that leaves so much less than one or two joints ends the search for a better one.
  constexpr double kLessThanFew = 0.003;
  std::vector<PairData> pairs;
  for (const int parent : parents.parts()) pairs.push_back(parents.pair(parent, leaf, kFrames));
  std::optional<double> noise;
  double least = std::numeric_limits<double>::infinity();
  const auto consider = [&](const Fit& fit, const PairData& pair) {
    const LeaveOneOut loo = leave_one_out(fit, pair, actions);
    const double count = 3.0 * pair.size(), dof = count - loo.rank;
    if (dof < 2 * loo.rank) return;
    std::vector<double> lengths;
    for (const Vector6d& r : loo.residual)
      lengths.push_back(std::sqrt(dof / count) * r.head<3>().norm());
    const double sigma = std::max(deviation(std::move(lengths)), kNoiseFloor.position_m);
    const double cost = count * std::log(sigma) + 0.5 * loo.rank * std::log(count);
    if (cost >= least) return;
    least = cost;
    noise = sigma;
  };
  int num_screens = 0;
  for (int k = 0; k <= kMaxScreenedJoints; ++k) {
    std::vector<StartAt> starts = starts_of(pairs, actions, k, &num_screens);
    starts.resize(std::min(starts.size(), kFits));
    for (const StartAt& s : starts)
      consider(fit_local_model(s.start.model, pairs[s.parent], actions, 40, 1e-6), pairs[s.parent]);
  }
  if (!with_chains) return noise;
  const double goal_m = kLessThanFew * noise.value_or(kLargestGuess.position_m);
  for (const std::size_t p : most_often_seen(pairs))
    if (const auto chain = fit_chain(pairs[p], actions, actions.moving(),
                                     order_of_chains(parents, actions), goal_m))
      consider(*chain, pairs[p]);
  return noise;
}

}  // namespace

PositionLeaves find_position_leaves(const std::vector<ActionPoseSample>& samples,
                                    const NormalizedActions& actions, int root,
                                    const std::vector<Signal>& signals,
                                    const SearchOptions& options, SearchResult* found) {
  PositionLeaves result;
  const std::vector<int> leaves = parts_without_rotation(samples);
  const LeafSearch search(samples, actions, root, signals, options, found);
  for (const int leaf : leaves) search.search(leaf, &result);
  return result;
}

std::optional<Noise> noise_at_rest(const std::vector<ActionPoseSample>& samples, int part,
                                   const NormalizedActions& actions,
                                   const ValidityOptions& options) {
  MeasurementModel measurement;
  measurement.noise = kLargestGuess;
  const PairData rough = make_part_data(samples, part, measurement, kMaxFrames);
  if (rough.size() < kMinRepeats) return std::nullopt;
  const Fit fit = fit_local_model(screen_rigid(rough, actions).model, rough, actions, 20, 1e-6);
  std::vector<double> positions, rotations;
  for (const FrameFit& frame : fit.frames) {
    positions.push_back(frame.error.head<3>().norm());
    rotations.push_back(frame.error.tail<3>().norm());
  }
  Noise noise{kSafety * deviation(std::move(positions)), kSafety * deviation(std::move(rotations))};
  if (noise.position_m > kLargestGuess.position_m ||
      noise.rotation_rad > kLargestGuess.rotation_rad)
    return std::nullopt;
  noise.position_m = std::max(noise.position_m, kNoiseFloor.position_m);
  noise.rotation_rad = std::max(noise.rotation_rad, kNoiseFloor.rotation_rad);
  measurement.noise = noise;
  if (!is_at_rest(make_part_data(samples, part, measurement, kMaxFrames), actions, options))
    return std::nullopt;
  return noise;
}

std::optional<SourcedNoise> estimate_position_noise(const std::vector<ActionPoseSample>& samples,
                                                    const NormalizedActions& actions, int root,
                                                    const std::set<int>& resting) {
  const std::vector<int> leaves = parts_without_rotation(samples);
  SourcedNoise noise;
  noise.rotation_rad = kNoiseFloor.rotation_rad;
  noise.source = NoiseSource::kRepeats;
  std::optional<double> sigma = noise_of_repeats(samples, leaves, actions);
  if (!sigma) {
    noise.source = NoiseSource::kResiduals;
    MeasurementModel rough;
    rough.noise = Noise{0.005, kNoiseFloor.rotation_rad};
    const Parents parents(samples, actions, root, resting, rough);
    // Parts that no model explains leave motion, others noise. A long chain is one of few that may
    // be meant, and leaves more than noise where its signals move joints elsewhere, too: it is
    // asked last, unless there is nothing else to ask.
    const auto of_all = [&](bool with_chains) {
      std::optional<double> least;
      for (const int leaf : leaves)
        if (const auto of_leaf = noise_of_best_model(leaf, parents, actions, with_chains))
          least = std::min(least.value_or(*of_leaf), *of_leaf);
      return least;
    };
    sigma = of_all(leaves.size() == 1);
    if (leaves.size() > 1 && (!sigma || *sigma > kLargestGuess.position_m)) sigma = of_all(true);
    if (sigma && *sigma > kLargestGuess.position_m) return std::nullopt;
  }
  if (!sigma) return std::nullopt;
  noise.position_m = std::max(kSafety * *sigma, kNoiseFloor.position_m);
  return noise;
}

}  // namespace bodyschema
