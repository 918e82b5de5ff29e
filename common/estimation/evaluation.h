#pragma once

#include <map>
#include <optional>
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
  bool has_rotation = true;  ///< else positions alone were seen: no errors of the rotation
  double rotation_median_rad = 0;
  double rotation_rms_rad = 0;
};

/// Differences between a schema and the truth without an error of the kinematics: where tags that
/// are not where the rig says put the frames of the parts, and how long their printed sides and the
/// focal length make a metre. The true pose of part B in root R is X_RS · (scaled prediction) ·
/// X_PB.
struct Alignment {
  double scale = 1;              ///< true length per predicted length
  Pose X_RS = Pose::Identity();  ///< the schema's frame of the root, in the true one
  std::map<int, Pose> X_PB;      ///< the true frame of each part, in the schema's

  /// The true pose that a prediction X_SP of `part` stands for.
  Pose aligned(int part, const Pose& X_SP) const;
};

/// Least squares over all parts of all samples, 1 mm against 0.1°; what they leave open stays near
/// the identity. std::nullopt where fewer than kMinAligned samples have the root, which cannot tell
/// a frame from an error. @throws as evaluate().
std::optional<Alignment> align(const BodySchema& schema,
                               const std::vector<ActionPoseSample>& samples);
inline constexpr int kMinAligned = 5;  // chosen: of 30 residuals a part some 6 are spent

/// Predicted against observed pose of every part that the schema connects to its root, the root
/// itself left out. @throws std::invalid_argument if the actions do not fit the schema's signals.
std::vector<PartErrors> evaluate(const BodySchema& schema,
                                 const std::vector<ActionPoseSample>& samples,
                                 const Alignment& alignment = {});

/// Errors as they are, and beside them those after an alignment.
struct JudgedErrors {
  std::vector<PartErrors> parts;
  std::optional<Alignment> alignment;
  std::vector<PartErrors> aligned_parts;  ///< as parts; empty without an alignment
};

/// `held_out` are judged; the alignment is made on `truth`, true poses of any actions.
JudgedErrors judge(const BodySchema& schema, const std::vector<ActionPoseSample>& held_out,
                   const std::vector<ActionPoseSample>& truth);

}  // namespace bodyschema
