#include "tests/processes/controller/controller_bench.h"

#include <gtest/gtest.h>

#include <fstream>
#include <memory>

#include "common/bus/check.h"

namespace bodyschema::test {

Bench::Bench(ControllerConfig config) : config_(config), controller(std::move(config)) {
  motion.utime = motion.rest_since_utime = 5 * kSecond;
  motion.action_id = -1;
  set_array(motion.num_signals, motion.commanded, std::vector<double>{-30, 0.2, 1});
}

void Bench::run(double seconds) {
  for (std::int64_t end = now + std::llround(seconds * 1e6); now < end; now += kTick) {
    if (now % kSecond == 0) repeat();
    serve();
    take(controller.on_tick(now));
    expect_no_service_in_silence();
  }
}

bool Bench::run_until(const std::function<bool()>& holds) {
  for (int i = 0; i < 300 && !holds(); ++i) run(0.1);
  return holds();
}

bool Bench::run_until_state(std::int8_t state) {
  return run_until([&] { return status.control_state == state; });
}

void Bench::give(const Target& target) {
  ASSERT_EQ(check(target), "");
  given_ = target;
  given_at_ = now;
  take(controller.on_pose_target(target));
}

void Bench::say(const motion_status_t& message) {
  motion = message;
  if (!driver_speaks) return;
  ASSERT_EQ(check(motion), "");
  driver_was_heard_ = true;
  driver_since_ = now;
  if (motion.state == motion_status_t::STATE_MOVING) settled_at_ = now;
  take(controller.on_motion_status(motion));
}

void Bench::show_schema() {
  body_schema_t message = to_message(schema);
  ASSERT_EQ(check(message), "");
  schema_was_heard_ = true;
  monitor_since_ = now;
  take(controller.on_body_schema(message));
}

void Bench::show_frame() {
  last_sight_utime_ = motion.utime + kTick;
  eyes_since_ = now;
  if (num_frames > 0) return show_tags();
  tags_seen_.clear();
  marker_poses_t poses{};
  poses.utime = motion.utime + kTick;
  take(controller.on_marker_poses(poses));
}

void Bench::show_tags() {
  for (int frame = 0; frame < num_frames; ++frame) {
    marker_poses_t poses{};
    poses.utime = motion.utime + kTick + frame * kFrame;
    std::vector<marker_pose_t> markers;
    tags_seen_.clear();
    for (const auto& [id, p_RM] : p_RM_of_tag) {
      if (covers_tags && (part_position() - p_RM).norm() < 0.01) continue;
      tags_seen_.insert(id);
      marker_pose_t& marker = markers.emplace_back();
      marker.marker_id = id;
      marker.size_m = 0.1;
      Pose X_RM = Pose::Identity();
      X_RM.translation() = p_RM;
      if (frame % 2) X_RM.translation().x() += tag_jitter_m;
      marker.X_CM[0] = marker.X_CM[1] = to_message(Pose(X_CC_moved * planar().X_CR * X_RM));
      marker.num_hypotheses = 1;
      to_message(Matrix6d(Matrix6d::Identity() * 1e-6), marker.covariance);
      to_message(Matrix8d(Matrix8d::Identity()), marker.corner_covariance);
    }
    set_array(poses.num_markers, poses.markers, markers);
    ASSERT_EQ(check(poses), "");
    take(controller.on_marker_poses(poses));
  }
}

void Bench::put_tag(int id, std::optional<Eigen::Vector3d> p_RM) {
  p_RM_of_tag.erase(id);
  if (p_RM) p_RM_of_tag[id] = *p_RM;
  motion_status_t message = motion;
  message.utime += kSecond;
  message.rest_since_utime = message.utime;
  set_array(message.num_signals, message.commanded, arm);
  say(message);
  show_frame();
}

void Bench::repeat() {
  say(motion);
  if (monitor_speaks) show_schema();
  if (!health || !monitor_speaks) return;
  heard_health_ = health;
  take(controller.on_model_health(*health));
}

void Bench::start() {
  repeat();
  if (eyes_open) show_frame();
  run(0.5);
}

void Bench::settle(const std::string& source, std::int64_t epoch, std::int64_t id,
                   const std::vector<double>& action, std::int8_t purpose) {
  motion_status_t moving = motion;
  moving.utime = motion.utime;
  moving.source = source;
  moving.epoch = epoch;
  moving.action_id = id;
  moving.kind = action_command_t::KIND_MOVE;
  moving.purpose = purpose;
  moving.state = motion_status_t::STATE_MOVING;
  moving.reason = "";
  moving.rest_since_utime = -1;
  set_array(moving.num_signals, moving.commanded, action);
  say(moving);
  moving.state = motion_status_t::STATE_SETTLED;
  moving.utime += 4 * kSecond;  // longer than the eyes may be silent by the clock
  moving.rest_since_utime = moving.utime - kSecond / 20;
  say(moving);
  if (eyes_open) show_frame();
  if (eyes_open && observer_works) show_sample();
}

void Bench::show_sample() {
  sample_t sample{};
  last_sight_utime_ = sample.utime = motion.utime + kTick;
  eyes_since_ = now;
  sample.sample_index = num_samples++;
  sample.source = motion.source;
  sample.epoch = motion.epoch;
  sample.action_id = motion.action_id;
  sample.purpose = motion.purpose;
  sample.rest_begin_utime = motion.rest_since_utime;
  sample.rest_end_utime = sample.utime;
  set_array(sample.num_signals, sample.action, motion.commanded);
  // The real arm: the schema's, but bent.
  const Eigen::Vector3d action(motion.commanded.data());
  std::vector<part_observation_t> parts;
  for (const auto& [part, X_RB] : planar().predict_all(action)) {
    if (hidden.contains(part)) continue;
    part_observation_t seen{};
    seen.part_id = part;
    seen.has_rotation = 1;
    Pose X_CB = X_CC_moved * planar().X_CR * X_RB;
    if (part == 4) X_CB.translation() += bend_m;
    if (part == 4)
      X_CB.linear() = X_CB.linear() * Eigen::AngleAxisd(turn_rad, Eigen::Vector3d::UnitZ());
    seen.X_CB = seen.X_CB_other = to_message(X_CB);
    const double variance = part == 4 ? observation_sd_m * observation_sd_m : 1e-6;
    to_message(Matrix6d(Matrix6d::Identity() * variance), seen.covariance);
    seen.has_other = part == 4 && is_ambiguous;
    seen.error_ratio = seen.has_other ? 2 : 0;
    if (part == 4 && tag >= 0) {
      tag_corners_t corners{};
      corners.tag_id = tag;
      set_array(seen.num_tags, seen.tags, {corners});
    }
    parts.push_back(seen);
  }
  set_array(sample.num_parts, sample.parts, parts);
  last_sampled_id_ = sample.action_id;
  take(controller.on_sample(sample));
}

void Bench::answer_last_move(std::int8_t state, const std::string& reason) {
  answer_move(moves.back(), state, reason);
}

void Bench::answer_move(action_command_t command, std::int8_t state, const std::string& reason) {
  motion_status_t result = motion;
  result.source = command.source;
  result.epoch = command.epoch;
  result.action_id = command.action_id;
  result.kind = command.kind;
  result.purpose = command.purpose;
  result.state = state;
  result.reason = reason;
  if (state == motion_status_t::STATE_REJECTED || state == motion_status_t::STATE_EXPIRED)
    refused_moves_[command.action_id] = state;
  set_array(result.num_signals, result.commanded, command.action);
  say(result);
}

void Bench::stop(bool latched) {
  motion_status_t message = motion;
  message.source = "operator";
  message.epoch = 1;
  ++message.action_id;
  message.kind = latched ? action_command_t::KIND_STOP : action_command_t::KIND_RESUME;
  message.state = latched ? motion_status_t::STATE_STOPPED : motion_status_t::STATE_IDLE;
  message.reason = latched ? "STOP by operator" : "";
  message.stop_latched = latched;
  set_array(message.num_signals, message.commanded, std::vector<double>{});
  say(message);
}

void Bench::push(bool is_moving) {
  motion_status_t message = motion;
  message.utime += kSecond;
  message.rest_since_utime = is_moving ? -1 : message.utime;
  set_array(message.num_signals, message.commanded, std::vector<double>{});
  say(message);
}

void Bench::note_events() {
  controller.trace([this](Phase phase, Event event) { met.emplace(phase, event); });
}

void Bench::hold(std::int64_t id) {
  motion_status_t message = motion;
  message.source = "operator";
  message.epoch = 1;
  message.action_id = id;
  message.kind = action_command_t::KIND_HOLD;
  message.state = motion_status_t::STATE_HOLDING;
  set_array(message.num_signals, message.commanded, std::vector<double>{});
  say(message);
}

void Bench::set_back() {
  motion_status_t message = motion;
  message.utime = std::max<std::int64_t>(0, motion.utime - kSecond);
  message.rest_since_utime = std::min(motion.rest_since_utime, message.utime);
  say(message);
}

void Bench::restart(const std::filesystem::path& file) {
  std::ofstream(file) << controller.state_text();
  std::destroy_at(&controller);
  std::construct_at(&controller, config_);
  note_events();
  controller.restore(file);
  commands_.clear();
  driver_was_heard_ = schema_was_heard_ = false;
  heard_health_.reset();
  tags_seen_.clear();
  last_sight_utime_ = -1;
  driver_since_ = monitor_since_ = eyes_since_ = now;
  given_.expiry_s = 0;
  status = controller.status();
}

Eigen::Vector3d Bench::part_position() const {
  return planar().predict(1, 4, Eigen::Vector3d(arm.data()))->X_AB.translation();
}

void Bench::take(const Controller::Answer& answer) {
  if (answer.status) {
    ASSERT_EQ(check(*answer.status), "");
    const bool is_on_path = answer.status->num_way_points > 0;
    ASSERT_FALSE(is_on_path && answer.status->control_state == S::CONTROL_LENT);
    if (status.control_state == S::CONTROL_HOLDING && is_on_path &&
        answer.status->target_epoch == status.target_epoch &&
        answer.status->target_id != status.target_id)
      left_path_id_ = answer.status->target_id;
    const bool has_arrived = status.control_state != S::CONTROL_REACHED &&
                             answer.status->control_state == S::CONTROL_REACHED;
    status = *answer.status;
    const double tolerance_m = given_.tolerance_m > 0 ? given_.tolerance_m : config_.reached_m;
    ASSERT_TRUE(!has_arrived ||
                status.predicted_error_m < tolerance_m + 1.1 * config_.max_correction_m)
        << "reached, but " << status.predicted_error_m << " m away";
    if (status.control_state == S::CONTROL_HOLDING || status.control_state == S::CONTROL_REFUSED ||
        status.control_state == S::CONTROL_RELEASED)
      last_ended_id_ = status.target_id;
  }
  if (!answer.command) return;
  const action_command_t& command = *answer.command;
  ASSERT_EQ(check(command), "");
  last_kind_ = command.kind;
  ASSERT_EQ(command.source, "controller");
  ASSERT_TRUE(command.purpose == action_command_t::PURPOSE_CONTROL ||
              command.purpose == action_command_t::PURPOSE_PROBE);
  ASSERT_EQ(status.owns_arm, 1) << "commands an arm that is not its own";
  commands_.push_back(command);
  if (command.kind == action_command_t::KIND_HOLD) {
    ++num_holds;
    return;
  }
  ASSERT_EQ(command.kind, action_command_t::KIND_MOVE);
  ASSERT_EQ(motion.stop_latched, 0);
  ASSERT_NE(status.target_id, last_ended_id_) << "moves for a target that is over";
  ASSERT_NE(status.target_id, left_path_id_) << "goes on along a path on which it was held";
  ASSERT_GT(command.expiry_utime, motion.utime);
  for (std::size_t i = 0; i < arm.size(); ++i) {
    const Signal& signal = config_.signals[i];
    ASSERT_GE(command.action[i], signal.lower);
    ASSERT_LE(command.action[i], signal.upper);
    ASSERT_LE(std::abs(command.action[i] - arm[i]),
              (config_.max_step + 1e-9) * (signal.upper - signal.lower));
  }
  expect_stays_inside(command);
  if (!moves.empty() && moves.back().action_id == command.action_id) {
    ASSERT_EQ(moves.back().action, command.action);
    ++num_repeats;
    return;
  }
  ASSERT_EQ(status.control_state, S::CONTROL_MOVING);
  expect_is_guarded();
  expect_is_slow_in_doubt(command);
  if (!moves.empty()) {
    ASSERT_GT(command.action_id, moves.back().action_id);
  }
  moves.push_back(command);
}

void Bench::expect_is_guarded() const {
  ASSERT_TRUE(driver_was_heard_ && schema_was_heard_);
  ASSERT_GE(motion.rest_since_utime, 0) << "moves an arm that moves";
  ASSERT_GE(last_sight_utime_, motion.rest_since_utime) << "moves unseen";
  const bool is_settled =
      motion.kind == action_command_t::KIND_MOVE && motion.state == motion_status_t::STATE_SETTLED;
  if (is_settled && last_sampled_id_ != motion.action_id) {
    ASSERT_GE(now - settled_at_, config_.sample_timeout_us) << "a sample is lost";
  }
  if (given_.target_kind != Target::KIND_TAG || status.target_id != given_.target_id) return;
  const Eigen::Vector3d p_RT(status.target_position_m);
  ASSERT_TRUE(tags_seen_.contains(given_.target_tag) ||
              (part_position() - p_RT).norm() <= config_.reached_m)
      << "moves to a tag that is not seen";
}

void Bench::expect_is_slow_in_doubt(const action_command_t& command) const {
  const bool is_in_doubt = heard_health_ && heard_health_->schema_version == schema.version &&
                           heard_health_->edge_health[0].edge_state != schema_edge_t::EDGE_OK;
  if (!is_in_doubt && command.purpose != action_command_t::PURPOSE_PROBE) return;
  for (std::size_t i = 0; i < arm.size(); ++i) {
    const Signal& signal = config_.signals[i];
    ASSERT_LE(std::abs(command.action[i] - arm[i]),
              (config_.slow_step + 1e-6) * (signal.upper - signal.lower));
  }
}

void Bench::expect_stays_inside(const action_command_t& command) {
  const Eigen::Vector3d from(arm.data()), to(command.action.data());
  const auto expect = [&](Eigen::AlignedBox3d box, bool is_inside) {
    const Eigen::AlignedBox3d whole = box;
    const double margin = is_inside ? 5e-3 : -5e-3;
    box.min().array() -= margin;
    box.max().array() += margin;
    for (const int part : {2, 3, 4}) {
      const auto origin_at = [&](double share) -> Eigen::Vector3d {
        return planar().predict(1, part, from + share * (to - from))->X_AB.translation();
      };
      if (whole.contains(origin_at(0)) != is_inside) continue;
      for (int n = 1; n <= 50; ++n)
        ASSERT_EQ(box.contains(origin_at(n / 50.0)), is_inside) << "part " << part;
    }
  };
  for (const Eigen::AlignedBox3d& box : config_.workspace.keep_out) expect(box, false);
  if (!config_.workspace.within.isEmpty()) expect(config_.workspace.within, true);
}

void Bench::serve() {
  if (commands_.empty()) return;
  const action_command_t command = commands_.front();
  commands_.pop_front();
  if (!driver_speaks || !driver_serves) return;
  if (command.kind == action_command_t::KIND_HOLD) {
    motion_status_t held = motion;
    held.source = command.source;
    held.epoch = command.epoch;
    held.action_id = command.action_id;
    held.kind = command.kind;
    if (num_holds_refused > 0) {
      --num_holds_refused;
      refused_holds_.insert(command.action_id);
    }
    held.state = refused_holds_.contains(command.action_id) ? motion_status_t::STATE_REJECTED
                                                            : motion_status_t::STATE_HOLDING;
    set_array(held.num_signals, held.commanded, std::vector<double>{});
    say(held);
  } else if (const auto refused = refused_moves_.find(command.action_id);
             refused != refused_moves_.end()) {
    answer_move(command, refused->second, "as before");
  } else if (const std::string reason =
                 motion.stop_latched ? "halted: resume first" : rejects(command);
             !reason.empty()) {
    answer_move(command, motion_status_t::STATE_REJECTED, reason);
  } else {
    arm = command.action;
    if (driver_rounds)
      for (double& value : arm) value = static_cast<float>(value);
    settle(command.source, command.epoch, command.action_id, arm, command.purpose);
  }
}

void Bench::expect_no_service_in_silence() {
  // A hold that is due is sent as soon as there is a driver.
  ASSERT_TRUE(controller.phase() != Phase::kHoldDue || !driver_was_heard_);
  if (controller.phase() == Phase::kHoldSent) {
    ASSERT_EQ(last_kind_, action_command_t::KIND_HOLD);
  }
  const bool is_open = status.control_state == S::CONTROL_WAITING ||
                       status.control_state == S::CONTROL_MOVING ||
                       status.control_state == S::CONTROL_LENT;
  if (is_open && given_.expiry_s > 0 && status.target_id == given_.target_id) {
    ASSERT_LE(now - given_at_, std::llround(given_.expiry_s * 1e6) + 2 * kTick);
  }
  const bool is_serving = status.owns_arm == 1 && (status.control_state == S::CONTROL_WAITING ||
                                                   status.control_state == S::CONTROL_MOVING);
  if (driver_speaks || !is_serving) driver_since_ = now;
  if (monitor_speaks || !is_serving) monitor_since_ = now;
  // Before the driver's time is known no image is due.
  if (last_sight_utime_ >= motion.utime || !is_serving || !driver_was_heard_) eyes_since_ = now;
  ASSERT_LE(now - eyes_since_, config_.max_marker_poses_silence_us + 2 * kTick);
  ASSERT_LE(now - driver_since_, config_.max_motion_status_silence_us + 2 * kTick);
  ASSERT_LE(now - monitor_since_, config_.max_body_schema_silence_us + 2 * kTick);
}

}  // namespace bodyschema::test
