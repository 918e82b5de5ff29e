#pragma once

#include "processes/structure_learner/local_model.h"

namespace bodyschema {

/// A chain whose joints a second signal moves, too, as where a cable or a parallelogram leads over
/// another joint: beside a joint one about the same axis is tried for every other signal of the
/// chain, at first without effect, and the best is kept as long as it pays for its parameters
/// (Schwarz 1978) and, for a sight, more than half a nat. At most two, of which each costs
/// m (m − 1) fits of few iterations.
Fit with_coupled_joints(Fit fit, const PairData& pair, const NormalizedActions& actions);

/// The chain with one joint more, anywhere, about an axis of its own, that a signal of the chain
/// moves, too, as where one drive closes two joints of a finger; if that pays. 3 m (m + 1) fits of
/// few iterations.
Fit with_repeated_signal(Fit fit, const PairData& pair, const NormalizedActions& actions);

}  // namespace bodyschema
