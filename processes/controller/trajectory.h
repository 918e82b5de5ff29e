#pragma once

#include <Eigen/Core>
#include <string>
#include <vector>

#include "common/schema/body_schema.h"
#include "processes/controller/inverse_kinematics.h"

namespace bodyschema {

/// Way points of a part in the root's frame, straight from each to the next in steps small enough
/// that what happens within one does not matter: each is a target of its own, at which the arm is
/// seen.
class Trajectory {
 public:
  /// What a trajectory must keep to by the schema.
  struct Limits {
    double position_sd_m = 0;  ///< of the part at a step, at most
    double error_m = 0, error_rad = 0;
    double off_line_m = 0;  ///< of the part within a step; the way to the first point is free
  };

  /// One step to the first way point; then straight lines in equal steps of at most `step_m` > 0,
  /// the rotation about one axis by at most 0.1 rad a step. All way points or none have an
  /// orientation.
  Trajectory(std::vector<PoseTarget> way_points, double step_m);

  std::size_t num_way_points() const { return legs_.size(); }
  /// The steps that end at way point n = 0, 1, …
  const std::vector<PoseTarget>& leg(std::size_t n) const { return legs_[n]; }

  /// "" or which step an arm at `action` cannot make, and why: every one is solved by the schema
  /// from the solution of the one before. `part` hangs on the root. @throws as solve_pose().
  std::string objection(const BodySchema& schema, int part, Eigen::VectorXd action,
                        const Limits& limits) const;

 private:
  std::vector<std::vector<PoseTarget>> legs_;
};

}  // namespace bodyschema
