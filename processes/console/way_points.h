#pragma once

#include <stdexcept>
#include <string>
#include <vector>

#include "processes/controller/inverse_kinematics.h"

namespace bodyschema {

struct WayPointError : std::runtime_error {
  using std::runtime_error::runtime_error;
};

/// Reads a CSV with the header x,y,z or x,y,z,qw,qx,qy,qz: a position [m] a line, or a pose, in the
/// root's frame. Empty lines count for nothing. `name` stands in errors. @throws WayPointError.
std::vector<PoseTarget> parse_way_points(const std::string& text, const std::string& name);

/// The straight line from `from` to `to`, without `from`, in equal steps of at most `step_m`; the
/// rotation turns about one axis, at most 0.1 rad a step. Both or none have an orientation.
std::vector<PoseTarget> straight_line(const PoseTarget& from, const PoseTarget& to, double step_m);

/// How far `part` leaves the line to `end` where all signals move evenly from one action to
/// another, looked at in three places [m, in the root's frame]. The part hangs on the root.
double leaves_line_by_m(const BodySchema& schema, int part, const Eigen::VectorXd& from,
                        const Eigen::VectorXd& to, const Eigen::Vector3d& end);

}  // namespace bodyschema
