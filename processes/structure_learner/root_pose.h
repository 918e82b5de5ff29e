#pragma once

#include <vector>

#include "common/estimation/measurement_model.h"

namespace bodyschema {

/// Share of the variance of a marker's noise that near-identical views have in common: SAMPLE tells
/// one frame's covariance for the mean of two. None where no systematic error is told either.
double view_share(const MeasurementModel& measurement);

/// X_CR of `schema` with its covariance: the robust mean of the poses of its root, Student-t
/// weights. What is off of a tag counts twice where it is seen once, and once where it is seen
/// often: the covariance errs to the large side. Left alone if the root is never seen.
void estimate_root_pose(const std::vector<ActionPoseSample>& samples,
                        const MeasurementModel& measurement, BodySchema* schema);

}  // namespace bodyschema
