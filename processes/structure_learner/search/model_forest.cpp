#include "processes/structure_learner/search/model_forest.h"

#include <algorithm>
#include <iterator>

namespace bodyschema {

std::set<int> signal_set(const LocalModel& model) {
  std::set<int> signals;
  for (const LocalModel::Joint& joint : model.joints) signals.insert(joint.signal);
  return signals;
}

std::multiset<int> signals_of_joints(const LocalModel& model) {
  std::multiset<int> signals;
  for (const LocalModel::Joint& joint : model.joints) signals.insert(joint.signal);
  return signals;
}

std::vector<std::pair<int, int>> ends_of(const std::vector<AcceptedModel>& models) {
  std::vector<std::pair<int, int>> ends;
  for (const AcceptedModel& m : models) ends.emplace_back(m.part_i, m.part_j);
  return ends;
}

std::vector<int> ModelForest::members(int part) const {
  std::vector<int> result;
  std::copy_if(parts_.begin(), parts_.end(), std::back_inserter(result),
               [&](int other) { return connected(part, other); });
  return result;
}

int ModelForest::num_joints() const {
  int sum = 0;
  for (const AcceptedModel& m : models_) sum += m.model.num_joints();
  return sum;
}

std::set<int> ModelForest::used_signals() const {
  std::set<int> used;
  for (const AcceptedModel& m : models_) used.merge(signal_set(m.model));
  return used;
}

std::set<int> ModelForest::idle_signals(const std::vector<int>& signals) const {
  if (!spans()) return {};
  std::set<int> idle(signals.begin(), signals.end());
  for (const int signal : used_signals()) idle.erase(signal);
  return idle;
}

void ModelForest::add(AcceptedModel model) {
  components_.join(model.part_i, model.part_j);
  models_.push_back(std::move(model));
}

void ModelForest::set_models(std::vector<AcceptedModel> models) {
  models_ = std::move(models);
  components_ = Components(parts_);
  for (const AcceptedModel& m : models_) components_.join(m.part_i, m.part_j);
}

}  // namespace bodyschema
