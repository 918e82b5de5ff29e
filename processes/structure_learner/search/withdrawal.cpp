#include "processes/structure_learner/search/withdrawal.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <optional>
#include <utility>
#include <vector>

#include "common/estimation/quantile.h"
#include "processes/structure_learner/joints/missing_joint_test.h"
#include "processes/structure_learner/search/component_tree.h"
#include "processes/structure_learner/tree_fit_normal.h"

namespace bodyschema {
namespace {

// The joint that an edge's data must have shown [rad per half range]. Of few sightings the smallest
// there is, of more one that shows after 10 samples in the chapter's noise. Chosen on 30 robots of
// 2, 4 and 7 joints each: with the smallest one for all, most right structures of chapter noise are
// taken back at 10 and 15 samples. Never more than usual_turn().
constexpr int kFewSightings = 6;
constexpr double kCommonTurn = 0.65;

// A screw whose axis is farther off, or that slides farther in a radian, is a sliding joint whose
// turn is noise (chosen: longer than a robot's links).
constexpr double kLongestLever_m = 2;

// What the body's joints turn: the median of those that were found [rad per half range].
double usual_turn(const std::vector<AcceptedModel>& models) {
  std::vector<double> turns;
  for (const AcceptedModel& edge : models)
    for (const LocalModel::Joint& joint : edge.model.joints) {
      const double turn = std::abs(joint.turn);
      const double motion_m =
          std::hypot(joint.slide, turn * joint.X_after.translation().head<2>().norm());
      if (motion_m < kLongestLever_m * turn) turns.push_back(turn);
    }
  return turns.empty() ? std::numeric_limits<double>::infinity() : median(std::move(turns));
}

// Samples in which parts on both sides of each node's edge were seen; a root that rests always is.
std::vector<std::vector<int>> tied_samples(const ComponentTree& tree) {
  const std::vector<TreeNode>& nodes = tree.nodes();
  std::vector<std::map<int, int>> beyond(nodes.size());  // parts of the subtree seen, by sample
  for (std::size_t k = 0; k < nodes.size(); ++k)
    for (const PairFrame& frame : tree.data()[k].frames) ++beyond[k][frame.sample];
  for (std::size_t k = nodes.size() - 1; k > 0; --k)
    for (const auto& [sample, num_parts] : beyond[k]) beyond[nodes[k].parent][sample] += num_parts;
  std::vector<std::vector<int>> tied(nodes.size());
  for (std::size_t k = 1; k < nodes.size(); ++k)
    for (const auto& [sample, num_parts] : beyond[k])
      if (tree.root_rests() || beyond[0].at(sample) > num_parts) tied[k].push_back(sample);
  return tied;
}

// Of a sample that tells of an edge by other parts alone, whose own edges are fitted to it, too.
// Chosen: of 180 robots "d" in tag noise, 8 samples each (seeds 1 to 60, 1001 to 1060, 2001 to
// 2060), 6 are complete and wrong, 77 right; with 0.5 it is 9 and 78, with 0 4 and 68.
constexpr double kOthersShare = 0.25;

// k + 1 poses determine an edge of k joints: its parameters are 6 (k + 1). Two more test it.
void withdraw_untestable(const ComponentTree& tree, PairModels* pairs,
                         std::vector<AcceptedModel>* kept) {
  const std::vector<std::vector<int>> tied = tied_samples(tree);
  const TimeBlocks& blocks = pairs->actions().blocks();
  for (std::size_t k = 1; k < tied.size(); ++k) {
    const TreeNode& node = tree.nodes()[k];
    const int part_i = tree.nodes()[node.parent].part, part_j = node.part;
    const auto sample_of = [](const PairFrame& frame) { return frame.sample; };
    const int num_own = blocks.count(pairs->pair(part_i, part_j).frames, sample_of);
    const int num_tied = blocks.count(tied[k], [](int sample) { return sample; });
    if (num_own + kOthersShare * (num_tied - num_own) >= node.model.num_joints() + 3) continue;
    pairs->record(part_i, part_j).undecided.emplace(node.model.num_joints(), 0.0);
    std::erase_if(*kept, [&](const AcceptedModel& m) { return m.joins(part_i, part_j); });
  }
}

// Of what a joint moves, one standard deviation. Derived: 5 %, by which gains are called right, at
// two.
constexpr double kLargestGainError = 0.025;

// The largest, over the joints of a node's edge, of the standard deviation of a joint's turn or
// slide over its size, whichever is less.
double gain_error(const TreeNode& node, Eigen::Index offset, const Eigen::MatrixXd& covariance) {
  double largest = 0;
  for (int d = 0; d < node.model.num_joints(); ++d) {
    const LocalModel::Joint& joint = node.model.joints[d];
    const auto relative = [&](Eigen::Index at, double size) {
      const double variance = covariance(at, at);  // 0 where nothing is known
      return variance > 0 && size != 0 ? std::sqrt(variance) / std::abs(size)
                                       : std::numeric_limits<double>::infinity();
    };
    largest =
        std::max(largest, std::min(relative(offset + ScrewChainLayout::turn(d), joint.turn),
                                   relative(offset + ScrewChainLayout::slide(d), joint.slide)));
  }
  return largest;
}

// Into `result`, by their parts, the chains of a tree.
void find_unknown_gains(const ComponentTree& tree, std::vector<std::pair<int, int>>* result) {
  const auto is_chain = [](const TreeNode& node) {
    return node.parent >= 0 && node.model.num_joints() > kMaxScreenedJoints;
  };
  if (std::ranges::none_of(tree.nodes(), is_chain)) return;
  const TreeFit fit = tree.fit();
  const TreeFit::Normal normal = fit.normal_equations();
  const std::optional<Eigen::MatrixXd> inverse = normal.inverse();
  for (std::size_t k = 1; k < fit.nodes().size(); ++k) {
    const TreeNode& node = fit.nodes()[k];
    if (is_chain(node) &&
        (!inverse ||
         gain_error(node, normal.offset[k], *inverse * normal.noise_scale()) > kLargestGainError))
      result->emplace_back(
          std::minmax(fit.nodes()[static_cast<std::size_t>(node.parent)].part, node.part));
  }
}

// Takes back the edge whose data tell least of some signal's joint, if that is not enough: the
// parts that it joined. Otherwise none, and the information on every signal's joint is counted.
std::vector<int> withdraw_least_told(const ComponentTree& tree, double most_turn, PairModels* pairs,
                                     ModelForest* forest,
                                     std::map<int, double>* joint_information) {
  if (tree.nodes().size() < 2) return {};
  const Eigen::MatrixXd information = missing_joint_information(tree.fit());
  const std::vector<int>& moving = pairs->actions().moving();
  double least = kNoticed;
  int least_node = -1, least_signal = -1;
  std::map<int, double> of_component;
  for (int k = 1; k < static_cast<int>(tree.nodes().size()); ++k) {
    const TreeNode& node = tree.nodes()[k];
    const int sightings = std::min(tree.data()[k].size(), tree.data()[node.parent].size());
    const double turn = std::min(most_turn, sightings < kFewSightings ? kLeastTurn : kCommonTurn);
    for (std::size_t s = 0; s < moving.size(); ++s) {
      if (node.model.uses(moving[s])) continue;
      const double told = information(k, static_cast<Eigen::Index>(s));
      double& here = of_component.emplace(moving[s], told).first->second;
      here = std::min(here, told);
      if (turn * turn * told >= least) continue;
      least = turn * turn * told;
      least_node = k;
      least_signal = moving[s];
    }
  }
  if (least_node < 0) {
    for (const auto& [signal, told] : of_component) {
      double& of_signal = joint_information->at(signal);
      of_signal = std::min(of_signal, told);
    }
    return {};
  }
  std::vector<AcceptedModel> models = forest->models();
  const auto m = models.begin() + tree.model_of(least_node);
  PairRecord& record = pairs->record(m->part_i, m->part_j);
  record.undecided.emplace(m->model.num_joints(), 0.0);
  record.untold_signals.insert(least_signal);
  const std::vector<int> parted{m->part_i, m->part_j};
  models.erase(m);
  forest->set_models(std::move(models));
  return parted;
}

}  // namespace

std::map<int, double> withdraw_untold_edges(PairModels* pairs, ModelForest* forest) {
  std::vector<AcceptedModel> kept = forest->models();
  const double most_turn = usual_turn(kept);
  for (const int part : forest->parts())
    if (forest->component(part) == part)
      withdraw_untestable(ComponentTree(*forest, part, pairs), pairs, &kept);
  forest->set_models(std::move(kept));
  std::map<int, double> information;
  for (const int signal : pairs->actions().moving())
    information[signal] = std::numeric_limits<double>::infinity();
  std::vector<int> open;  // a part of each component that is to be judged
  for (const int part : forest->parts())
    if (forest->component(part) == part) open.push_back(part);
  while (!open.empty()) {
    const int part = open.back();
    open.pop_back();
    for (const int end : withdraw_least_told(ComponentTree(*forest, part, pairs), most_turn, pairs,
                                             forest, &information))
      open.push_back(end);
  }
  return information;
}

std::vector<std::pair<int, int>> chains_with_unknown_gains(PairModels* pairs,
                                                           const ModelForest& forest) {
  std::vector<std::pair<int, int>> result;
  for (const int part : forest.parts())
    if (forest.component(part) == part)
      find_unknown_gains(ComponentTree(forest, part, pairs), &result);
  return result;
}

}  // namespace bodyschema
