#pragma once

#include <string>

#include "common/bus/channels.h"

namespace bodyschema {

// Problem of a well-formed message, for people, beginning with the field ("parts[3].X_CB.
// rotation_wxyz has norm 0.5, not 1"); "" if it makes sense. Problems: NaN, a quaternion that is
// not unit (1e-3), a covariance that is not positive semidefinite (up to rounding to float), ids
// that repeat or are out of order, counts beyond reason or unlike the length of their array, times
// before 0, an unknown constant, a string that is not UTF-8, edges that are no tree ordered from
// the root outwards. The bus calls check() before any handler; a message with a problem is dropped
// and counted as "senseless". publish() calls it too; there a problem is a bug.

std::string check(const action_command_t& message);
std::string check(const motion_status_t& message);
std::string check(const sim_state_t& message);
std::string check(const camera_image_t& message);
std::string check(const camera_info_t& message);
std::string check(const marker_poses_t& message);
std::string check(const sample_t& message);
std::string check(const body_schema_t& message);
std::string check(const model_health_t& message);
std::string check(const sample_request_t& message);
std::string check(const pose_target_t& message);
std::string check(const control_status_t& message);
std::string check(const fault_command_t& message);
std::string check(const process_info_t& message);

}  // namespace bodyschema
