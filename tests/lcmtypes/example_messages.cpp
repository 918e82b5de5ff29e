#include "tests/lcmtypes/example_messages.h"

#include <cmath>
#include <utility>
#include <vector>

namespace bodyschema::test {
namespace {

template <class Count, class Element>
void fill(Count& count, std::vector<Element>& array, std::vector<Element> values) {
  count = static_cast<Count>(values.size());
  array = std::move(values);
}

/// A pose that differs from number to number.
pose_t pose(int number) {
  const double angle = 0.3 + 0.1 * number;
  pose_t X{};
  X.position_m[0] = 0.01 * number + 0.1;
  X.position_m[1] = -0.02 * number;
  X.position_m[2] = 1.5;
  X.rotation_wxyz[0] = std::cos(angle / 2);
  X.rotation_wxyz[1] = 0.6 * std::sin(angle / 2);
  X.rotation_wxyz[3] = 0.8 * std::sin(angle / 2);
  return X;
}

/// B Bᵀ with B = 1e-3 (identity + a little everywhere).
void covariance(float (&wire)[21]) {
  for (int i = 0, n = 0; i < 6; ++i) {
    for (int j = 0; j <= i; ++j, ++n) {
      double sum = 0;
      for (int k = 0; k < 6; ++k)
        sum += 1e-6 * ((i == k) + 0.02 * (i + k)) * ((j == k) + 0.02 * (j + k));
      wire[n] = static_cast<float>(sum);
    }
  }
}

void corner_covariance(float (&wire)[36]) {
  for (int i = 0; i < 8; ++i) wire[i * (i + 3) / 2] = 0.0025F;
}

void corners(double (&wire)[4][2], double offset) {
  const double unit[4][2] = {{-1, 1}, {1, 1}, {1, -1}, {-1, -1}};
  for (int i = 0; i < 4; ++i) {
    wire[i][0] = 320 + offset + 20 * unit[i][0];
    wire[i][1] = 240 - offset + 20 * unit[i][1];
  }
}

schema_edge_t edge(int from, int to, int num_joints) {
  schema_edge_t edge{};
  edge.from_part = from;
  edge.to_part = to;
  edge.base_kind = num_joints == 0 ? schema_edge_t::EDGE_RIGID : schema_edge_t::EDGE_SCREW;
  edge.X_left = pose(to);
  std::vector<screw_joint_t> joints;
  for (int n = 0; n < num_joints; ++n) {
    screw_joint_t& joint = joints.emplace_back();
    joint.signal_index = n % 2;
    joint.gain = 1;
    joint.offset = 0.01;
    joint.slide_m = 0.002;
    joint.turn_rad = 1.02;
    joint.order_group = num_joints > 1 ? 3 : -1;
    joint.scatter = 0.01;
    joint.X_after = pose(10 + n);
  }
  fill(edge.num_joints, edge.joints, joints);
  edge.X_right = pose(20 + to);
  std::vector<float> packed;
  for (int i = 0; i < 6 + 8 * num_joints; ++i) {
    for (int j = 0; j <= i; ++j) packed.push_back(i == j ? 1e-6F : 1e-8F);
  }
  fill(edge.num_covariance, edge.parameter_covariance, packed);
  edge.position_rms_m = 0.0012;
  edge.rotation_rms_rad = 0.011;
  edge.num_samples_used = 40;
  edge.num_outliers = 2;
  edge.valid_since_sample = 3;
  edge.confidence = 0.93;
  edge.state = schema_edge_t::EDGE_SUSPECT;
  return edge;
}

wanted_action_t wanted_action() {
  wanted_action_t message{};
  fill(message.num_signals, message.wanted_action, {0.25, -0.75});
  message.fall = 0.3;
  message.reducible_fall = 0.4;
  return message;
}

schema_edge_t screw_gp_edge(int from, int to) {
  schema_edge_t message = edge(from, to, 1);
  message.base_kind = schema_edge_t::EDGE_SCREW_GP;
  residual_gp_t gp{};
  fill(gp.num_gp_signals, gp.gp_signals, {1, 0});
  gp.gp_length_scales = {0.8, 1.7};
  for (int c = 0; c < 6; ++c) {
    gp.gp_variances[c] = 1e-4 * (c + 1);
    gp.gp_noise_variances[c] = 1e-6 * (c + 1);
  }
  fill(gp.num_gp_samples, gp.gp_noise_scales, {1, 0.4, 12});
  fill(gp.num_gp_inputs, gp.gp_inputs, {-1, 0.5, 0.2, 0.1, 0.9, -0.7});
  std::vector<double> residuals;
  for (int n = 0; n < 18; ++n) residuals.push_back(0.001 * (n - 9));
  fill(gp.num_gp_residuals, gp.gp_residuals, residuals);
  fill(message.num_residual_gp, message.residual_gp, {gp});
  return message;
}

schema_edge_t matrix_gp_edge(int from, int to) {
  schema_edge_t message = edge(from, to, 0);
  message.base_kind = schema_edge_t::EDGE_MATRIX_GP;
  matrix_gp_t gp{};
  fill(gp.num_matrix_signals, gp.matrix_signals, {1});
  std::vector<double> lengths;
  for (int e = 0; e < 12; ++e) {
    lengths.push_back(0.7 + e);
    gp.entry_variances[e] = 0.1 * (e + 1);
    gp.entry_noise_variances[e] = 1e-5 * e;
  }
  fill(gp.num_entry_lengths, gp.entry_length_scales, lengths);
  fill(gp.num_matrix_poses, gp.matrix_poses, {pose(31), pose(32), pose(33)});
  fill(gp.num_matrix_inputs, gp.matrix_inputs, {-0.8, 0.1, 0.9});
  fill(message.num_matrix_gp, message.matrix_gp, {gp});
  return message;
}

}  // namespace

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

body_schema_t example_body_schema() {
  body_schema_t message{};
  message.utime = 1'000'008;
  message.schema_version = 4;
  message.base_version = 3;
  message.last_sample_index = 50;
  message.calibration_id = 99;
  message.num_samples_seen = 40;
  message.is_complete = 0;
  message.is_refined = 1;
  fill(message.num_parts, message.part_ids, {1, 2, 4, 5, 6, 9});
  fill(message.num_position_parts, message.position_parts, {5, 9});
  message.root_part = 2;
  message.X_CR = pose(2);
  covariance(message.X_CR_covariance);
  std::vector<signal_t> signals(2);
  for (int n = 0; n < 2; ++n) {
    signals[n].signal_name = n == 0 ? "shoulder" : "elbow";
    signals[n].lower_limit = -1.5 - n;
    signals[n].upper_limit = 1.5;
    fill(signals[n].num_warp, signals[n].warp_weights, {0.1, -0.1});
  }
  fill(message.num_signals, message.signals, signals);
  fill(message.num_edges, message.edges,
       {edge(2, 4, 2), edge(4, 1, 0), screw_gp_edge(4, 5), matrix_gp_edge(1, 6)});
  part_frame_t frame{};
  frame.frame_part = 4;
  covariance(frame.frame_covariance);
  fill(message.num_frames, message.frames, {frame});
  unconnected_part_t lost{};
  lost.unconnected_part = 9;
  lost.reason = unconnected_part_t::REASON_NO_VALID_MODEL;
  lost.detail = "refuted up to 3 signals";
  fill(message.num_unconnected, message.unconnected, {lost});
  fill(message.num_undecided, message.undecided_signals, {0, 1});
  body_change_t change{};
  change.found_sample = 32;
  change.since_sample = 30;
  fill(message.num_changes, message.changes, {change});
  moved_tag_t tag{};
  tag.moved_tag_id = 11;
  tag.moved_found_sample = 34;
  tag.moved_since_sample = 31;
  tag.moved_until_sample = 45;
  fill(message.num_moved_tags, message.moved_tags, {tag});
  fill(message.num_wanted, message.wanted_actions, {wanted_action()});
  message.noise_position_m = 0.003;
  message.noise_rotation_rad = 0.017;
  return message;
}

body_schema_t large_schema(int num_parts) {
  body_schema_t message = example_body_schema();
  std::vector<std::int32_t> parts;
  std::vector<schema_edge_t> edges;
  for (int part = 0; part < num_parts; ++part) {
    parts.push_back(part);
    if (part > 0) edges.push_back(edge(part - 1, part, 1));
  }
  message.is_complete = 1;
  message.root_part = 0;
  fill(message.num_parts, message.part_ids, parts);
  fill(message.num_position_parts, message.position_parts, {});
  fill(message.num_edges, message.edges, edges);
  fill(message.num_unconnected, message.unconnected, {});
  return message;
}

model_health_t example_model_health() {
  model_health_t message{};
  message.utime = 1'000'009;
  message.schema_version = 4;
  message.judged_sample = 50;
  message.schema_complete = 1;
  message.num_test_samples = 10;
  message.worst_position_m = 0.012;
  message.worst_rotation_rad = -1;
  message.noise_scale = 1.2;
  message.probe_sample = 49;
  fill(message.num_probe, message.probe_action, {0.5, -0.25});
  message.awaited_refinement = -1;
  message.wanted_sample = 50;
  fill(message.num_wanted, message.wanted_actions, {wanted_action()});
  edge_health_t edge{};
  edge.health_from = 2;
  edge.health_to = 4;
  edge.edge_state = schema_edge_t::EDGE_INVALID;
  edge.edge_is_drifting = 1;
  edge.edge_cusum = 14.5;
  edge.num_tests = 9;
  edge.median_mahalanobis2 = 5.3;
  fill(message.num_edges, message.edge_health, {edge});
  part_health_t part{};
  part.health_part = 4;
  part.part_state = schema_edge_t::EDGE_SUSPECT;
  part.is_flipping = 1;
  part.marker_cusum = 2.5;
  part.camera_cusum = -1;
  part.num_predicted = 9;
  part.visibility = 0.75;
  part.position_median_m = 0.012;
  part.rotation_median_rad = -1;
  fill(message.num_parts, message.part_health, {part});
  finding_t finding{};
  finding.finding_state = finding_t::FINDING_CONFIRMED;
  finding.finding_from = 2;
  finding.finding_to = 4;
  finding.finding_part = finding.finding_tag = -1;
  finding.finding_cause = health_event_t::CAUSE_GEOMETRY;
  finding.finding_size.size_kind = change_size_t::SIZE_POSE;
  finding.finding_size.size_signal = -1;
  finding.finding_size.num_amounts = 2;
  finding.finding_size.amount = {0.012, 0.35};
  finding.finding_size.amount_sd = {0.0004, -1};
  finding.finding_since = 7;
  finding.finding_found = 8;
  finding.finding_adopted = 9;
  finding.num_confirming = 40;
  finding.finding_text = "2→4 is bent or exchanged";
  fill(message.num_findings, message.findings, {finding});
  health_event_t event{};
  event.event_number = 6;
  event.utime = 1'000'009;
  event.event_sample = 50;
  event.event_kind = health_event_t::EVENT_CANDIDATE;
  event.event_from = 2;
  event.event_to = 4;
  event.event_part = event.event_tag = -1;
  event.event_cause = health_event_t::CAUSE_JOINT_STUCK;
  event.event_other_cause = health_event_t::CAUSE_GEOMETRY;
  event.event_since = 49;
  event.event_size.size_kind = change_size_t::SIZE_COMMAND;
  event.event_size.size_signal = 1;
  event.event_size.num_amounts = 1;
  event.event_size.amount = {-0.25};
  event.event_size.amount_sd = {0.01};
  event.event_margin = 31.5;
  event.samples_used = 2;
  event.event_text = "edge 2 → 4 replaced";
  fill(message.num_events, message.events, {event});
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
