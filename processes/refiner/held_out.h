#pragma once

#include <optional>
#include <vector>

#include "processes/refiner/refine.h"

namespace bodyschema {

/// Errors of a schema's predictions on samples that it was not fitted to. With corners and a rig
/// the observed poses are solved anew, by the rig's tags and lens, from the tags that the observed
/// poses rest on; and the predicted corners are compared with those seen.
HeldOutErrors held_out_errors(const BodySchema& schema, const std::vector<RefinerSample>& samples,
                              const std::optional<RigCalibration>& rig);

}  // namespace bodyschema
