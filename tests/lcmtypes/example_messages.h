#pragma once

#include "common/bus/channels.h"

namespace bodyschema::test {

// A message of every type that travels on a channel, with every array filled and every field
// distinct where it can be; all of them pass check().

action_command_t example_action_command();
motion_status_t example_motion_status();
sim_state_t example_sim_state();
camera_image_t example_camera_image();
camera_info_t example_camera_info();
marker_poses_t example_marker_poses();
sample_t example_sample();
body_schema_t example_body_schema();
model_health_t example_model_health();
sample_request_t example_sample_request();
pose_target_t example_pose_target();
control_status_t example_control_status();
fault_command_t example_fault_command();
process_info_t example_process_info();

/// A chain of `num_parts` parts; each edge has one joint, of the one signal.
body_schema_t large_schema(int num_parts);

/// Calls visit(channel, example message) for every channel.
template <class Visit>
void for_each_channel(Visit visit) {
  visit(kActionCommand, example_action_command());
  visit(kMotionStatus, example_motion_status());
  visit(kSimState, example_sim_state());
  visit(kCameraImage, example_camera_image());
  visit(kCameraInfo, example_camera_info());
  visit(kMarkerPoses, example_marker_poses());
  visit(kSample, example_sample());
  visit(kLearnedSchema, example_body_schema());
  visit(kRefinedSchema, example_body_schema());
  visit(kBodySchema, example_body_schema());
  visit(kModelHealth, example_model_health());
  visit(kSampleRequest, example_sample_request());
  visit(kPoseTarget, example_pose_target());
  visit(kControlStatus, example_control_status());
  visit(kFaultCommand, example_fault_command());
  visit(kProcessInfo, example_process_info());
}

}  // namespace bodyschema::test
