#include "processes/structure_learner/search/bridging.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <optional>
#include <set>
#include <tuple>

#include "processes/structure_learner/search/component_tree.h"

namespace bodyschema {
namespace {

struct Joined {
  ModelForest forest;
  double cost = 0;  // of the tree
};

// Frames at which a tree of two components has a free pose less than they had apart: those at
// which both are seen; where the root rests, and with it all that hangs on it, those at which the
// other one is seen, if that did not rest too.
int count_ties(const ComponentTree& tree, const ModelForest& apart, PairModels* pairs) {
  std::set<int> seen[2];
  const int root = tree.nodes().front().part;
  for (std::size_t k = 0; k < tree.nodes().size(); ++k) {
    const int part = tree.nodes()[k].part;
    const bool is_other = !apart.connected(root, part);
    if (is_other && pairs->rests(part)) return 0;
    for (const PairFrame& frame : tree.data()[k].frames) seen[is_other].insert(frame.sample);
  }
  if (tree.root_rests()) return static_cast<int>(seen[1].size());
  return static_cast<int>(std::count_if(seen[1].begin(), seen[1].end(),
                                        [&](int sample) { return seen[0].count(sample); }));
}

// Makes two components that cost `cost_apart` one tree, with the joints that all markers ask for.
// std::nullopt if that is worse than noise makes it.
std::optional<Joined> join(const ModelForest& apart, double cost_apart, const NearMiss& miss,
                           PairModels* pairs) {
  ModelForest forest = apart;
  forest.add({miss.part_i, miss.part_j, miss.model});
  for (int added = 0; added <= kMaxScreenedJoints; ++added) {
    const ComponentTree tree(forest, miss.part_i, pairs);
    TreeFit fit = tree.fit();
    if (const auto worst = missing_joint(forest, *pairs, &fit)) {
      const auto edges = insert_joint(fit.nodes(), *worst);
      if (!edges) return std::nullopt;
      tree.replace_edges(*edges, &forest);
      continue;
    }
    // Tying the one's pose to the other's costs half of χ².
    const int joints = forest.num_joints() - apart.num_joints();
    const double dof = 6.0 * count_ties(tree, apart, pairs) - 6 - 6 * joints;
    if (dof < 12 || fit.cost() - cost_apart > 0.5 * (dof + 4 * std::sqrt(2 * dof)))
      return std::nullopt;
    return Joined{std::move(forest), fit.cost()};
  }
  return std::nullopt;
}

std::set<std::tuple<int, int, std::set<int>>> structure_of(const ModelForest& forest) {
  std::set<std::tuple<int, int, std::set<int>>> result;
  for (const AcceptedModel& m : forest.models())
    result.insert({m.part_i, m.part_j, signal_set(m.model)});
  return result;
}

bool is_rival(const NearMiss& x, const NearMiss& y) {
  return x.part_i == y.part_i && x.part_j == y.part_j &&
         x.model.num_joints() == y.model.num_joints() && signal_set(x.model) != signal_set(y.model);
}

}  // namespace

bool bridge(PairModels* pairs, ModelForest* forest) {
  constexpr int kMaxTried = 12;
  const std::vector<NearMiss> misses = pairs->near_misses();
  std::map<std::tuple<int, int, int>, int> tried;  // by components and k
  std::map<int, double> cost_of;                   // of a component's own tree
  const auto own_cost = [&](int part) {
    const auto [it, is_new] = cost_of.emplace(forest->component(part), 0.0);
    if (is_new) it->second = ComponentTree(*forest, part, pairs).fit().cost();
    return it->second;
  };
  bool any = false;
  for (const NearMiss& m : misses) {
    if (forest->connected(m.part_i, m.part_j) || pairs->is_refuted(m.part_i, m.part_j, m.model))
      continue;
    const auto [x, y] = std::minmax({forest->component(m.part_i), forest->component(m.part_j)});
    if (tried[{x, y, m.model.num_joints()}]++ >= kMaxTried) continue;
    const double apart = own_cost(m.part_i) + own_cost(m.part_j);
    std::optional<Joined> joined = join(*forest, apart, m, pairs);
    if (!joined) continue;
    bool is_ambiguous = false;
    for (const NearMiss& other : misses) {
      if (!is_rival(other, m)) continue;
      const auto rival = join(*forest, apart, other, pairs);
      is_ambiguous |= rival && rival->cost < joined->cost + 2 * kAmbiguityMargin &&
                      structure_of(rival->forest) != structure_of(joined->forest);
    }
    if (is_ambiguous) continue;
    *forest = std::move(joined->forest);
    cost_of.clear();
    any = true;
  }
  return any;
}

}  // namespace bodyschema
