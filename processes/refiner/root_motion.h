#pragma once

#include <cstdint>
#include <optional>
#include <vector>

#include "processes/refiner/refine.h"

namespace bodyschema {

/// How the root stands in the camera's frame over samples.
struct RootMotion {
  bool moves = false;  ///< it needs a pose at every sample
  /// The sample from which on it was seen elsewhere, if there is one: the camera moved, or, where
  /// the other parts did not go with it, its marker.
  std::optional<std::int64_t> step;
};

/// Where the root's poses differ: whether a pose of it at every sample is worth its parameters
/// (Schwarz 1978), with the noise as large as either fit leaves; told too small, a root that rests
/// differs, too, but the other parts do not go with it. Where it was seen elsewhere from a sample
/// on, two poses are all that there are, and one at every sample may gain chance alone, with a
/// margin. @throws std::invalid_argument as RefinementProblem.
RootMotion root_motion(const BodySchema& schema, const std::vector<RefinerSample>& samples,
                       const std::optional<RigCalibration>& rig, const RefineOptions& options);

}  // namespace bodyschema
