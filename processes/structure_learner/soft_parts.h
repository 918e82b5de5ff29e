#pragma once

#include <vector>

#include "processes/structure_learner/structure_search.h"

namespace bodyschema {

/// The fallback of the search: between components of the forest where every screw model was refuted
/// on enough data, soft models; those with fewer signals first, then by score. What outliers cost
/// does not enter the score: a marker that flips says nothing about its neighbours. Rigid robots
/// never come here once their tree spans.
void connect_soft_parts(const std::vector<ActionPoseSample>& samples,
                        const NormalizedActions& actions, const std::vector<int>& parts,
                        const SearchOptions& options, SearchResult* found);

}  // namespace bodyschema
