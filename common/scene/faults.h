#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <string>
#include <vector>

#include "bodyschema/fault_command_t.hpp"
#include "common/scene/scene.h"

namespace bodyschema {

// Faults of a simulated arm. A fault changes the scene's description, never its geoms' number or
// order, so the simulated camera shows it by SIM_STATE alone. Part poses X_WB stay the truth of the
// parts that learners find:
//   stuck          the signal's joints stay where they are
//   bend, drift    everything beyond the middle of the link is turned about the middle, parts too
//   tool           everything beyond the flange is displaced, parts too: X_WB of a part on the tool
//                  is the frame in which its tags sit at robot.yaml's X_BM, before and after
//   marker-lost    the plate lies on the floor, face up; X_WB unchanged
//   marker-moved   the plate sits 0.25 sides and 15° off in its plane; X_WB unchanged
//   camera-bump    X_WC is off by 20 … 30 mm and 1.5 … 2.5°; nothing else changes
//   target         no fault: a target tag floats elsewhere, facing as before

/// One fault.
struct Fault {
  std::int8_t kind = fault_command_t::FAULT_STUCK;  ///< fault_command_t::FAULT_*
  std::string place;                                ///< signal or link; "" where there is none
  int number = -1;                                  ///< tag or tool; -1 where there is none
  double amount_deg = 0;                            ///< bend [deg], drift [deg per action]
  double bent_deg = 0;                              ///< drift: so far [deg]
  /// Lost marker: x, y [m] of the marker's frame in the world and yaw [rad] of its x axis.
  Eigen::Vector3d fallen = Eigen::Vector3d::Zero();
  /// Target: the tag's centre in the frame of the camera as built [m].
  Eigen::Vector3d target_m = Eigen::Vector3d::Zero();
};

/// For people: "stuck q3", "bend forearm 5 deg".
std::string describe(const Fault& fault, const SceneDescription& as_built);

/// Adds the fault of `command` to `faults`; FAULT_REPAIR removes all. `scene` and `data` are the
/// arm as it is now. Returns "" or the reason of a refusal, naming the choices; `faults` is then
/// unchanged.
std::string add_fault(const fault_command_t& command, const Scene& scene, const mjData& data,
                      std::vector<Fault>& faults);

/// Advances every drift by one action. False if nothing drifts.
bool drift(std::vector<Fault>& faults);

/// The broken scene: a function of its arguments. Stuck joints are stuck at `joint_positions`
/// [rad or m]; bumps of the camera are drawn from `seed`.
SceneDescription broken(const SceneDescription& as_built, const std::vector<Fault>& faults,
                        const Eigen::VectorXd& joint_positions, std::int64_t seed);

}  // namespace bodyschema
