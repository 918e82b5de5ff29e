#include "tests/lcmtypes/example_messages.h"

#include "tests/lcmtypes/example_parts.h"

namespace bodyschema::test {

action_command_t example_action_command() {
  action_command_t message{};
  message.utime = 1'000'001;
  message.source = "motor_babbler";
  message.epoch = 77;
  message.action_id = 5;
  message.kind = action_command_t::KIND_MOVE;
  message.purpose = action_command_t::PURPOSE_TEST;
  message.expiry_utime = 3'000'000;
  fill(message.num_signals, message.action, {0.25, -0.5, 1.25});
  return message;
}

motion_status_t example_motion_status() {
  motion_status_t message{};
  message.utime = 1'000'002;
  message.source = "motor_babbler";
  message.epoch = 77;
  message.action_id = 5;
  message.kind = action_command_t::KIND_MOVE;
  message.purpose = action_command_t::PURPOSE_TEST;
  message.state = motion_status_t::STATE_REJECTED;
  message.reason = "joint 2 would hit the table (5°)";
  message.rest_since_utime = 900'000;
  message.stop_latched = 1;
  fill(message.num_signals, message.commanded, {0.25, -0.5, 1.25});
  return message;
}

sim_state_t example_sim_state() {
  sim_state_t message{};
  message.utime = 1'000'003;
  message.action_id = -1;
  message.seed = -42;
  message.is_ideal = 1;
  message.fault_epoch = 88;
  message.fault_id = 2;
  message.fault_answer = "no signal q9";
  fill(message.num_faults, message.faults, {"stuck q3", "tool 1"});
  message.X_WC = pose(1);
  fill(message.num_geoms, message.X_WG, {pose(2), pose(3), pose(4)});
  message.geom_alpha = {0, 0.5F, 1};
  fill(message.num_parts, message.true_part, {1, 7});
  message.X_WB = {pose(5), pose(6)};
  return message;
}

camera_image_t example_camera_image() {
  camera_image_t message{};
  message.utime = 1'000'004;
  message.image_seq = 8;
  message.camera_name = "ceiling";
  message.width = 40;
  message.height = 32;
  message.encoding = camera_image_t::ENCODING_GREY;
  std::vector<std::uint8_t> data(40 * 32);
  for (std::size_t i = 0; i < data.size(); ++i) data[i] = static_cast<std::uint8_t>(i * 7);
  fill(message.num_bytes, message.data, data);
  return message;
}

camera_info_t example_camera_info() {
  camera_info_t message{};
  message.utime = 1'000'005;
  message.camera_name = "ceiling";
  message.image_width = 1280;
  message.image_height = 960;
  message.fx = 1159.5;
  message.fy = 1160.5;
  message.cx = 639.5;
  message.cy = 479.5;
  message.distortion_model = camera_info_t::MODEL_PLUMB_BOB;
  fill(message.num_coefficients, message.distortion, {0.1, -0.2, 0.001, 0.002, 0.05});
  return message;
}

marker_poses_t example_marker_poses() {
  marker_poses_t message{};
  message.utime = 1'000'006;
  message.image_seq = 9;
  message.camera_name = "ceiling";
  message.calibration_id = 99;
  std::vector<marker_pose_t> markers;
  for (const int id : {4, 11}) {
    marker_pose_t& marker = markers.emplace_back();
    marker.marker_id = id;
    marker.size_m = 0.05;
    corners(marker.corner_px, id);
    corner_covariance(marker.corner_covariance);
    marker.num_hypotheses = 2;
    marker.X_CM[0] = pose(id);
    marker.X_CM[1] = pose(id + 1);
    marker.reprojection_error_px[0] = 0.2;
    marker.reprojection_error_px[1] = 0.9;
    covariance(marker.covariance);
    marker.decision_margin = 61.5;
    marker.hamming = 1;
  }
  fill(message.num_markers, message.markers, markers);
  return message;
}

sample_t example_sample() {
  sample_t message{};
  message.utime = 1'000'007;
  message.sample_index = 12;
  message.calibration_id = 99;
  message.source = "motor_babbler";
  message.epoch = 77;
  message.action_id = 5;
  message.purpose = action_command_t::PURPOSE_PROBE;
  message.rest_begin_utime = 900'000;
  message.rest_end_utime = 1'000'007;
  fill(message.num_signals, message.action, {0.25, -0.5});
  std::vector<part_observation_t> parts;
  for (const int id : {0, 3, 4}) {
    part_observation_t& part = parts.emplace_back();
    part.part_id = id;
    part.X_CB = pose(id);
    part.has_rotation = 1;
    covariance(part.covariance);
    part.has_other = id == 3 ? 1 : 0;
    part.X_CB_other = pose(id);
    if (id == 3) part.X_CB_other = pose(4);
    part.error_ratio = id == 3 ? 2.5 : 0;
    part.num_frames = 3;
    tag_corners_t tag{};
    tag.tag_id = 10 + id;
    corners(tag.mean_corner_px, id);
    corner_covariance(tag.corner_covariance);
    fill(part.num_tags, part.tags, {tag});
  }
  // Part 3 by tag 13, and otherwise by tag 14.
  parts.back().part_id = 3;
  fill(message.num_contradictions, message.contradictions, {parts.back()});
  parts.pop_back();
  fill(message.num_parts, message.parts, parts);
  return message;
}

sample_request_t example_sample_request() {
  sample_request_t message{};
  message.utime = 1'700'000'000'000'001;
  message.process_name = "model_monitor";
  message.first_missing = 3;
  message.last_missing = 9;
  return message;
}

pose_target_t example_pose_target() {
  pose_target_t message{};
  message.utime = 1'700'000'000'000'002;
  message.sender = "console";
  message.epoch = 1'700'000'000'000'000;
  message.target_id = 4;
  message.target_kind = pose_target_t::KIND_POSE;
  message.target_part = 9;
  message.position_m[0] = 0.3;
  message.position_m[1] = -0.1;
  message.position_m[2] = 0.7;
  message.orientation_wxyz[0] = 0.6;
  message.orientation_wxyz[3] = -0.8;
  message.tolerance_m = 0.002;
  message.tolerance_rad = 0.01;
  message.expiry_s = 60;
  message.keep_s = 2.5;
  message.way_point = 3;
  message.num_way_points = 20;
  return message;
}

control_status_t example_control_status() {
  control_status_t message{};
  message.utime = 1'000'010;
  message.sender = "console";
  message.target_epoch = 1'700'000'000'000'000;
  message.target_id = 4;
  message.control_state = control_status_t::CONTROL_REACHED;
  message.owns_arm = 1;
  message.why = "part 9 is there";
  message.schema_version = 50;
  message.target_part = 9;
  message.target_position_m[0] = 0.3;
  message.predicted_error_m = 0.0001;
  message.observed_error_m = -1;
  message.predicted_error_rad = 0.0002;
  message.observed_error_rad = -1;
  message.num_moves = 2;
  message.num_probes = 1;
  message.way_point = 3;
  message.num_way_points = 20;
  return message;
}

fault_command_t example_fault_command() {
  fault_command_t message{};
  message.utime = 1'700'000'000'000'003;
  message.sender = "console";
  message.epoch = 1'700'000'000'000'000;
  message.fault_id = 2;
  message.fault = fault_command_t::FAULT_BEND;
  message.place = "link4";
  message.number = -1;
  message.amount_deg = 45;
  return message;
}

process_info_t example_process_info() {
  process_info_t message{};
  message.utime = 1'700'000'000'000'000;
  message.process_name = "structure_learner";
  message.host = "lab3";
  message.pid = 4711;
  message.start_utime = 1'699'999'999'000'000;
  message.program_version = "0.1.0";
  message.seed = -1;
  message.phase = process_info_t::PHASE_WORKING;
  message.activity = "fits 12 pairs";
  message.configuration = "max_k: 3\n";
  message.cpu_us = 12'345'678;
  message.resident_bytes = 40'000'000;
  std::vector<counter_t> counters(2);
  counters[0].counter_name = "malformed SAMPLE";
  counters[0].count = 1;
  counters[1].counter_name = "received SAMPLE";
  counters[1].count = 99;
  fill(message.num_counters, message.counters, counters);
  return message;
}

}  // namespace bodyschema::test
