#include "processes/console/commands/session.h"

#include <fmt/format.h>

#include <chrono>
#include <cstdlib>
#include <iostream>
#include <stdexcept>

#include "common/bus/arguments.h"
#include "common/bus/channels.h"
#include "common/bus/convert.h"
#include "common/bus/rest_position.h"
#include "common/text/clock.h"
#include "common/text/text.h"
#include "processes/console/hint.h"
#include "processes/console/interruption.h"
#include "processes/console/progress_line.h"

namespace bodyschema {
namespace {

constexpr std::int64_t kAlone_us = 2'500'000;  // twice what the processes of a group repeat in
constexpr std::int64_t kGone_us = 10'000'000;  // everybody was heard once, and nobody for so long
constexpr std::chrono::milliseconds kTurn{50};

}  // namespace

std::function<std::string(const std::string&)> within(double lowest, double highest) {
  return [=](const std::string& text) {
    char* end = nullptr;
    const auto value = static_cast<double>(std::strtold(text.c_str(), &end));
    const bool is_number = !text.empty() && *end == '\0';
    return is_number && value >= lowest && value <= highest
               ? std::string()
               : fmt::format("expected a number within {} … {}, found '{}'", lowest, highest,
                             abbreviated(text));
  };
}

void fail() {
  if (!std::cout.flush()) throw std::runtime_error("stdout: the result could not be written");
  end_as_failed();
}

pose_target_t make_target(std::int8_t kind) {
  pose_target_t target{};
  target.utime = target.epoch = wall_clock_us();
  target.sender = kConsole;
  target.target_kind = kind;
  target.target_part = -1;
  target.keep_s = -1;
  return target;
}

void Heard::listen(Bus& bus) {
  bus.subscribe(kBodySchema, [this](const body_schema_t& m) { schema = from_message(m); });
  bus.subscribe(kMotionStatus, [this](const motion_status_t& m) { motion = m; });
}

std::optional<Eigen::VectorXd> Heard::position() const {
  if (!schema || !motion) return std::nullopt;
  return rest_position(*motion, schema->signals.size());
}

Session::Session(const std::string& url) : bus(url, url), url_(url), start_us_(clock_us()) {
  catch_interruption();
  const auto hear = [this](const auto& channel, auto on_message) {
    bus.subscribe(channel, [this, on_message](const auto& m) {
      heard_us_ = clock_us();
      if (follower_) (follower_->*on_message)(m);
    });
  };
  hear(kControlStatus, &TargetFollower::on_control_status);
  hear(kProcessInfo, &TargetFollower::on_process_info);
  hear(kMotionStatus, &TargetFollower::on_motion_status);
}

void Session::turn(std::int64_t most_us, const std::function<bool()>& is_done,
                   const std::function<void(std::int64_t)>& on_turn) {
  const std::int64_t end_us = clock_us() + most_us;
  while (!is_done() && clock_us() < end_us && !is_interrupted()) {
    if (on_turn) on_turn(clock_us());
    bus.handle(kTurn);
  }
}

void Session::follow(TargetFollower& follower, const std::function<void(std::int64_t)>& on_turn,
                     const std::string& prefix) {
  follower_ = &follower;
  ProgressLine line;
  while (follower.end() == TargetFollower::End::kOpen) {
    if (is_interrupted()) follower.interrupt();
    if (const auto target = follower.on_tick(clock_us())) bus.publish(kPoseTarget, *target);
    if (on_turn) on_turn(clock_us());
    line.show(prefix + follower.progress());
    bus.handle(kTurn);
    expect_company();
  }
  follower_ = nullptr;
}

control_status_t Session::follow_to_end(TargetFollower& follower, double timeout_s,
                                        const std::string& prefix) {
  follow(follower, nullptr, prefix);
  control_status_t status = follower.status();
  if (follower.end() == TargetFollower::End::kInterrupted)
    status.why = "interrupted; " + withdraw(follower);
  if (follower.end() == TargetFollower::End::kTimedOut)
    status.why = fmt::format("no end within {} s; {}; {}", timeout_s, follower.diagnosis(),
                             withdraw(follower));
  return status;
}

bool Session::is_in_company() const { return heard_us_ >= 0 && clock_us() - heard_us_ < kGone_us; }

void Session::expect_company() const {
  if (heard_us_ >= 0 && !is_in_company())
    throw std::runtime_error(fmt::format(
        "the group on {} fell silent: nothing was heard for {:.0f} s. Was it stopped? ./run --keep "
        "starts one",
        url_, static_cast<double>(kGone_us) * 1e-6));
  if (heard_us_ >= 0 || clock_us() - start_us_ < kAlone_us) return;
  throw std::runtime_error("nothing is heard on " + url_ +
                           ": no group runs there. ./run --keep starts one, ./run exec bodyschema "
                           "… speaks to one that runs");
}

std::string Session::withdraw(const TargetFollower& follower) {
  clear_interruption();  // a second Ctrl-C ends this too
  const pose_target_t withdrawal = follower.withdrawal();
  TargetFollower dropped(withdrawal, kPatience_us);
  follow(dropped);
  switch (dropped.end()) {
    case TargetFollower::End::kAsked:
      return withdrawal.target_kind == pose_target_t::KIND_HOLD
                 ? "the target was dropped: the arm is held until another target or: " +
                       to_type("release")
                 : "the target was dropped: the arm is the babbler's";
    case TargetFollower::End::kRefused:
      return dropped.status().why;
    default:
      return "the controller does not say that it dropped the target, so the arm may move; it is "
             "stopped by: " +
             to_type("halt");
  }
}

const char* ending(TargetFollower::End end, const control_status_t& status) {
  if (end == TargetFollower::End::kAsked) return "";
  if (end == TargetFollower::End::kMissed) return "missed: ";
  if (status.control_state == control_status_t::CONTROL_HOLDING) return "held: ";
  return status.control_state == control_status_t::CONTROL_REFUSED ? "refused: " : "not reached: ";
}

}  // namespace bodyschema
