#include "processes/structure_learner/search/settling.h"

#include <algorithm>
#include <optional>
#include <set>

#include "common/kinematics/kinematic_tree.h"
#include "processes/structure_learner/search/component_tree.h"
#include "processes/structure_learner/tree_fit_normal.h"

namespace bodyschema {
namespace {

// Of all poses of the root's component, were these the forest's models.
double cost_with(const std::vector<AcceptedModel>& models, int root, ModelForest forest,
                 PairModels* pairs) {
  forest.set_models(models);
  return ComponentTree(forest, root, pairs).fit().cost();
}

// Pairs do not tell two models of one size apart that their markers together do. Of the spare
// models with the signal of which a joint is missing, the one with which all poses cost least, and
// less than `cost`. False if there is none.
bool exchange(const ComponentTree& tree, int signal, double cost, std::vector<Candidate>* spare,
              PairModels* pairs, ModelForest* forest) {
  const int root = tree.nodes().front().part;
  std::vector<AcceptedModel> best;
  for (Candidate& c : *spare) {
    // The models that joined its ends may have been refuted since.
    if (!forest->connected(root, c.part_i) || !forest->connected(root, c.part_j) ||
        !c.model.uses(signal) || pairs->is_refuted(c.part_i, c.part_j, c.model))
      continue;
    const KinematicTree from_i(ends_of(forest->models()), c.part_i);
    for (const int node : from_i.path_to(from_i.node_of(c.part_j))) {
      std::vector<AcceptedModel> models = forest->models();
      AcceptedModel& present = models[from_i.nodes()[node].edge];
      if (present.model.num_joints() < c.model.num_joints() || present.joins(c.part_i, c.part_j) ||
          !pairs->confirm_on_all_data(&c))
        continue;
      present = c;
      const double other_cost = cost_with(models, root, *forest, pairs);
      if (other_cost >= cost) continue;
      cost = other_cost;
      best = std::move(models);
    }
  }
  if (best.empty()) return false;
  forest->set_models(std::move(best));
  return true;
}

bool is_one_joint_on(int signal, const LocalModel& model) {
  return model.num_joints() == 1 && model.uses(signal);
}

// Of three parts that one signal moves against each other, two edges given: a spare model for the
// third one.
const Candidate* closing_candidate(const AcceptedModel& one, const AcceptedModel& other,
                                   std::vector<Candidate>* spare, PairModels* pairs) {
  if (one.model.num_joints() != 1) return nullptr;
  const int signal = one.model.joints.front().signal;
  if (!is_one_joint_on(signal, other.model)) return nullptr;
  std::set<int> ends = {one.part_i, one.part_j};
  for (const int part : {other.part_i, other.part_j})
    if (!ends.insert(part).second) ends.erase(part);
  if (ends.size() != 2) return nullptr;
  for (Candidate& c : *spare)
    if (c.joins(*ends.begin(), *ends.rbegin()) && is_one_joint_on(signal, c.model) &&
        !pairs->is_refuted(c.part_i, c.part_j, c.model) && pairs->confirm_on_all_data(&c))
      return &c;
  return nullptr;
}

// Two fingers on one signal turn against each other about an axis that moves; in noise one screw
// may pass for that, and pairs do not tell which two of the three edges are right. Takes those with
// which the poses of the tree cost least, by whatever little: one of the three is as simple as the
// other. False if they stay.
bool exchange_siblings(const ComponentTree& tree, std::vector<Candidate>* spare, PairModels* pairs,
                       ModelForest* forest) {
  const int root = tree.nodes().front().part;
  const std::vector<AcceptedModel> present = forest->models();
  double cost = -1;
  std::vector<AcceptedModel> best;
  for (std::size_t m = 0; m < present.size(); ++m)
    for (std::size_t n = 0; n < m; ++n) {
      if (!forest->connected(root, present[m].part_i)) continue;
      const Candidate* third = closing_candidate(present[m], present[n], spare, pairs);
      if (!third) continue;
      if (cost < 0) cost = tree.fit().cost();
      for (const std::size_t replaced : {m, n}) {
        std::vector<AcceptedModel> models = present;
        models[replaced] = *third;
        const double other_cost = cost_with(models, root, *forest, pairs);
        if (other_cost >= cost) continue;
        cost = other_cost;
        best = std::move(models);
      }
    }
  if (best.empty()) return false;
  forest->set_models(std::move(best));
  return true;
}

// A part's component, settled, as all markers see it.
TreeFit settle_tree(int part, std::vector<Candidate>* spare, PairModels* pairs, ModelForest* forest,
                    std::vector<AcceptedModel>* refuted) {
  constexpr int kMaxSplits = 12;
  for (int num_splits = 0;;) {
    const ComponentTree tree(*forest, part, pairs);
    TreeFit fit = tree.fit();
    const auto worst =
        tree.nodes().size() < 2 ? std::nullopt : missing_joint(*forest, *pairs, &fit);
    // Each time it costs less: it ends.
    if (!worst && exchange_siblings(tree, spare, pairs, forest)) continue;
    if (!worst || ++num_splits == kMaxSplits) return fit;
    if (exchange(tree, worst->signal, fit.cost(), spare, pairs, forest)) continue;
    if (const auto edges = insert_joint(fit.nodes(), *worst)) {
      tree.replace_edges(*edges, forest);
      continue;
    }
    for (const int node : full_edges(fit.nodes(), *worst))
      refuted->push_back(forest->models()[tree.model_of(node)]);
    return fit;
  }
}

}  // namespace

Settled settle_trees(std::vector<Candidate>* spare, PairModels* pairs, ModelForest* forest) {
  Settled result;
  std::vector<AcceptedModel> refuted;
  for (const int part : forest->parts()) {
    if (forest->component(part) != part) continue;
    const TreeFit fit = settle_tree(part, spare, pairs, forest, &refuted);
    result.log_likelihood += fit.log_likelihood();
    if (fit.nodes().size() > 1)
      result.residual_scale = std::max(result.residual_scale, fit.normal_equations().scale);
  }
  result.any_refuted = !refuted.empty();
  std::vector<AcceptedModel> models = forest->models();
  for (const AcceptedModel& m : refuted) {
    pairs->refute(m);
    std::erase_if(models, [&](const AcceptedModel& o) { return o.joins(m.part_i, m.part_j); });
  }
  forest->set_models(std::move(models));
  return result;
}

}  // namespace bodyschema
