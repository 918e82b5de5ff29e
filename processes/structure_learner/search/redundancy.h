#pragma once

#include <utility>
#include <vector>

#include "processes/structure_learner/search/pair_models.h"

namespace bodyschema {

/// Edges with a signal that the tree does not need: two edges use it, but the parts at the far ends
/// of both, as these models predict them, do not move with it by more than the noise of one sight.
/// So there is an edge of fewer joints between those parts, and that the data refuted it has
/// another reason than motion: outliers, or a bias of views. Of the two edges the one with more
/// joints is returned, by its parts, and its record says so. O(E² N) for E edges that share a
/// signal and N frames of a pair.
std::vector<std::pair<int, int>> redundant_edges(PairModels* pairs, ModelForest forest);

}  // namespace bodyschema
