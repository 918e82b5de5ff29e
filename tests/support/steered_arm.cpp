#include "tests/support/steered_arm.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <random>
#include <stdexcept>
#include <utility>

#include "common/bus/convert.h"
#include "tests/support/broken_arm.h"

namespace bodyschema::test {
namespace {

using S = control_status_t;

constexpr std::int64_t kTick_us = 100'000;
constexpr std::int64_t kPatience_us = 600'000'000;
constexpr std::int64_t kFrame_us = 33'333;
constexpr int kTag = 40;

ControllerConfig controller_config(const std::filesystem::path& rig, const SyntheticRobot& robot,
                                   const SteeredArm::Options& options) {
  ControllerConfig config = ControllerConfig::load(rig / "controller.yaml");
  config.signals = robot.signals;
  config.measurement = adaptation_options(options.regime).measurement;
  config.max_corrections = options.max_corrections;
  config.target_tags = {kTag};
  return config;
}

ModelMonitorConfig monitor_config(const std::filesystem::path& rig, Regime regime) {
  ModelMonitorConfig config = ModelMonitorConfig::load(rig / "model_monitor.yaml");
  config.measurement = adaptation_options(regime).measurement;
  return config;
}

body_schema_t told(BodySchema schema) {
  schema.version = 1;
  schema.last_sample_index = -1;
  return to_message(schema);
}

}  // namespace

SteeredArm::SteeredArm(SyntheticRobot robot, const BodySchema& schema,
                       const std::filesystem::path& rig, const Options& options)
    : robot_(std::move(robot)),
      options_(options),
      rng_(options.seed),
      controller_(controller_config(rig, robot_, options)),
      monitor_(monitor_config(rig, options.regime)),
      first_schema_(told(schema)),
      position_(Eigen::VectorXd::Zero(static_cast<Eigen::Index>(robot_.signals.size()))) {
  monitor_.start_from(first_schema_);
  motion_.utime = motion_.rest_since_utime = 1'000'000;
  motion_.action_id = -1;
  set_array(motion_.num_signals, motion_.commanded,
            std::vector<double>(position_.begin(), position_.end()));
}

Eigen::Vector3d SteeredArm::position(int part) const {
  const auto X_CB = robot_.poses_in_camera(position_);
  return (X_CB.at(first_schema_.root_part).inverse() * X_CB.at(part)).translation();
}

SteeredArm::Arrival SteeredArm::go_to(int part, const Eigen::Vector3d& p_RT, int way_point,
                                      int num_way_points) {
  pose_target_t target{};
  target.way_point = way_point;
  target.num_way_points = num_way_points;
  target.target_kind = pose_target_t::KIND_POSITION;
  target.target_part = part;
  std::copy(p_RT.begin(), p_RT.end(), target.position_m);
  return serve(target, p_RT);
}

SteeredArm::Arrival SteeredArm::go_to_tag(int part, const Eigen::Vector3d& p_RT) {
  // Who puts it there takes a second, so that no frame mixes before and after.
  motion_.utime += 1'000'000;
  motion_.rest_since_utime = motion_.utime;
  p_RM_ = p_RT;
  tell();
  pose_target_t target{};
  target.target_kind = pose_target_t::KIND_TAG;
  target.target_part = part;
  target.target_tag = kTag;
  return serve(target, p_RT);
}

SteeredArm::Arrival SteeredArm::serve(pose_target_t target, const Eigen::Vector3d& p_RT) {
  target.sender = "test";
  target.epoch = 1;
  target.target_id = num_targets_++;
  target.keep_s = -1;
  target.tolerance_m = options_.tolerance_m;
  take(controller_.on_pose_target(target));
  const std::int64_t end_us = now_us_ + kPatience_us;
  const auto has_ended = [&] {
    return status_.control_state == S::CONTROL_REACHED ||
           status_.control_state == S::CONTROL_REFUSED ||
           status_.control_state == S::CONTROL_HOLDING;
  };
  while (!has_ended()) {
    if (now_us_ >= end_us) throw std::runtime_error("no end of a target: " + status_.why);
    if (now_us_ % 1'000'000 == 0) tell();
    for (const action_command_t& command : std::exchange(unanswered_, {})) serve(command);
    take(controller_.on_tick(now_us_));
    now_us_ += kTick_us;
  }
  return {status_, (position(target.target_part) - p_RT).norm()};
}

void SteeredArm::take(const Controller::Answer& answer) {
  if (answer.status) status_ = *answer.status;
  if (answer.command) unanswered_.push_back(*answer.command);
}

/// What repeats once a second.
void SteeredArm::tell() {
  take(controller_.on_motion_status(motion_));
  if (p_RM_) {
    show_tag();
  } else {
    marker_poses_t frame{};
    frame.utime = motion_.utime + kTick_us;
    take(controller_.on_marker_poses(frame));
  }
  take(controller_.on_body_schema(options_.adapts ? *monitor_.schema() : first_schema_));
  if (options_.adapts) take(controller_.on_model_health(monitor_.health()));
}

void SteeredArm::show_tag() {
  const Matrix6d covariance = isotropic(nominal_noise(options_.regime));
  const Matrix6d factor = covariance.llt().matrixL();
  Pose X_RM = Pose::Identity();
  X_RM.translation() = *p_RM_;
  const Pose X_CM = robot_.poses_in_camera(position_).at(first_schema_.root_part) * X_RM;
  std::normal_distribution<double> normal;
  for (int n = 0; n < TagTrack::kFrames; ++n) {
    Vector6d noise;
    for (double& value : noise) value = normal(rng_);
    marker_poses_t frame{};
    frame.utime = motion_.utime + kTick_us + n * kFrame_us;
    marker_pose_t marker{};
    marker.marker_id = kTag;
    marker.num_hypotheses = 1;
    marker.X_CM[0] = marker.X_CM[1] = to_message(Pose(X_CM * exp(Vector6d(factor * noise))));
    to_message(covariance, marker.covariance);
    set_array(frame.num_markers, frame.markers, {marker});
    take(controller_.on_marker_poses(frame));
  }
}

void SteeredArm::serve(const action_command_t& command) {
  motion_.source = command.source;
  motion_.epoch = command.epoch;
  motion_.action_id = command.action_id;
  motion_.kind = command.kind;
  motion_.purpose = command.purpose;
  motion_.utime += 1'000'000;
  if (command.kind != action_command_t::KIND_MOVE) {
    motion_.state = motion_status_t::STATE_HOLDING;
    set_array(motion_.num_signals, motion_.commanded, std::vector<double>{});
    tell();
    return;
  }
  moves_.push_back(command);
  position_ = Eigen::VectorXd::Map(command.action.data(), command.num_signals);
  motion_.state = motion_status_t::STATE_SETTLED;
  motion_.rest_since_utime = motion_.utime;
  set_array(motion_.num_signals, motion_.commanded, command.action);
  ActionPoseSample seen =
      observe(robot_, position_, {.regime = options_.regime, .with_covariances = true},
              num_samples_++, rng_);
  sample_t sample = to_message(seen);
  sample.utime = motion_.utime + kTick_us;
  sample.source = command.source;
  sample.epoch = command.epoch;
  sample.action_id = command.action_id;
  sample.purpose = command.purpose;
  sample.rest_begin_utime = motion_.rest_since_utime;
  sample.rest_end_utime = sample.utime;
  if (options_.adapts) monitor_.on_sample(sample);
  tell();
  take(controller_.on_sample(sample));
}

}  // namespace bodyschema::test
