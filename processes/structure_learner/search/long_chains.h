#pragma once

#include <cstddef>

#include "processes/structure_learner/search/pair_models.h"

namespace bodyschema {

/// Components that lie apart and are searched for chains of more than two joints. More gaps have
/// another reason than hidden parts: the noise told, or soft parts.
inline constexpr std::size_t kMaxChainedComponents = 6;

/// Connects components that no model of up to two joints connects by chains of any number of
/// joints: on the signals that move nothing in the forest, then on these and one of those that do,
/// then on all; where they are too many to be one chain, on none. Of the pairs between two
/// components the chain with the fewest joints. True if any two were connected. A chain needs
/// kPosesPerJoint independent poses a joint: fewer are noted as too few data.
bool connect_long_chains(PairModels* pairs, ModelForest* forest);

/// The chain, or a better one of its signals in another order. Each signal has one joint.
Candidate with_searched_order(const Candidate& chain, PairModels* pairs);

}  // namespace bodyschema
