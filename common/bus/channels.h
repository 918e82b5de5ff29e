#pragma once

#include "bodyschema/action_command_t.hpp"
#include "bodyschema/body_schema_t.hpp"
#include "bodyschema/camera_image_t.hpp"
#include "bodyschema/camera_info_t.hpp"
#include "bodyschema/control_status_t.hpp"
#include "bodyschema/fault_command_t.hpp"
#include "bodyschema/marker_poses_t.hpp"
#include "bodyschema/model_health_t.hpp"
#include "bodyschema/motion_status_t.hpp"
#include "bodyschema/pose_target_t.hpp"
#include "bodyschema/process_info_t.hpp"
#include "bodyschema/sample_request_t.hpp"
#include "bodyschema/sample_t.hpp"
#include "bodyschema/sim_state_t.hpp"

namespace bodyschema {

/// A channel and the one type that travels on it. The table in lcmtypes/README.md lists the same.
template <class Message>
struct Channel {
  const char* name;
};

inline constexpr Channel<action_command_t> kActionCommand{"ACTION_COMMAND"};
inline constexpr Channel<motion_status_t> kMotionStatus{"MOTION_STATUS"};
inline constexpr Channel<sim_state_t> kSimState{"SIM_STATE"};
inline constexpr Channel<camera_image_t> kCameraImage{"CAMERA_IMAGE"};
inline constexpr Channel<camera_info_t> kCameraInfo{"CAMERA_INFO"};
inline constexpr Channel<marker_poses_t> kMarkerPoses{"MARKER_POSES"};
inline constexpr Channel<sample_t> kSample{"SAMPLE"};
inline constexpr Channel<sample_request_t> kSampleRequest{"SAMPLE_REQUEST"};
inline constexpr Channel<body_schema_t> kLearnedSchema{"LEARNED_SCHEMA"};
inline constexpr Channel<body_schema_t> kRefinedSchema{"REFINED_SCHEMA"};
inline constexpr Channel<body_schema_t> kBodySchema{"BODY_SCHEMA"};
inline constexpr Channel<model_health_t> kModelHealth{"MODEL_HEALTH"};
inline constexpr Channel<pose_target_t> kPoseTarget{"POSE_TARGET"};
inline constexpr Channel<control_status_t> kControlStatus{"CONTROL_STATUS"};
inline constexpr Channel<fault_command_t> kFaultCommand{"FAULT_COMMAND"};
inline constexpr Channel<process_info_t> kProcessInfo{"PROCESS_INFO"};

}  // namespace bodyschema
