#include "processes/structure_learner/search/look_alikes.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <vector>

#include "processes/structure_learner/search/component_tree.h"

namespace bodyschema {
namespace {

std::vector<int> others_like(int signal, const NormalizedActions& actions) {
  std::vector<int> result;
  if (!std::ranges::count(actions.moving(), signal)) return result;
  for (const int other : actions.moving())
    if (other != signal && actions.are_alike(signal, other)) result.push_back(other);
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

// Gives the joints of a model on a signal to the likeliest of those that move alike; those that are
// as likely.
std::vector<int> rivals(std::size_t model, int signal, PairModels* pairs, ModelForest* forest) {
  const AcceptedModel present = forest->models()[model];
  std::map<int, std::pair<double, LocalModel>> tried;  // cost and model, by signal
  ModelForest changed = *forest;
  const auto try_signal = [&](int other) {
    std::vector<AcceptedModel> models = forest->models();
    if (other != signal)
      models[model].model = with_signal(present.model, signal, other, pairs->actions());
    tried[other].second = models[model].model;
    changed.set_models(std::move(models));
    tried[other].first = ComponentTree(changed, present.part_i, pairs).fit().cost();
  };
  for (const int other : others_like(signal, pairs->actions()))
    if (!present.model.uses(other)) try_signal(other);
  if (tried.empty()) return {};
  try_signal(signal);
  const auto cost_of = [](const auto& one) { return one.second.first; };
  const auto best = std::ranges::min_element(tried, {}, cost_of);
  std::vector<AcceptedModel> models = forest->models();
  models[model].model = best->second.second;
  forest->set_models(std::move(models));
  std::vector<int> result = {best->first};
  for (const auto& one : tried)
    if (one.first != best->first && cost_of(one) < cost_of(*best) + kAmbiguityMargin)
      result.push_back(one.first);
  return result;
}

}  // namespace

std::set<std::pair<int, int>> look_alikes_of(const AcceptedModel& model,
                                             const NormalizedActions& actions) {
  std::set<int> signals = signal_set(model.model);
  signals.insert(model.soft_signals.begin(), model.soft_signals.end());
  std::set<std::pair<int, int>> result;
  for (const int signal : signals)
    for (const int other : others_like(signal, actions)) result.insert(std::minmax(signal, other));
  return result;
}

bool settle_look_alikes(PairModels* pairs, ModelForest* forest) {
  bool is_changed = false;
  std::vector<AcceptedModel> settled;
  for (std::size_t m = 0; m < forest->models().size(); ++m) {
    const AcceptedModel present = forest->models()[m];
    PairRecord& record = pairs->record(present.part_i, present.part_j);
    record.look_alikes.clear();
    for (const int signal : signal_set(present.model)) {
      const std::vector<int> open = rivals(m, signal, pairs, forest);
      for (std::size_t n = 1; n < open.size(); ++n)
        record.look_alikes.insert(std::minmax(open[0], open[n]));
      is_changed |= !open.empty() && (open.size() > 1 || open[0] != signal);
      if (!record.look_alikes.empty()) break;
    }
    if (record.look_alikes.empty())
      settled.push_back(forest->models()[m]);
    else
      record.note_undecided(present.model.num_joints(), 0);
  }
  forest->set_models(std::move(settled));
  return is_changed;
}

}  // namespace bodyschema
