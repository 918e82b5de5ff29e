#pragma once

#include <string>
#include <vector>

#include "processes/refiner/refine.h"
#include "processes/refiner/refinement_problem.h"

namespace bodyschema {

/// Why a solved fit is not to be trusted, in words. `outliers`: all.
std::vector<std::string> warnings_of_fit(RefinementProblem& problem,
                                         const std::vector<RefinementOutlier>& outliers,
                                         const std::vector<SignalCoverage>& coverage);

/// Why an answer is not, beside the fit: joints whose axes are others than those of `start`, and
/// held-out samples.
std::vector<std::string> warnings_of_answer(const BodySchema& start, const Refinement& answer,
                                            const std::vector<RefinerSample>& held_out,
                                            const MeasurementModel& measurement);

}  // namespace bodyschema
