#include "processes/structure_learner/search/look_alikes.h"

#include <Eigen/Core>
#include <cmath>
#include <map>
#include <set>
#include <utility>
#include <vector>

#include "processes/structure_learner/search/component_tree.h"

namespace bodyschema {
namespace {

std::map<int, std::vector<int>> look_alikes_of(const NormalizedActions& actions) {
  std::map<int, std::vector<int>> result;
  for (const int a : actions.moving())
    for (const int b : actions.moving())
      if (a != b && actions.are_alike(a, b)) result[a].push_back(b);
  return result;
}

LocalModel with_signal(LocalModel model, int signal, int other, const NormalizedActions& actions) {
  const double sign = std::copysign(1.0, actions.correlation(signal, other));
  for (LocalModel::Joint& joint : model.joints) {
    if (joint.signal != signal) continue;
    joint.signal = other;
    joint.turn *= sign;
    joint.slide *= sign;
  }
  return model;
}

}  // namespace

void settle_look_alikes(PairModels* pairs, ModelForest* forest) {
  const auto look_alikes = look_alikes_of(pairs->actions());
  if (look_alikes.empty()) return;
  std::set<std::pair<int, int>> open;  // by their parts
  for (std::size_t m = 0; m < forest->models().size(); ++m) {
    const int part = forest->models()[m].part_i;
    double cost = ComponentTree(*forest, part, pairs).fit().cost();
    for (const int signal : signal_set(forest->models()[m].model)) {
      const auto others = look_alikes.find(signal);
      if (others == look_alikes.end()) continue;
      std::set<std::pair<int, int>> as_likely;
      const AcceptedModel present = forest->models()[m];
      for (const int other : others->second) {
        if (present.model.uses(other)) continue;
        std::vector<AcceptedModel> models = forest->models();
        models[m].model = with_signal(present.model, signal, other, pairs->actions());
        ModelForest changed = *forest;
        changed.set_models(std::move(models));
        const double changed_cost = ComponentTree(changed, part, pairs).fit().cost();
        if (changed_cost < cost - kAmbiguityMargin) as_likely.clear();
        if (std::abs(changed_cost - cost) < kAmbiguityMargin)
          as_likely.insert(std::minmax(signal, other));
        if (changed_cost >= cost) continue;
        cost = changed_cost;
        *forest = std::move(changed);
      }
      if (as_likely.empty()) continue;
      open.insert({present.part_i, present.part_j});
      PairRecord& record = pairs->record(present.part_i, present.part_j);
      record.look_alikes.merge(as_likely);
      record.note_undecided(present.model.num_joints(), 0);
    }
  }
  std::vector<AcceptedModel> models = forest->models();
  std::erase_if(models, [&](const AcceptedModel& m) {
    return open.contains({m.part_i, m.part_j});
  });
  forest->set_models(std::move(models));
}

}  // namespace bodyschema
