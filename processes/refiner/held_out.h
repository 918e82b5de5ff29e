#pragma once

#include <map>
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

/// How many times as far off the poses of each part in the root's frame are as is told of them, by
/// the medians of their squared Mahalanobis distances (normalized estimation errors, NEES): by
/// Variance::kOneAction, and by the noise of the part and of the root, `noise_scale` times as told.
/// Parts of ten poses and more.
std::map<int, double> normalized_held_out_errors(const BodySchema& schema,
                                                 const std::vector<RefinerSample>& samples,
                                                 const MeasurementModel& measurement,
                                                 double noise_scale);

/// Sets position_rms_m and rotation_rms_rad of every edge both of whose parts are seen: what it
/// leaves of their poses, solved anew by the rig's tags and lens, of the inliers, for the degrees
/// of freedom that the edge took.
void set_residuals(const std::vector<RefinerSample>& samples, const RigCalibration& rig,
                   BodySchema* schema);

/// Is a model likelier than another by the corners of the same samples (is_likelier())?
bool predicts_corners_better(const HeldOutErrors& model, const HeldOutErrors& other);

}  // namespace bodyschema
