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

/// The rig with the problem's tags and lens.
RigCalibration refined_rig(RefinementProblem& problem, RigCalibration rig);

}  // namespace bodyschema
