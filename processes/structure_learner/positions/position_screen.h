#pragma once

#include <vector>

#include "processes/structure_learner/screen.h"

namespace bodyschema {

/// Starts of models with `num_joints` joints (at most two) for a pair whose part j has positions
/// alone, best first.
///
/// With the turn of each joint from a grid a position is linear in products of 1, cos and sin of
/// the turns (1 and q of a sliding joint). That regression finds signals and turns. In it the
/// motion by the joint nearer to part i is a circle about one direction, which a singular value
/// decomposition tells; given that axis the position is linear in what the other joint does, whose
/// circle tells the rest. The frame of part j, whose rotation no position tells, is turned as the
/// last joint's. Adds the number of regressions to `num_screens`.
std::vector<Start> position_starts(const PairData& pair, const NormalizedActions& actions,
                                   int num_joints, int* num_screens);

}  // namespace bodyschema
