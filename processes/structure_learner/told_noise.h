#pragma once

#include <vector>

#include "common/estimation/measurement_model.h"
#include "common/schema/sample.h"

namespace bodyschema {

/// Some observation says how noisy it is.
bool has_covariances(const std::vector<ActionPoseSample>& samples);

/// Root mean squares per axis of what the observations say, rotations of those that have one; 0
/// without observations.
Noise typical_noise(const std::vector<ActionPoseSample>& samples);

}  // namespace bodyschema
