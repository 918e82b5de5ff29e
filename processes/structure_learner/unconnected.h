#pragma once

#include <set>
#include <vector>

#include "common/schema/body_schema.h"
#include "common/schema/sample.h"
#include "processes/structure_learner/edge_fit.h"
#include "processes/structure_learner/learn.h"

namespace bodyschema {

/// Why `part`, which was seen in `samples`, is not `connected` to the root, and what would help.
/// `refused`: what became of the structure's edges. `max_signals`: of the models that were tried.
UnconnectedPart explain_unconnected(int part, const std::vector<ActionPoseSample>& samples,
                                    const std::set<int>& connected,
                                    const LearnedStructure& structure, const Refusals& refused,
                                    int max_signals);

/// Signals that no edge uses although one may have to: they moved too little for a joint of
/// kLeastTurn (over their limits, where these are known) to show, a part waits for its edge, or the
/// edges leave more than the markers' noise, which may be theirs: `is_body_left`. And those that a
/// soft edge may use in vain.
std::vector<int> undecided_signals(const BodySchema& schema, const LearnedStructure& structure,
                                   bool is_body_left);

}  // namespace bodyschema
