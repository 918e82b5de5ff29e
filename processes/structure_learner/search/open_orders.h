#pragma once

#include "processes/structure_learner/search/pair_models.h"

namespace bodyschema {

/// Takes the models back whose joints may be in another order, which would predict other poses
/// where signals move together (PairRecord::open_order). Returns true if anything changed.
bool withdraw_open_orders(PairModels* pairs, ModelForest* forest);

}  // namespace bodyschema
