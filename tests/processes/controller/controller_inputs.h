#pragma once

#include <algorithm>
#include <cstdint>
#include <iterator>

#include "common/bus/convert.h"
#include "common/geometry/angle.h"
#include "processes/controller/controller.h"

// What a controller's tests tell it: an arm in a plane, its schema, its health, and targets.

namespace bodyschema::test {

using S = control_status_t;
using Target = pose_target_t;

inline constexpr std::int64_t kSecond = 1'000'000;
inline constexpr std::int64_t kTick = kSecond / 10;
inline constexpr std::int64_t kFrame = 33'333;

inline ControllerConfig test_config() {
  ControllerConfig config;
  config.signals = {{"a", -90, 90}, {"b", -1, 1}, {"c", 0, 10}};
  config.inverse_kinematics = {
      .tolerance_m = 1e-5, .damping_m = 0.05, .max_iterations = 100, .max_starts = 20};
  config.reached_m = 0.005;
  config.reached_rad = 1 * kDegree;
  config.search_step = 0.1;
  config.max_searches = 0;
  config.max_step = 0.25;
  config.slow_step = 0.05;
  config.max_corrections = 1;
  config.max_correction_m = 0.03;
  config.max_solutions = 4;
  config.expiry_us = 60 * kSecond;
  config.resend_us = 1 * kSecond;
  config.take_us = 3 * kTick;
  config.sample_timeout_us = 5 * kSecond;
  config.verdict_timeout_us = 10 * kSecond;
  config.rest_timeout_us = 20 * kSecond;
  config.lent_timeout_us = 50 * kSecond;
  config.target_tags = {40, 41};
  config.max_motion_status_silence_us = 3 * kSecond;
  config.max_marker_poses_silence_us = 3 * kSecond;
  config.max_body_schema_silence_us = 3 * kSecond;
  return config;
}

/// Three links in a plane, 1, 0.7 and 0.4 m; part 5 is not connected.
inline BodySchema planar(std::int64_t version = 1) {
  BodySchema schema;
  schema.version = version;
  schema.parts = {1, 2, 3, 4, 5};
  schema.root = 1;
  schema.X_CR.translation() = Eigen::Vector3d(0.1, 0.2, 2);
  schema.signals = test_config().signals;
  const double lengths[] = {1, 0.7, 0.4}, turns[] = {kDegree, M_PI / 2, -0.3};
  for (int i = 0; i < 3; ++i) {
    Edge edge;
    edge.from = i + 1;
    edge.to = i + 2;
    ScrewJoint joint;
    joint.signal = i;
    joint.turn = turns[i];
    edge.joints.push_back(joint);
    edge.right.translation() = Eigen::Vector3d(lengths[i], 0, 0);
    schema.edges.push_back(edge);
  }
  UnconnectedPart lonely;
  lonely.part = 5;
  schema.unconnected.push_back(lonely);
  return schema;
}

inline model_health_t health_of(std::int64_t version, int from, int to, std::int8_t state) {
  model_health_t health{};
  health.schema_version = version;
  health.worst_position_m = health.worst_rotation_rad = -1;
  edge_health_t edge{};
  edge.health_from = from;
  edge.health_to = to;
  edge.edge_state = state;
  edge.median_mahalanobis2 = -1;
  set_array(health.num_edges, health.edge_health, {edge});
  return health;
}

inline Target position_target(std::int64_t id, const Eigen::Vector3d& p_RT, double keep_s = -1) {
  Target target{};
  target.sender = "operator";
  target.epoch = 77;
  target.target_id = id;
  target.target_kind = Target::KIND_POSITION;
  target.target_part = 4;
  std::copy(p_RT.begin(), p_RT.end(), target.position_m);
  target.keep_s = keep_s;
  return target;
}

/// Where the arm's last link is at an action, as a target.
inline Target pose_target(std::int64_t id, const Eigen::Vector3d& action) {
  const Pose X_RB = planar().predict(1, 4, action)->X_AB;
  Target target = position_target(id, X_RB.translation());
  target.target_kind = Target::KIND_POSE;
  const Eigen::Quaterniond q(X_RB.linear());
  const double wxyz[] = {q.w(), q.x(), q.y(), q.z()};
  std::copy(std::begin(wxyz), std::end(wxyz), target.orientation_wxyz);
  return target;
}

inline Target other_target(std::int64_t id, std::int8_t kind) {
  Target target{};
  target.sender = "operator";
  target.epoch = 77;
  target.target_id = id;
  target.target_kind = kind;
  target.target_part = -1;
  return target;
}

inline Target tag_target(std::int64_t id, int tag = 40) {
  Target target = position_target(id, Eigen::Vector3d::Zero());
  target.target_kind = Target::KIND_TAG;
  target.target_tag = tag;
  return target;
}

inline const Eigen::Vector3d kNear(1.9, 0.3, 0), kFar(0.9, -1.2, 0), kBeyond(3, 0, 0);

}  // namespace bodyschema::test
