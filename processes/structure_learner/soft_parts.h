#pragma once

#include <vector>

#include "processes/structure_learner/structure_search.h"

namespace bodyschema {

/// The fallback of the search: soft models between components of the forest where every screw model
/// was refuted on enough data, those of the best score first. What outliers cost does not enter the
/// score: a marker that flips says nothing about its neighbours. Poses at rest never come here once
/// their tree spans. Where their noise is a guess, a process of other signals than those of the
/// fewest joints that could be all there is between the two components must leave at most
/// kExplained of what the best screws leave, else both are possible (PairRecord::contested). Of a
/// stream, screws give way first where a process on other signals leaves at most kExplained of what
/// they leave (SearchResult::gave_way).
void connect_soft_parts(const std::vector<ActionPoseSample>& samples,
                        const NormalizedActions& actions, const std::vector<int>& parts,
                        const SearchOptions& options, bool is_noise_guessed, SearchResult* found);

}  // namespace bodyschema
