#include "processes/console/target_follower.h"

#include <fmt/format.h>

#include <limits>
#include <tuple>
#include <utility>
#include <vector>

#include "processes/console/hint.h"
#include "processes/console/names.h"
#include "processes/console/views/json.h"

namespace bodyschema {
namespace {

using S = control_status_t;

constexpr std::int64_t kTargetPeriod_us = 1'000'000;
constexpr std::int64_t kSilent_us = 3'000'000;
constexpr char kDriver[] = "the driver";

}  // namespace

std::string course_text(const control_status_t& status) {
  std::string text = counted(status.num_moves, "move");
  if (status.predicted_error_m >= 0)
    text += fmt::format(", by the schema {:.1f} mm away", status.predicted_error_m * 1e3);
  if (status.observed_error_m >= 0)
    text += fmt::format(", as seen {:.1f} mm", status.observed_error_m * 1e3);
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

TargetFollower::TargetFollower(pose_target_t target, std::int64_t timeout_us, double tolerance_m)
    : target_(std::move(target)), timeout_us_(timeout_us), tolerance_m_(tolerance_m) {
  status_.target_id = status_.schema_version = status_.target_part = -1;
  status_.predicted_error_m = status_.observed_error_m = -1;
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
      status_.why = "a newer target of " + status.sender + " took its place";
      end_ = End::kRefused;
    }
    return;
  }
  is_acknowledged_ = true;
  status_ = status;
  const std::int8_t state = status.control_state;
  if (target_.target_kind == pose_target_t::KIND_HOLD) {
    if (state == S::CONTROL_HOLDING) end_ = End::kAsked;
  } else if (target_.target_kind == pose_target_t::KIND_RELEASE) {
    if (state == S::CONTROL_RELEASED) end_ = End::kAsked;
  } else if (state == S::CONTROL_REACHED || state == S::CONTROL_RELEASED) {
    // RELEASED: it was kept for keep_s and given back.
    end_ = status.observed_error_m > tolerance_m_ ? End::kMissed : End::kAsked;
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
  const bool is_babblers = is_acknowledged_ && status_.owns_arm == 0;
  target.target_kind = is_babblers ? pose_target_t::KIND_RELEASE : pose_target_t::KIND_HOLD;
  return target;
}

std::string TargetFollower::progress() const {
  if (!is_acknowledged_) {
    return has_controller_ ? "waiting for the controller to take up the target"
                           : "waiting for the controller";
  }
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

std::string target_json(const control_status_t& status, TargetFollower::End end) {
  using End = TargetFollower::End;
  const char* state = end == End::kTimedOut      ? "timed out"
                      : end == End::kInterrupted ? "interrupted"
                      : end == End::kMissed      ? "missed"
                                                 : name_in(kControlStates, status.control_state);
  const Json json = {{"reached", end == End::kAsked},
                     {"state", state},
                     {"why", status.why},
                     {"predicted_error_m", known(status.predicted_error_m)},
                     {"observed_error_m", known(status.observed_error_m)},
                     {"moves", status.num_moves},
                     {"schema_version", status.schema_version}};
  return json.dump();
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
