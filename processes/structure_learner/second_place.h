#pragma once

#include "processes/structure_learner/edge_fit.h"

namespace bodyschema {

/// Whether at many of the edge's outliers its part keeps to one other place, on any part, beside
/// where the model has it, or where it would be with one link changed: an object that lies on the
/// table when it is not in the hand, a marker that rattles between two places, another marker that
/// is read for its own, a joint that is not recorded. Poses do not tell which of these is the body.
/// Tags that are read turned over are no other place, and nothing is said of a stream, where
/// outliers last.
bool keeps_to_second_place(const FittedEdge& fitted, const EdgeData& data);

}  // namespace bodyschema
