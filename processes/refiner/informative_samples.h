#pragma once

#include <optional>
#include <vector>

#include "processes/refiner/refine.h"

namespace bodyschema {

/// At most options.config.max_samples of the samples, which are ascending: those between which the
/// others have equal parts of what all tell. A sample tells its leverage tr(A⁻¹ JᵀJ), with A the
/// information of evenly spaced samples at the schema's values, tags as they are claimed. One that
/// tells more than such a part is taken; of many that tell the same few are. Each is evaluated
/// once: linear in their number. @throws std::invalid_argument as RefinementProblem.
std::vector<RefinerSample> informative(std::vector<RefinerSample> samples, const BodySchema& schema,
                                       const std::optional<RigCalibration>& rig,
                                       const RefineOptions& options, bool root_moves);

}  // namespace bodyschema
