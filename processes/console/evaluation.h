#pragma once

#include <vector>

#include "common/schema/body_schema.h"
#include "common/schema/sample.h"

namespace bodyschema {

/// How well a schema predicts one part relative to the root.
struct PartErrors {
  int part = 0;
  int count = 0;  ///< instants in which root and part were seen; the rest is 0 if this is
  double position_median_m = 0;
  double position_rms_m = 0;
  double position_max_m = 0;
  double rotation_median_rad = 0;
  double rotation_rms_rad = 0;
};

/// Predicted against observed pose of every part that the schema connects to its root, the root
/// itself left out. @throws std::invalid_argument if the actions do not fit the schema's signals.
std::vector<PartErrors> evaluate(const BodySchema& schema,
                                 const std::vector<ActionPoseSample>& samples);

}  // namespace bodyschema
