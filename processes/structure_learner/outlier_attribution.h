#pragma once

#include <cstdint>
#include <vector>

#include "processes/structure_learner/edge_fit.h"

namespace bodyschema {

/// A pose that disagrees with the rest of the learned schema.
struct Outlier {
  std::int64_t sample_index = 0;
  int part = 0;
};

/// Which part is to blame where edges disagree with the data at one instant; ascending by sample,
/// then part.
///
/// A part that is outlying in most of its edges is the culprit; its edges then speak no longer.
/// Ties (an edge between two parts that nothing else judges) go by the other visible parts: the one
/// that disagrees with more of them along the tree; then the one farther from the root.
std::vector<Outlier> attribute_outliers(const BodySchema& schema,
                                        const std::vector<FittedEdge>& edges,
                                        const std::vector<ActionPoseSample>& samples,
                                        const MeasurementModel& measurement);

}  // namespace bodyschema
