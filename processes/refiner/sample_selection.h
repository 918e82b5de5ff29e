#pragma once

#include <optional>
#include <string>
#include <vector>

#include "processes/refiner/refine.h"

namespace bodyschema {

/// Samples of the body as the schema has it, ascending.
struct SampleSelection {
  std::vector<RefinerSample> training;  ///< to fit: TRAIN and PROBE
  std::vector<RefinerSample> held_out;  ///< TEST
  std::vector<std::string> left_out;    ///< what is not fitted, and why
};

/// Without what was seen of parts before an edge on their way was valid, of tags that had moved,
/// and, of those to fit, samples that repeat others or show nothing that can be fitted.
/// @throws std::invalid_argument for people: nothing to fit, corners missing that are asked for,
/// another rig, numbers that are not finite.
SampleSelection select_samples(const BodySchema& schema, std::vector<RefinerSample> samples,
                               const std::optional<RigCalibration>& rig,
                               const RefineOptions& options);

/// Of the first sample that tells it; 0: none does.
std::int64_t calibration_of(const std::vector<RefinerSample>& samples);

bool has_corners(const std::vector<RefinerSample>& samples);

}  // namespace bodyschema
