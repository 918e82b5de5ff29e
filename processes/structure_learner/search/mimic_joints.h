#pragma once

#include "processes/structure_learner/search/pair_models.h"

namespace bodyschema {

/// Connects components between which a signal that moves nothing in the forest moves two joints
/// (URDF: mimic joints), with nothing seen between these: {a, a}, or with a joint of another such
/// signal {a, a, b} in any order. Of two components, the pairs of parts of which two joints of one
/// signal leave least are tried with three. A model stands only if no other signals of as many
/// joints explain its pair as well, and if neither joint of the signal is a Coupling. Not where a
/// bias that nobody told is assumed (SearchOptions::unknown_bias), nor for streams. True if any two
/// were connected.
bool connect_mimic_joints(PairModels* pairs, ModelForest* forest);

}  // namespace bodyschema
