#pragma once

#include "processes/structure_learner/search/pair_models.h"

namespace bodyschema {

/// Where signals move nearly alike, as commands and what a drive reports of them, each model gets
/// those of them with which all poses of its tree cost least. Where others cost hardly more, no
/// pose tells which of them moves the body: the model is taken back (PairRecord::look_alikes).
void settle_look_alikes(PairModels* pairs, ModelForest* forest);

}  // namespace bodyschema
