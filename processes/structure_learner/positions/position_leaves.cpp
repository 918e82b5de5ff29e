#include "processes/structure_learner/positions/position_leaves.h"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <set>
#include <tuple>

#include "common/kinematics/kinematic_tree.h"
#include "common/text/text.h"
#include "processes/structure_learner/positions/position_parents.h"
#include "processes/structure_learner/search/withdrawal.h"

namespace bodyschema {
namespace {

/// Of two sets of signals that one does not contain the other the data must tell by so much [nats].
/// The largest of a few dozens of wrong ones, hence above kAmbiguityMargin of a pair of two.
constexpr double kRivalMargin = 8;
/// What a joint must have been seen to move a position by: kCommonTurn of withdrawal.cpp at 0.1 m.
constexpr double kLever_m = 0.1;
constexpr double kCommonMotion_m = 0.65 * kLever_m;

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
    const Fit fit =
        with_settled_order(fit_local_model(chosen.model, all, actions_, 30, 1e-3), all, actions_);
    ++found_.num_fits;
    const LeaveOneOut loo = leave_one_out(fit, all, actions_);
    if (check_validity(fit, loo, all, actions_, options_.validity).verdict != Verdict::kValid)
      return open(false, "no model is valid for its positions alone: give orientations");
    if (const std::string open_order = signals_of_open_order(fit.model); !open_order.empty())
      return open(true, "the order of the joints of " + open_order +
                            " is not told by these positions: move them together, and farther");
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
      pairs.push_back(parents_.pair(parent, leaf, kMaxPositionFrames));
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
      auto fit =
          fit_position_chain(pair, actions_, signals, order, relative_motions(pair, 1).sigma_m);
      if (fit && (!best || fit->cost < best->cost)) best = std::move(fit);
      if (best && best->cost < 0.5 * kRightCost * pair.size()) break;
    }
    return best;
  }

  std::string signals_of_open_order(const LocalModel& model) const {
    std::set<int> open;
    for (const LocalModel::Joint& joint : model.joints)
      if (joint.order_group >= 0) open.insert(joint.signal);
    return listed(open, [&](int s) { return signals_[static_cast<std::size_t>(s)].name; });
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
  const PositionParents parents_;
  Components components_;
  std::map<int, std::set<int>> paths_;
};

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

}  // namespace bodyschema
