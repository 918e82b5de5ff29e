#pragma once

#include <gtest/gtest.h>

#include <deque>
#include <filesystem>
#include <fstream>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <set>
#include <utility>

#include "common/bus/check.h"
#include "common/bus/convert.h"
#include "common/geometry/angle.h"
#include "processes/controller/controller.h"

// What a controller's tests have in common: an arm in a plane and everybody around it.

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

inline const Eigen::Vector3d kNear(1.9, 0.3, 0), kFar(0.9, -1.2, 0), kBeyond(3, 0, 0);

/// Plays driver, eyes, observer and monitor, and watches that what the controller sends is lawful.
class Bench {
 public:
  explicit Bench(ControllerConfig config = test_config())
      : config_(config), controller(std::move(config)) {
    motion.utime = motion.rest_since_utime = 5 * kSecond;
    motion.action_id = -1;
    set_array(motion.num_signals, motion.commanded, std::vector<double>{-30, 0.2, 1});
  }

  /// Lets the clock run in ticks. Every second driver and monitor repeat themselves, as the
  /// simulator does, whose time stands still at rest.
  void run(double seconds) {
    for (std::int64_t end = now + std::llround(seconds * 1e6); now < end; now += kTick) {
      if (now % kSecond == 0) repeat();
      serve();
      take(controller.on_tick(now));
      expect_no_service_in_silence();
    }
  }
  /// Ticks until `holds`, 30 s at most.
  bool run_until(const std::function<bool()>& holds) {
    for (int i = 0; i < 300 && !holds(); ++i) run(0.1);
    return holds();
  }
  bool run_until_state(std::int8_t state) {
    return run_until([&] { return status.control_state == state; });
  }
  void give(const Target& target) {
    ASSERT_EQ(check(target), "");
    given_ = target;
    given_at_ = now;
    take(controller.on_pose_target(target));
  }
  void say(const motion_status_t& message) {
    motion = message;
    if (!driver_speaks) return;
    ASSERT_EQ(check(motion), "");
    driver_was_heard_ = true;
    driver_since_ = now;
    if (motion.state == motion_status_t::STATE_MOVING) settled_at_ = now;
    take(controller.on_motion_status(motion));
  }
  void show_schema() {
    body_schema_t message = to_message(schema);
    ASSERT_EQ(check(message), "");
    schema_was_heard_ = true;
    monitor_since_ = now;
    take(controller.on_body_schema(message));
  }
  void show_frame() {
    last_sight_utime_ = motion.utime + kTick;
    eyes_since_ = now;
    if (num_frames > 0) return show_tags();
    tags_seen_.clear();
    marker_poses_t poses{};
    poses.utime = motion.utime + kTick;
    take(controller.on_marker_poses(poses));
  }
  /// The frames of a rest, with the target tags that are in sight.
  void show_tags() {
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
  /// As the simulator does: the time goes on by a second, so that new frames come.
  void put_tag(int id, std::optional<Eigen::Vector3d> p_RM) {
    p_RM_of_tag.erase(id);
    if (p_RM) p_RM_of_tag[id] = *p_RM;
    motion_status_t message = motion;
    message.utime += kSecond;
    message.rest_since_utime = message.utime;
    set_array(message.num_signals, message.commanded, arm);
    say(message);
    show_frame();
  }
  void repeat() {
    say(motion);
    if (monitor_speaks) show_schema();
    if (!health || !monitor_speaks) return;
    heard_health_ = health;
    take(controller.on_model_health(*health));
  }
  /// Everything heard, arm at rest at the start.
  void start() {
    repeat();
    if (eyes_open) show_frame();
    run(0.5);
  }
  /// A settled move of somebody; the arm is then at `action`.
  void settle(const std::string& source, std::int64_t epoch, std::int64_t id,
              const std::vector<double>& action, std::int8_t purpose = 0) {
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
  void show_sample() {
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
      if (hidden.count(part)) continue;
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
  void answer_last_move(std::int8_t state, const std::string& reason = "") {
    answer_move(moves.back(), state, reason);
  }
  void answer_move(action_command_t command, std::int8_t state, const std::string& reason) {
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
  void stop(bool latched = true) {
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
  /// Somebody pushes the arm by hand, or lets it rest: nobody tells where.
  void push(bool is_moving) {
    motion_status_t message = motion;
    message.utime += kSecond;
    message.rest_since_utime = is_moving ? -1 : message.utime;
    set_array(message.num_signals, message.commanded, std::vector<double>{});
    say(message);
  }
  /// From now on events are `met`.
  void note_events() {
    controller.trace([this](Phase phase, Event event) { met.emplace(phase, event); });
  }
  /// Somebody else tells the driver to hold.
  void hold(std::int64_t id) {
    motion_status_t message = motion;
    message.source = "operator";
    message.epoch = 1;
    message.action_id = id;
    message.kind = action_command_t::KIND_HOLD;
    message.state = motion_status_t::STATE_HOLDING;
    set_array(message.num_signals, message.commanded, std::vector<double>{});
    say(message);
  }
  /// The driver begins anew: its time goes back.
  void set_back() {
    motion_status_t message = motion;
    message.utime = std::max<std::int64_t>(0, motion.utime - kSecond);
    message.rest_since_utime = std::min(motion.rest_since_utime, message.utime);
    say(message);
  }
  /// The controller is killed and begins anew with what it kept.
  void restart(const std::filesystem::path& file) {
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
  /// Where the schema says that the part is now.
  Eigen::Vector3d part_position() const {
    return planar().predict(1, 4, Eigen::Vector3d(arm.data()))->X_AB.translation();
  }
  bool has_why(const std::string& text) const { return status.why.find(text) != std::string::npos; }

  const ControllerConfig config_;
  Controller controller;
  control_status_t status{};
  motion_status_t motion{};
  BodySchema schema = planar();
  std::optional<model_health_t> health;
  bool driver_speaks = true, eyes_open = true, monitor_speaks = true, observer_works = true;
  bool driver_serves = true;
  bool driver_rounds = false;  ///< it counts in floats
  int num_holds_refused = 0;   ///< of the next HOLDs
  std::function<std::string(const action_command_t&)> rejects = [](const auto&) { return ""; };
  std::set<int> hidden;
  Eigen::Vector3d bend_m = Eigen::Vector3d::Zero();
  double turn_rad = 0;  ///< of part 4, too
  double observation_sd_m = 0.001;
  bool is_ambiguous = false;
  int tag = -1;  ///< by which part 4 is seen
  Pose X_CC_moved = Pose::Identity();
  int num_frames = 0;  ///< of a rest that show the target tags; 0: one without tags
  std::map<int, Eigen::Vector3d> p_RM_of_tag;  ///< those in sight
  bool covers_tags = false;                    ///< the part, where it comes to them
  double tag_jitter_m = 0;                     ///< of every second frame
  std::int64_t now = 1000 * kSecond;
  std::int64_t num_samples = 0;
  std::vector<action_command_t> moves;  ///< as served, each once
  int num_holds = 0, num_repeats = 0;
  std::vector<double> arm = {-30, 0.2, 1};
  std::set<std::pair<Phase, Event>> met;  ///< events, and the phases in which they came

 private:
  void take(const Controller::Answer& answer) {
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
      if (status.control_state == S::CONTROL_HOLDING ||
          status.control_state == S::CONTROL_REFUSED || status.control_state == S::CONTROL_RELEASED)
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
  /// All inputs of the present rest were heard, and what moved the arm before has its SAMPLE or
  /// was waited for.
  void expect_is_guarded() const {
    ASSERT_TRUE(driver_was_heard_ && schema_was_heard_);
    ASSERT_GE(motion.rest_since_utime, 0) << "moves an arm that moves";
    ASSERT_GE(last_sight_utime_, motion.rest_since_utime) << "moves unseen";
    const bool is_settled = motion.kind == action_command_t::KIND_MOVE &&
                            motion.state == motion_status_t::STATE_SETTLED;
    if (is_settled && last_sampled_id_ != motion.action_id) {
      ASSERT_GE(now - settled_at_, config_.sample_timeout_us) << "a sample is lost";
    }
    if (given_.target_kind != Target::KIND_TAG || status.target_id != given_.target_id) return;
    const Eigen::Vector3d p_RT(status.target_position_m);
    ASSERT_TRUE(tags_seen_.contains(given_.target_tag) ||
                (part_position() - p_RT).norm() <= config_.reached_m)
        << "moves to a tag that is not seen";
  }
  /// Small steps where an edge on the way is not OK.
  void expect_is_slow_in_doubt(const action_command_t& command) const {
    const bool is_in_doubt = heard_health_ && heard_health_->schema_version == schema.version &&
                             heard_health_->edge_health[0].edge_state != schema_edge_t::EDGE_OK;
    if (!is_in_doubt && command.purpose != action_command_t::PURPOSE_PROBE) return;
    for (std::size_t i = 0; i < arm.size(); ++i) {
      const Signal& signal = config_.signals[i];
      ASSERT_LE(std::abs(command.action[i] - arm[i]),
                (config_.slow_step + 1e-6) * (signal.upper - signal.lower));
    }
  }
  /// On the way no part leaves the workspace or comes into a keep-out box, by more than its origin
  /// moves between two looks.
  void expect_stays_inside(const action_command_t& command) {
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
  /// The driver answers one command a tick.
  void serve() {
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

  /// Whoever falls silent while a target is served, the arm is held within the limit.
  void expect_no_service_in_silence() {
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

  std::deque<action_command_t> commands_;
  // An answered command is answered again.
  std::set<std::int64_t> refused_holds_;
  std::map<std::int64_t, std::int8_t> refused_moves_;
  std::int64_t last_ended_id_ = -1, left_path_id_ = -1;
  std::int8_t last_kind_ = -1;
  Target given_{};
  std::int64_t given_at_ = 0;
  bool driver_was_heard_ = false, schema_was_heard_ = false;
  std::optional<model_health_t> heard_health_;
  std::set<int> tags_seen_;  // in the newest frame
  std::int64_t last_sampled_id_ = -1, settled_at_ = 0;
  std::int64_t driver_since_ = now, monitor_since_ = now, eyes_since_ = now;
  std::int64_t last_sight_utime_ = -1;
};

inline Target tag_target(std::int64_t id, int tag = 40) {
  Target target = position_target(id, Eigen::Vector3d::Zero());
  target.target_kind = Target::KIND_TAG;
  target.target_tag = tag;
  return target;
}

/// At rest, with tag 40 in sight.
inline Bench bench_with_tag(const Eigen::Vector3d& p_RM, ControllerConfig config = test_config()) {
  Bench bench(std::move(config));
  bench.num_frames = TagTrack::kFrames;
  bench.p_RM_of_tag[40] = p_RM;
  bench.start();
  return bench;
}

}  // namespace bodyschema::test
