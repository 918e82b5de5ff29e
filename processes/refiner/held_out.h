#pragma once

#include <optional>
#include <vector>

#include "processes/refiner/refine.h"

namespace bodyschema {

/// Errors of a schema's predictions on samples that it was not fitted to. With corners and a rig
/// the observed poses are solved anew, by the rig's tags and lens, from the tags that the observed
/// poses rest on; and the predicted corners are compared with those seen. `corner_noise`: of
/// corners without a covariance of their own.
HeldOutErrors held_out_errors(const BodySchema& schema, const std::vector<RefinerSample>& samples,
                              const std::optional<RigCalibration>& rig,
                              const CornerNoise& corner_noise);

/// Are the corners of more of the same samples likelier by a model than by another, and of so many
/// more that chance does it in 2 % at most (sign test)? A sample counts once: what its corners have
/// in common, the play of joints, is one draw. Never below six samples.
bool predicts_corners_better(const HeldOutErrors& model, const HeldOutErrors& other);

}  // namespace bodyschema
