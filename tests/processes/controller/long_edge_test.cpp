// Controller and simulated arm of which base and hand alone are seen: one edge of six joints.

#include <gtest/gtest.h>

#include <deque>

#include "common/bus/convert.h"
#include "processes/controller/controller.h"
#include "processes/robot_simulator/robot_simulator.h"
#include "tests/support/rig_truth.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

const std::filesystem::path kRig = BODYSCHEMA_CONFIG "/arm6_ends";
constexpr int kRoot = 1, kHand = 2;
constexpr std::int64_t kTick = 100'000;

/// The rig's truth as a schema of one edge.
BodySchema true_schema() {
  BodySchema schema;
  schema.version = 1;
  schema.complete = true;
  schema.signals = load_signals(kRig).signals;
  schema.parts = {kRoot, kHand};
  schema.root = kRoot;
  schema.X_CR.translation().z() = 2;
  schema.edges = {test::RigTruth(kRig).true_edge(kRoot, kHand)};
  return schema;
}

RobotSimulatorConfig ideal_arm() {
  RobotSimulatorConfig config = RobotSimulatorConfig::load(kRig / "robot_simulator.yaml");
  config.is_ideal = true;
  return config;
}

/// Plays eyes, observer and monitor of the simulated arm.
class Bench {
 public:
  Bench() : schema_(true_schema()), arm_(ideal_arm()), controller_(load()) {
    hear(arm_.status());
    take(controller_.on_body_schema(to_message(schema_)));
    see();
  }

  /// Runs until the target is reached or refused, a minute at most.
  control_status_t bring_hand_to(const Eigen::Vector3d& p_RT) {
    pose_target_t target{};
    target.sender = "test";
    target.epoch = 1;
    target.target_id = ++num_targets_;
    target.target_kind = pose_target_t::KIND_POSITION;
    target.target_part = kHand;
    target.keep_s = 0.1;
    std::copy(p_RT.begin(), p_RT.end(), target.position_m);
    take(controller_.on_pose_target(target));
    for (int i = 0; i < 600 && !is_over(); ++i) {
      if (i % 10 == 0) {
        hear(arm_.status());
        take(controller_.on_body_schema(to_message(schema_)));
        see();
      }
      take(controller_.on_tick(now_ += kTick));
      while (!commands_.empty()) carry_out();
    }
    return status_;
  }
  /// Of the simulated arm itself, in the root's frame.
  Eigen::Vector3d hand() const {
    const sim_state_t state = arm_.state();
    return (from_message(state.X_WB.at(0)).inverse() * from_message(state.X_WB.at(1)))
        .translation();
  }
  int num_moves() const { return num_moves_; }

 private:
  static ControllerConfig load() { return ControllerConfig::load(kRig / "controller.yaml"); }
  bool is_over() const {
    return status_.target_id == num_targets_ &&
           (status_.control_state == control_status_t::CONTROL_REACHED ||
            status_.control_state == control_status_t::CONTROL_REFUSED);
  }
  void hear(const motion_status_t& status) { take(controller_.on_motion_status(status)); }
  void see() {
    marker_poses_t poses{};
    poses.utime = arm_.status().utime + kTick;
    take(controller_.on_marker_poses(poses));
  }
  void take(const Controller::Answer& answer) {
    if (answer.status) status_ = *answer.status;
    if (answer.command) commands_.push_back(*answer.command);
  }
  void carry_out() {
    const action_command_t command = commands_.front();
    commands_.pop_front();
    const RobotSimulator::Answer answer = arm_.on_command(command);
    for (const motion_status_t& status : answer.statuses) hear(status);
    if (!answer.state) return;
    ++num_moves_;
    see();
    sample_t sample{};
    sample.utime = arm_.status().utime + kTick;
    sample.sample_index = num_samples_++;
    sample.source = command.source;
    sample.epoch = command.epoch;
    sample.action_id = command.action_id;
    sample.purpose = command.purpose;
    sample.rest_begin_utime = arm_.status().rest_since_utime;
    sample.rest_end_utime = sample.utime;
    set_array(sample.num_signals, sample.action, command.action);
    take(controller_.on_sample(sample));
  }

  const BodySchema schema_;
  RobotSimulator arm_;
  Controller controller_;
  control_status_t status_{};
  std::deque<action_command_t> commands_;
  std::int64_t now_ = 1'000'000'000, num_samples_ = 0, num_targets_ = 0;
  int num_moves_ = 0;
};

TEST(LongEdge, TheHandIsBroughtToRandomPositions) {
  Bench bench;
  const BodySchema schema = true_schema();
  test::Rng rng(1);
  for (int n = 0; n < 20; ++n) {
    Eigen::VectorXd action(6);
    for (int s = 0; s < 6; ++s)
      action(s) = test::uniform(rng, schema.signals[s].lower, schema.signals[s].upper);
    const Eigen::Vector3d p_RT = schema.predict(kRoot, kHand, action)->X_AB.translation();
    const control_status_t status = bench.bring_hand_to(p_RT);
    EXPECT_EQ(status.control_state, control_status_t::CONTROL_REACHED) << status.why;
    EXPECT_LT((bench.hand() - p_RT).norm(), 0.001) << n;
  }
  EXPECT_GT(bench.num_moves(), 20);
}

TEST(LongEdge, WhatTheHandCannotReachIsRefused) {
  Bench bench;
  const control_status_t status = bench.bring_hand_to({0, 0, 2});
  EXPECT_EQ(status.control_state, control_status_t::CONTROL_REFUSED);
  EXPECT_EQ(bench.num_moves(), 0);
}

}  // namespace
}  // namespace bodyschema
