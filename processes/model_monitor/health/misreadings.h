#pragma once

#include <map>
#include <vector>

#include "common/estimation/measurement_model.h"
#include "common/schema/body_schema.h"
#include "common/schema/sample.h"

namespace bodyschema {

/// Finds where a part's marker is misread from time to time, as one that rests flips to one and the
/// same second reading: three flips in a row would pass for a marker that moved. What was read at
/// one place twice, and each time where it belongs afterwards, is expected there again
/// (MeasurementModel::misread).
class Misreadings {
 public:
  /// Looks at the markers that `sample` shows; `schema` has them where they belong. Returns true if
  /// places() changed.
  bool look(const ActionPoseSample& sample, const BodySchema& schema,
            const MeasurementModel& measurement);
  /// By part: poses of its marker in its frame, misread.
  const std::map<int, std::vector<Pose>>& places() const { return places_; }
  /// The body is another: what was read since its parts were last where they belong was no
  /// misreading.
  void forget_open() { open_.clear(); }

 private:
  /// Newest places that are remembered of a part (chosen).
  static constexpr std::size_t kOnce = 16, kOften = 4;

  std::map<int, std::vector<Pose>> open_;  ///< since the part was last read where it belongs
  std::map<int, std::vector<Pose>> once_;
  std::map<int, std::vector<Pose>> places_;
};

}  // namespace bodyschema
