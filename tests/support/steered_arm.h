#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <filesystem>
#include <optional>
#include <vector>

#include "processes/controller/controller.h"
#include "processes/model_monitor/model_monitor.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema::test {

/// A synthetic arm that class Controller steers, message by message and without a bus: its driver,
/// its camera, observer and model monitor. It moves when it is told to, at once.
class SteeredArm {
 public:
  struct Options {
    Regime regime = Regime::kTag;
    bool adapts = true;       ///< else the schema stays as it was
    int max_corrections = 0;  ///< by what is seen at a target's end
    double tolerance_m = 0;   ///< of targets; 0: as controller.yaml says
    std::uint64_t seed = 1;
  };
  /// How a target ended.
  struct Arrival {
    control_status_t status;
    double error_m = 0;  ///< from the part's true place to the target
  };

  /// Begins with `schema`; `rig` has a controller.yaml and a model_monitor.yaml.
  SteeredArm(SyntheticRobot robot, const BodySchema& schema, const std::filesystem::path& rig,
             const Options& options);

  /// From now on the arm is another.
  void set_robot(SyntheticRobot robot) { robot_ = std::move(robot); }
  /// Serves one target [m, root's frame] until it is reached, refused or held.
  /// The target is way point `way_point` of so many on a straight path; 0: of none.
  Arrival go_to(int part, const Eigen::Vector3d& p_RT, int way_point = 0, int num_way_points = 0);
  /// The same with a target tag there, which each rest shows in two frames with the regime's noise.
  Arrival go_to_tag(int part, const Eigen::Vector3d& p_RT);
  /// By the truth [m, root's frame].
  Eigen::Vector3d position(int part) const;
  /// Commands so far.
  const std::vector<action_command_t>& moves() const { return moves_; }
  const model_health_t& health() const { return monitor_.health(); }

 private:
  Arrival serve(pose_target_t target, const Eigen::Vector3d& p_RT);
  void show_tag();
  void take(const Controller::Answer& answer);
  void tell();
  void serve(const action_command_t& command);

  SyntheticRobot robot_;
  const Options options_;
  Rng rng_;
  Controller controller_;
  ModelMonitor monitor_;
  const body_schema_t first_schema_;
  Eigen::VectorXd position_;
  motion_status_t motion_{};
  control_status_t status_{};
  std::vector<action_command_t> moves_, unanswered_;
  std::optional<Eigen::Vector3d> p_RM_;  ///< target tag
  std::int64_t now_us_ = 0, num_samples_ = 0, num_targets_ = 0;
};

}  // namespace bodyschema::test
