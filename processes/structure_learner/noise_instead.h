#pragma once

#include <optional>
#include <vector>

#include "processes/structure_learner/learn.h"

namespace bodyschema {

bool has_soft_edge(const SearchResult& search);

/// Where no screws connect the parts with the noise that is told, nor with multiples of it, or not
/// surely: the noise that the markers themselves show, where that refutes the told one.
std::optional<Noise> noise_instead(const LearnedStructure& by_told,
                                   const std::vector<ActionPoseSample>& samples,
                                   const LearnOptions& options);

}  // namespace bodyschema
