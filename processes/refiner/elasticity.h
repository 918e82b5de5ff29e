#pragma once

#include <optional>
#include <vector>

#include "processes/refiner/refinement_problem.h"

namespace bodyschema {

/// "q5 (5→6)"
std::string joint_name(const BodySchema& schema, const Edge& edge, const ScrewJoint& joint);

/// Fits compliances and the geometry together, beginning with the schema that was fitted with stiff
/// joints. `stiff`: the problem of that. Nothing if no joint's load changes.
std::optional<Elasticity> fit_elasticity(const BodySchema& schema,
                                         const std::vector<RefinerSample>& training,
                                         const std::vector<RefinerSample>& held_out,
                                         const RefineOptions& options, RefinementProblem& stiff);

}  // namespace bodyschema
