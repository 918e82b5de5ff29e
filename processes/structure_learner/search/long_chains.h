#pragma once

#include <cstddef>
#include <map>
#include <optional>
#include <utility>
#include <vector>

#include "processes/structure_learner/search/pair_models.h"

namespace bodyschema {

/// Components that lie apart and are searched for chains of more than two joints. More gaps have
/// another reason than hidden parts: the noise told, or soft parts.
inline constexpr std::size_t kMaxChainedComponents = 6;

using Pair = std::pair<int, int>;  ///< two parts, or two components, the lower one first

/// The pairs of parts that were seen together and that the forest does not connect, by their
/// components.
std::map<Pair, std::vector<Pair>> pairs_between_components(PairModels* pairs,
                                                           const ModelForest& forest);

/// A chain on `signals`, valid by the pair's own data, without the joints that do not pay and in
/// the order that the poses prefer; where that is unknown, or `may_be_coupled`, a second signal may
/// move a joint, too (with_coupled_joints()). `cost`: what it leaves a frame; infinite if there are
/// too few frames to fit it, which is noted.
std::optional<Candidate> chain_between(const Pair& ij, const std::vector<int>& signals,
                                       JointOrder order, PairModels* pairs, double* cost,
                                       bool may_be_coupled = false);

/// Of many hypotheses one fits by chance unless the least joint that is looked for would show by
/// far. Chosen: at 17 poses that is 24 σ of tags, 5 σ of the chapter's noise, where it is wrong as
/// often as right.
bool shows_any_joint(const Pair& ij, PairModels* pairs);

/// Adds what holds on all data of its pair, in the order given, to a forest that does not connect
/// it yet; but not where a Gaussian process describes the pair better. True if any was added.
bool add_chains(std::vector<Candidate> chains, PairModels* pairs, ModelForest* forest);

/// Connects components that no model of up to two joints connects by chains of any number of
/// joints: on the signals that move nothing in the forest, then on these and one of those that do,
/// then on all; where they are too many to be one chain, on none. Of the pairs between two
/// components the chain with the fewest joints. True if any two were connected. A chain needs
/// kPosesPerJoint independent poses a joint: fewer are noted as too few data.
bool connect_long_chains(PairModels* pairs, ModelForest* forest);

/// The chain, or a better one of its signals in another order. Each signal has one joint.
Candidate with_searched_order(const Candidate& chain, PairModels* pairs);

}  // namespace bodyschema
