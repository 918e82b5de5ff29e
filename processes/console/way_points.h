#pragma once

#include <stdexcept>
#include <string>
#include <vector>

#include "processes/controller/inverse_kinematics.h"

namespace bodyschema {

inline constexpr double kFarthestTarget_m = 1000;  ///< per coordinate: what POSE_TARGET carries

struct WayPointError : std::runtime_error {
  using std::runtime_error::runtime_error;
};

/// Reads a CSV with the header x,y,z or x,y,z,qw,qx,qy,qz: a position [m] a line, or a pose, in the
/// root's frame. Empty lines count for nothing. `name` stands in errors. @throws WayPointError.
std::vector<PoseTarget> parse_way_points(const std::string& text, const std::string& name);

}  // namespace bodyschema
