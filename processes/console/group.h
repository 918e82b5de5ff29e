#pragma once

#include <set>
#include <string>

namespace bodyschema {

/// The processes of a group that learns. Any driver may stand in for robot_simulator.
inline const std::set<std::string> kGroup = {
    "camera",        "controller", "marker_estimator", "model_monitor",
    "motor_babbler", "observer",   "robot_simulator",  "structure_learner"};

}  // namespace bodyschema
