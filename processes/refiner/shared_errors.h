#pragma once

#include <Eigen/Core>
#include <utility>
#include <vector>

#include "processes/refiner/refinement_problem.h"

namespace bodyschema {

/// What an observed pose has in common with others, in units of its residuals: number of the error
/// that they share, and 6×k, what one standard deviation of each of its k components does.
using SharedError = std::pair<int, Eigen::MatrixXd>;

/// Errors of poses that no number of samples averages out, by datum: those of a tag, at all its
/// sights; of near-identical views of a part their systematic error, and a share of their noise.
/// Empty where corners were fitted, whose tags and lens are parameters.
std::vector<std::vector<SharedError>> shared_errors(RefinementProblem& problem,
                                                    const MeasurementModel& measurement);

}  // namespace bodyschema
