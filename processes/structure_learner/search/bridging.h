#pragma once

#include "processes/structure_learner/search/pair_models.h"

namespace bodyschema {

/// Connects components by models that their own pair refuted narrowly, if all markers of both sides
/// together find nothing wrong with one: tying the two costs no more than noise does. A model that
/// is too small grows by the joints it lacks. Another signal set between the same parts that does
/// as well leaves it open. True if any two were connected.
bool bridge(PairModels* pairs, ModelForest* forest);

}  // namespace bodyschema
