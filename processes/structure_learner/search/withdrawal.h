#pragma once

#include <map>
#include <utility>
#include <vector>

#include "processes/structure_learner/search/pair_models.h"

namespace bodyschema {

/// χ² that a joint must put into the residuals to be noticed: against χ²₆ beyond 25, the threshold
/// of V2 (check_validity()), a noncentrality of 48 has a power of 97.7 %.
inline constexpr double kNoticed = 48;

/// Takes back the edges that their data could not have refuted: with fewer than two poses more than
/// determine an edge, or where a signal hardly moved, a wrong model agrees by chance. The joint
/// that would have to show turns no more than those of the forest. Returns what SearchResult calls
/// joint_information, of the edges that stand.
std::map<int, double> withdraw_untold_edges(PairModels* pairs, ModelForest* forest);

/// The chains of three joints and more, by their parts, whose poses do not tell how far each joint
/// moves, within 5 % at two standard deviations: joints of a chain explain each other's motion.
std::vector<std::pair<int, int>> chains_with_unknown_gains(PairModels* pairs,
                                                           const ModelForest& forest);

}  // namespace bodyschema
