#pragma once

#include <vector>

#include "common/schema/sample.h"

namespace bodyschema {

/// The signals of a stream that are the rates of others, as recordings have joint velocities beside
/// positions: what one sums up to over some samples is in proportion to what the other moves by.
/// Poses that come late look like joints that a signal and its rate move. Ascending; none of poses
/// at rest and of samples that are not in the order of their times. O(D² N) for D signals.
std::vector<int> rates_of_others(const std::vector<ActionPoseSample>& samples, int num_signals);

/// As if these signals had not moved.
std::vector<ActionPoseSample> held_still(std::vector<ActionPoseSample> samples,
                                         const std::vector<int>& signals);

}  // namespace bodyschema
