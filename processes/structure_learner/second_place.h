#pragma once

#include <vector>

#include "processes/structure_learner/edge_fit.h"

namespace bodyschema {

/// Whether at many of the edge's outliers its part keeps to one other place, on any part, beside
/// where the model has it, or where it would be with one link changed: an object that lies on the
/// table when it is not in the hand, a marker that rattles between two places, another marker that
/// is read for its own, a joint that is not recorded. Poses do not tell which of these is the body.
/// Tags that are read turned over are no other place, and nothing is said of a stream, where
/// outliers last. `before`: all edges fitted so far; where that to its first part has a sample
/// right, or that part is where it rests, its tag is not turned over there.
bool keeps_to_second_place(const FittedEdge& fitted, const EdgeData& data,
                           const std::vector<FittedEdge>& before);

}  // namespace bodyschema
