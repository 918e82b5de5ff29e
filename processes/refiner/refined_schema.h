#pragma once

#include <vector>

#include "processes/refiner/information.h"
#include "processes/refiner/refine.h"
#include "processes/refiner/refinement_problem.h"

namespace bodyschema {

/// The schema with the problem's values and their covariances, also what edges that meet at a part
/// have in common (BodySchema::frame_covariances), of their mean errors over `samples`.
BodySchema refined_schema(const BodySchema& start, const std::vector<RefinerSample>& samples,
                          RefinementProblem& problem, const Information& information);

/// ScrewJoint::scatter by the problem's plays; 0 of joints that have none.
void set_scatter(const RefinementProblem& problem, BodySchema* schema);

/// The rig with the problem's tags and lens.
RigCalibration refined_rig(RefinementProblem& problem, RigCalibration rig);

}  // namespace bodyschema
