#pragma once

#include <Eigen/Geometry>

#include "common/schema/body_schema.h"

namespace bodyschema {

/// The smallest box along the axes of the root's frame R that holds the origin of `part` at every
/// action within the signals' limits [m], by the schema. Each side is a maximum found by pattern
/// search (Hooke and Jeeves 1961) from the ten farthest of 1000 fixed actions, so that the box may
/// be too small, but never too large. Not all of it can be reached. Empty if the part has no way to
/// the root. Deterministic; about 30 ms.
Eigen::AlignedBox3d reachable_box(const BodySchema& schema, int part);

}  // namespace bodyschema
