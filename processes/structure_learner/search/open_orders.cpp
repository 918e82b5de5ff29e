#include "processes/structure_learner/search/open_orders.h"

#include <set>
#include <utility>
#include <vector>

#include "processes/structure_learner/long_chain/long_chain.h"

namespace bodyschema {

bool withdraw_open_orders(PairModels* pairs, ModelForest* forest) {
  constexpr int kMaxFrames = 400;  // chosen: a few poses in which signals move together may tell
  bool is_changed = false;
  std::vector<AcceptedModel> settled;
  for (const AcceptedModel& present : forest->models()) {
    AcceptedModel model = present;
    if (model.model.num_joints() == 2) {
      const PairData pair = pairs->pair_data(model.part_i, model.part_j, kMaxFrames);
      const Fit fit = fit_local_model(model.model, pair, pairs->actions(), 15, 1e-2);
      ++pairs->num_fits;
      const Fit ordered = with_settled_order(fit, pair, pairs->actions());
      if (ordered.model.joints[0].signal != model.model.joints[0].signal ||
          ordered.model.joints[0].order_group >= 0)
        model.model = ordered.model;
    }
    std::set<int> open;
    for (const LocalModel::Joint& joint : model.model.joints)
      if (joint.order_group >= 0) open.insert(joint.signal);
    is_changed |= !open.empty() || (model.model.num_joints() == 2 &&
                                    model.model.joints[0].signal != present.model.joints[0].signal);
    if (open.empty()) {
      settled.push_back(std::move(model));
      continue;
    }
    PairRecord& record = pairs->record(model.part_i, model.part_j);
    record.open_order = std::move(open);
    record.note_undecided(model.model.num_joints(), 0);
  }
  forest->set_models(std::move(settled));
  return is_changed;
}

}  // namespace bodyschema
