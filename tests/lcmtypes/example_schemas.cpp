// The example messages of a schema and of its health.

#include "tests/lcmtypes/example_messages.h"
#include "tests/lcmtypes/example_parts.h"

namespace bodyschema::test {
namespace {

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

edge_health_t edge_health() {
  edge_health_t edge{};
  edge.health_from = 2;
  edge.health_to = 4;
  edge.edge_state = schema_edge_t::EDGE_INVALID;
  edge.edge_is_drifting = 1;
  edge.edge_cusum = 14.5;
  edge.num_tests = 9;
  edge.median_mahalanobis2 = 5.3;
  return edge;
}

part_health_t part_health() {
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
  return part;
}

finding_t finding() {
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
  return finding;
}

health_event_t health_event() {
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
  return event;
}

}  // namespace

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
    signals[n].covered_lower = -1.25;
    signals[n].covered_upper = 1.25;
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
  fill(message.num_edges, message.edge_health, {edge_health()});
  fill(message.num_parts, message.part_health, {part_health()});
  fill(message.num_findings, message.findings, {finding()});
  fill(message.num_events, message.events, {health_event()});
  return message;
}

}  // namespace bodyschema::test
