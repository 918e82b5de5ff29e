#pragma once

#include <algorithm>
#include <map>
#include <set>
#include <utility>
#include <vector>

#include "processes/structure_learner/local_model.h"

namespace bodyschema {

/// An accepted local model between parts i < j.
struct AcceptedModel {
  int part_i = 0;
  int part_j = 0;
  LocalModel model;
  double score = 0;
  /// Q of a soft model (residual_fit.h), whose screws `model` then are; empty: screws alone.
  std::vector<int> soft_signals = {};
  /// Of these, those that may have no effect (SoftFit::doubtful_signals).
  std::vector<int> doubtful_signals = {};

  bool joins_part(int part) const { return part == part_i || part == part_j; }
  bool joins(int part_a, int part_b) const {
    return std::minmax(part_a, part_b) == std::minmax(part_i, part_j);
  }
};

std::set<int> signal_set(const LocalModel& model);
/// As often as joints are on them.
std::multiset<int> signals_of_joints(const LocalModel& model);

/// The parts (i, j) of each: a KinematicTree's edges.
std::vector<std::pair<int, int>> ends_of(const std::vector<AcceptedModel>& models);

/// Parts by the component of a forest that they belong to, which is named after its lowest part.
class Components {
 public:
  explicit Components(const std::vector<int>& parts) {
    for (const int part : parts) of_part_[part] = part;
  }

  int of(int part) const { return of_part_.at(part); }
  /// All parts are in one.
  bool is_one() const {
    return std::all_of(of_part_.begin(), of_part_.end(),
                       [this](const auto& p) { return p.second == of_part_.begin()->second; });
  }
  /// False if they are one already.
  bool join(int part_a, int part_b) {
    const auto [lower, upper] = std::minmax({of(part_a), of(part_b)});
    if (lower == upper) return false;
    for (auto& [part, component] : of_part_)
      if (component == upper) component = lower;
    return true;
  }

 private:
  std::map<int, int> of_part_;
};

/// The accepted models and the components that they make of the parts. A value: what is tried on a
/// copy leaves no trace.
class ModelForest {
 public:
  explicit ModelForest(std::vector<int> parts) : parts_(std::move(parts)), components_(parts_) {}

  const std::vector<int>& parts() const { return parts_; }
  /// In the order of acceptance.
  const std::vector<AcceptedModel>& models() const { return models_; }
  /// The lowest part that is connected to this one.
  int component(int part) const { return components_.of(part); }
  bool connected(int part_a, int part_b) const { return component(part_a) == component(part_b); }
  /// The parts of a part's component, ascending.
  std::vector<int> members(int part) const;
  bool spans() const { return components_.is_one(); }
  int num_joints() const;
  std::set<int> used_signals() const;
  /// The signals among these that move nothing in a forest that spans; none in another.
  std::set<int> idle_signals(const std::vector<int>& signals) const;

  void add(AcceptedModel model);
  void set_models(std::vector<AcceptedModel> models);

 private:
  std::vector<int> parts_;
  std::vector<AcceptedModel> models_;
  Components components_;
};

}  // namespace bodyschema
