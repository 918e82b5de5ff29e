#pragma once

#include <cmath>

namespace bodyschema {

/// In radians: 30 * kDegree is an angle, angle / kDegree a number for people.
inline constexpr double kDegree = M_PI / 180;

}  // namespace bodyschema
