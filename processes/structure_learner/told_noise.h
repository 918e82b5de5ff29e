#pragma once

#include <set>
#include <vector>

#include "common/estimation/measurement_model.h"
#include "common/schema/sample.h"

namespace bodyschema {

/// Some observation says how noisy it is.
bool has_covariances(const std::vector<ActionPoseSample>& samples);

/// Root mean squares per axis of what the observations say, rotations of those that have one; 0
/// without observations.
Noise typical_noise(const std::vector<ActionPoseSample>& samples);

/// The parts whose pose is the same to the last bit in all samples, three at least: they are the
/// frame that the others are given in. What they may be off by never changes, and is no noise.
std::set<int> fixed_parts(const std::vector<ActionPoseSample>& samples);

}  // namespace bodyschema
