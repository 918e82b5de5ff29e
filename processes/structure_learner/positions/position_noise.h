#pragma once

#include <optional>
#include <set>
#include <vector>

#include "processes/structure_learner/noise_estimate.h"
#include "processes/structure_learner/validity.h"

namespace bodyschema {

/// The noise of a part that has poses and rests, from how they scatter. std::nullopt if it moves:
/// the scatter is larger than noise, or goes along with a signal.
std::optional<Noise> noise_at_rest(const std::vector<ActionPoseSample>& samples, int part,
                                   const NormalizedActions& actions,
                                   const ValidityOptions& options);

/// The noise of positions, for data that bring none, as estimate_noise() has it of poses: from
/// repeats, else from what the best models leave. Of the parts with poses `resting` rest.
/// std::nullopt if neither tells: too few data, or what is left is more than noise.
std::optional<SourcedNoise> estimate_position_noise(const std::vector<ActionPoseSample>& samples,
                                                    const NormalizedActions& actions, int root,
                                                    const std::set<int>& resting);

}  // namespace bodyschema
