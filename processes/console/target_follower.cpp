#include "processes/console/target_follower.h"

#include <fmt/format.h>

#include <limits>
#include <tuple>
#include <vector>

#include "processes/console/hint.h"
#include "processes/console/names.h"

namespace bodyschema {
namespace {

using S = control_status_t;

constexpr std::int64_t kTargetPeriod_us = 1'000'000;
constexpr std::int64_t kSilent_us = 3'000'000;
constexpr char kDriver[] = "the driver";

}  // namespace

std::string course_text(const control_status_t& status) {
  const auto distance = [](double m, double rad) {
    return rad < 0 ? fmt::format("{:.1f} mm", m * 1e3)
                   : fmt::format("{:.1f} mm and {:.2f}°", m * 1e3, rad / kDegree);
  };
  std::string text = counted(status.num_moves, "move");
  if (status.num_probes > 0) text += ", " + counted(status.num_probes, "probe") + " among them";
  if (status.predicted_error_m >= 0)
    text += ", by the schema " + distance(status.predicted_error_m, status.predicted_error_rad) +
            " away";
  if (status.observed_error_m >= 0)
    text += ", as seen " + distance(status.observed_error_m, status.observed_error_rad);
  return text;
}

action_command_t make_console_command(std::int8_t kind, std::int64_t epoch,
                                      std::int64_t action_id) {
  action_command_t command{};
  command.source = kConsole;
  command.epoch = epoch;
  command.action_id = action_id;
  command.kind = kind;
  command.purpose = action_command_t::PURPOSE_CONTROL;
  // Whenever it comes, it is still meant.
  command.expiry_utime = std::numeric_limits<std::int64_t>::max();
  return command;
}

TargetFollower::TargetFollower(pose_target_t target, std::int64_t timeout_us,
                               SeenTolerance tolerance)
    : target_(std::move(target)), timeout_us_(timeout_us), tolerance_(tolerance) {
  status_.target_id = status_.schema_version = status_.target_part = -1;
  status_.predicted_error_m = status_.observed_error_m = -1;
  status_.predicted_error_rad = status_.observed_error_rad = -1;
}

void TargetFollower::on_control_status(const control_status_t& status) {
  has_controller_ = true;
  if (end_ != End::kOpen) return;
  const auto mine = std::tie(target_.epoch, target_.target_id);
  const auto newest = std::tie(status.target_epoch, status.target_id);
  if (newest != mine) {
    // An older one: not heard yet, or the controller was restarted and does not go on by itself.
    is_acknowledged_ = false;
    if (newest > mine) {
      status_ = status;
      status_.why = "another target, a hold or a release came after it, from " + status.sender;
      end_ = End::kRefused;
    }
    return;
  }
  is_acknowledged_ = true;
  had_arm_ |= status.owns_arm == 1;
  status_ = status;
  const std::int8_t state = status.control_state;
  if (target_.target_kind == pose_target_t::KIND_HOLD) {
    if (state == S::CONTROL_HOLDING) end_ = End::kAsked;
  } else if (target_.target_kind == pose_target_t::KIND_RELEASE) {
    if (state == S::CONTROL_RELEASED) end_ = End::kAsked;
  } else if (state == S::CONTROL_REACHED || state == S::CONTROL_RELEASED) {
    // RELEASED: it was kept for keep_s and given back.
    const bool is_missed =
        status.observed_error_m > tolerance_.m || status.observed_error_rad > tolerance_.rad;
    end_ = is_missed ? End::kMissed : End::kAsked;
  } else if (state == S::CONTROL_REFUSED || state == S::CONTROL_HOLDING) {
    end_ = End::kRefused;
  }
}

void TargetFollower::on_process_info(const process_info_t& info) {
  heard_at_us_[info.process_name] = now_us_;
}

void TargetFollower::on_motion_status(const motion_status_t&) { heard_at_us_[kDriver] = now_us_; }

std::optional<pose_target_t> TargetFollower::on_tick(std::int64_t now_us) {
  now_us_ = now_us;
  if (started_us_ < 0) started_us_ = now_us;
  if (end_ == End::kOpen && now_us - started_us_ >= timeout_us_) end_ = End::kTimedOut;
  if (end_ != End::kOpen || is_acknowledged_) return std::nullopt;
  if (sent_us_ >= 0 && now_us - sent_us_ < kTargetPeriod_us) return std::nullopt;
  sent_us_ = now_us;
  return target_;
}

void TargetFollower::interrupt() {
  if (end_ == End::kOpen) end_ = End::kInterrupted;
}

pose_target_t TargetFollower::withdrawal() const {
  pose_target_t target{};
  target.utime = target_.utime;
  target.sender = target_.sender;
  target.epoch = target_.epoch;
  target.target_id = target_.target_id + 1;
  target.target_part = -1;
  target.keep_s = -1;
  // A controller that did not acknowledge may have the arm, and the target in its queue.
  // Nor does it go back to the babbler because it is lent to it.
  const bool is_babblers = is_acknowledged_ && !had_arm_ && status_.owns_arm == 0;
  target.target_kind = is_babblers ? pose_target_t::KIND_RELEASE : pose_target_t::KIND_HOLD;
  return target;
}

std::string TargetFollower::progress() const {
  if (!is_acknowledged_)
    return has_controller_ ? "waiting for the controller to take up the target"
                           : "waiting for the controller";
  return fmt::format("{} · {} · {}", name_in(kControlStates, status_.control_state),
                     course_text(status_), status_.why);
}

std::string TargetFollower::diagnosis() const {
  std::vector<std::string> silent = {"controller", "camera",        "marker_estimator",
                                     "observer",   "model_monitor", kDriver};
  std::erase_if(silent, [this](const std::string& name) {
    const auto heard = heard_at_us_.find(name);
    return heard != heard_at_us_.end() && now_us_ - heard->second <= kSilent_us;
  });
  if (!silent.empty()) {
    // Nobody owes a word as soon as that.
    if (now_us_ - started_us_ < kSilent_us) return "too soon to tell who is silent";
    return "silent: " + listed(silent);
  }
  return is_acknowledged_ ? "the controller says: " + status_.why
                          : "the controller does not acknowledge the target";
}

Json target_json(const control_status_t& status, TargetFollower::End end) {
  using End = TargetFollower::End;
  const char* state = end == End::kTimedOut      ? "timed out"
                      : end == End::kInterrupted ? "interrupted"
                      : end == End::kMissed      ? "missed"
                                                 : name_in(kControlStates, status.control_state);
  const auto degrees = [](double rad) -> Json {
    return rad < 0 ? Json(nullptr) : Json(rad / kDegree);
  };
  return {{"reached", end == End::kAsked},
          {"state", state},
          {"why", status.why},
          {"predicted_error_m", known(status.predicted_error_m)},
          {"observed_error_m", known(status.observed_error_m)},
          {"predicted_error_deg", degrees(status.predicted_error_rad)},
          {"observed_error_deg", degrees(status.observed_error_rad)},
          {"moves", status.num_moves},
          {"probes", status.num_probes},
          {"schema_version", status.schema_version}};
}

LatchFollower::LatchFollower(std::int8_t kind, std::int64_t epoch)
    : command_(make_console_command(kind, epoch, 0)) {}

void LatchFollower::on_motion_status(const motion_status_t& motion) {
  has_heard_driver_ = true;
  if (sent_us_ < 0) return;
  is_done_ = (motion.stop_latched == 1) == (command_.kind == action_command_t::KIND_STOP);
}

std::optional<action_command_t> LatchFollower::on_tick(std::int64_t now_us) {
  if (is_done_ || (sent_us_ >= 0 && now_us - sent_us_ < kCommandPeriod_us)) return std::nullopt;
  sent_us_ = now_us;
  return command_;
}

}  // namespace bodyschema
