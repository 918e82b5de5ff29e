#pragma once

#include <cstdint>
#include <map>
#include <optional>

#include "common/estimation/measurement_model.h"
#include "common/schema/sample.h"

namespace bodyschema {

/// Finds markers that fell off their parts and lie in sight: read at one place again and again
/// while the part that they were on moves; of several tags of a part each at its own. (A joint that
/// is stuck holds a part still as well, but where the schema has it at some action.)
class FallenMarkers {
 public:
  /// Looks at what the sample shows of `part`. Returns the first sample that showed its marker
  /// where it lies; std::nullopt while it does not. `X_CB` is where the schema has the part.
  std::optional<std::int64_t> look(const ActionPoseSample& sample, int part, const Pose& X_CB,
                                   const MeasurementModel& measurement);

 private:
  struct Sighting {
    std::int64_t since = 0;
    int num_repeated = 0;  ///< readings of the same pose after a motion of the part
    Pose seen, predicted;
  };
  /// By part and tag (−1: not known): seen where it should not be.
  std::map<int, std::map<int, Sighting>> far_off_;
};

}  // namespace bodyschema
