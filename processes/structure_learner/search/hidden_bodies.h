#pragma once

#include "processes/structure_learner/search/pair_models.h"

namespace bodyschema {

/// Connects components by models of three joints and more through bodies that are not seen: one
/// between two joints of an accepted model is where this model predicts it, and may carry more. Up
/// to two joints are searched for between it and the parts and hidden bodies of other components,
/// as between two parts; what is found is a model between seen parts, judged by their data. Of two
/// components the one with the fewest joints; another signal set of as many joints that does as
/// well leaves them open. Poses at rest only. True if any two were connected.
bool connect_hidden_bodies(PairModels* pairs, ModelForest* forest);

}  // namespace bodyschema
