#pragma once

#include <set>
#include <utility>

#include "processes/structure_learner/search/pair_models.h"

namespace bodyschema {

/// The model's signals, each with those that move as it does, the lower first.
std::set<std::pair<int, int>> look_alikes_of(const AcceptedModel& model,
                                             const NormalizedActions& actions);

/// Where signals move nearly alike, as commands and what encoders report of them, each model gets
/// those with which the poses of its tree (as many as TreeFit is given) cost least. Where others
/// cost less than kAmbiguityMargin more, no pose tells which of them moves the body: the model is
/// taken back (PairRecord::look_alikes). Returns true if anything changed. A tree fit for each
/// model on such a signal and each that moves alike, until one leaves it open.
bool settle_look_alikes(PairModels* pairs, ModelForest* forest);

}  // namespace bodyschema
