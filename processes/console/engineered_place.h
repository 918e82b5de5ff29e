#pragma once

#include "common/schema/body_schema.h"
#include "processes/structure_learner/recording/recording.h"

namespace bodyschema {

/// Completes an engineered model by a recording: X_CR, calibration_id and position_parts. X_CR is
/// the robust mean of the root's poses (estimate_root_pose()); where these are never seen, the best
/// fit of all parts, without a covariance: it defines the root's frame.
/// @throws std::runtime_error if the recording does not tell how the camera stands.
void place_in_camera(const Recording& recording, BodySchema* schema);

}  // namespace bodyschema
