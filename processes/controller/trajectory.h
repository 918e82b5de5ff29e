#pragma once

#include <Eigen/Core>
#include <functional>
#include <string>
#include <vector>

#include "common/schema/body_schema.h"
#include "processes/controller/inverse_kinematics.h"
#include "processes/controller/workspace.h"

namespace bodyschema {

/// Way points of a part in the root's frame, and steps straight from each to the next. Each step is
/// a target of its own, at which the arm is seen.
class Trajectory {
 public:
  /// What every step must keep to, by the schema.
  struct Limits {
    double position_sd_m = 0;           ///< of the part's position; what is unknown counts as 0
    double error_m = 0, error_rad = 0;  ///< of the solution, to the step
    double off_line_m = 0;  ///< of the part on its way; to the first way point it goes as it likes
    Workspace workspace = {};  ///< of all parts on their way
  };

  /// One step to the first way point; then straight lines in equal steps of at most `step_m`, the
  /// rotation about one axis by at most 0.1 rad a step. @throws std::invalid_argument if there is
  /// no way point, if some have an orientation and others none, unless step_m > 0, or if there are
  /// more than kMostSteps steps.
  Trajectory(const std::vector<PoseTarget>& way_points, double step_m);
  static constexpr std::size_t kMostSteps = 20'000;  ///< 400 m in steps of 20 mm

  std::size_t num_way_points() const { return legs_.size(); }
  /// The steps that end at way point n = 0, 1, …
  const std::vector<PoseTarget>& leg(std::size_t n) const { return legs_[n]; }

  /// "" or which step an arm at `action` cannot make, and why: every one is solved by the schema
  /// from the solution of the one before. `on_step` gets n before each step to way point n. @throws
  /// as solve_pose() and on_step.
  std::string objection(const BodySchema& schema, int part, const Eigen::VectorXd& action,
                        const Limits& limits,
                        const std::function<void(std::size_t n)>& on_step = nullptr) const;
  /// The same of leg `n` alone, from where the arm is before it.
  std::string objection_to_leg(std::size_t n, const BodySchema& schema, int part,
                               const Eigen::VectorXd& action, const Limits& limits) const;

 private:
  std::vector<std::vector<PoseTarget>> legs_;
};

}  // namespace bodyschema
