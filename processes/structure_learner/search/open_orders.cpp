#include "processes/structure_learner/search/open_orders.h"

#include <algorithm>
#include <set>
#include <utility>
#include <vector>

#include "processes/structure_learner/long_chain/long_chain.h"

namespace bodyschema {

namespace {

std::vector<int> order_of(const LocalModel& model) {
  std::vector<int> signals;
  for (const LocalModel::Joint& joint : model.joints) signals.push_back(joint.signal);
  return signals;
}

// With the order that the poses of its two parts tell. Screens and chains were fitted to an even
// subset; the few poses in which signals move together may be others.
LocalModel settled(const AcceptedModel& accepted, PairModels* pairs) {
  constexpr int kMaxFrames = 400;  // chosen
  const bool is_screened = accepted.model.num_joints() <= kMaxScreenedJoints;
  const PairData pair = pairs->pair_data(accepted.part_i, accepted.part_j, kMaxFrames);
  if (accepted.model.num_joints() < 2 ||
      (!is_screened && pair.size() == pairs->pair(accepted.part_i, accepted.part_j).size()))
    return accepted.model;
  ++pairs->num_fits;
  const Fit fit = fit_local_model(accepted.model, pair, pairs->actions(), 15, 1e-2);
  const LocalModel ordered = with_settled_order(fit, pair, pairs->actions()).model;
  const bool is_open = std::ranges::any_of(
      ordered.joints, [](const LocalModel::Joint& joint) { return joint.order_group >= 0; });
  return is_open || order_of(ordered) != order_of(accepted.model) ? ordered : accepted.model;
}

}  // namespace

bool withdraw_open_orders(PairModels* pairs, ModelForest* forest) {
  bool is_changed = false;
  std::vector<AcceptedModel> models;
  for (const AcceptedModel& present : forest->models()) {
    AcceptedModel model = present;
    model.model = settled(present, pairs);
    std::set<int> open;
    for (const LocalModel::Joint& joint : model.model.joints)
      if (joint.order_group >= 0) open.insert(joint.signal);
    is_changed |= !open.empty() || order_of(model.model) != order_of(present.model);
    if (open.empty()) {
      models.push_back(std::move(model));
      continue;
    }
    PairRecord& record = pairs->record(model.part_i, model.part_j);
    record.open_order = std::move(open);
    record.note_undecided(model.model.num_joints(), 0);
  }
  forest->set_models(std::move(models));
  return is_changed;
}

}  // namespace bodyschema
