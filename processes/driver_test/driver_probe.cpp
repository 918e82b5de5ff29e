#include "processes/driver_test/driver_probe.h"

#include <fmt/format.h>

#include <algorithm>
#include <stdexcept>
#include <utility>

#include "common/bus/convert.h"

namespace bodyschema {
namespace {

/// A motion that ends sooner than this after its command cannot be interrupted [s].
constexpr double kNoTime_s = 0.15;

}  // namespace

const char* name_of_motion_state(std::int8_t state) {
  constexpr const char* kNames[] = {"IDLE",     "ACCEPTED", "MOVING",  "SETTLED",
                                    "REJECTED", "STOPPED",  "EXPIRED", "HOLDING"};
  return state >= 0 && state < 8 ? kNames[state] : "an unknown state";
}

std::string text_of(const std::optional<motion_status_t>& status) {
  if (!status) return "nothing";
  return fmt::format("{}{} (id {} of {}, rest since {}, latched {})",
                     name_of_motion_state(status->state),
                     status->reason.empty() ? "" : ": " + status->reason, status->action_id,
                     status->source.empty() ? "nobody" : status->source, status->rest_since_utime,
                     int{status->stop_latched});
}

bool is_answer(const motion_status_t& status, const action_command_t& command) {
  return status.source == command.source && status.epoch == command.epoch &&
         status.action_id == command.action_id;
}

void expect(bool is_so, const std::string& expected, const std::optional<motion_status_t>& came) {
  if (!is_so) throw RuleBroken{"expected " + expected + ", came " + text_of(came)};
}

std::optional<motion_status_t> DriverProbe::await(std::size_t from, double seconds,
                                                  const Wanted& wanted) {
  const double end_s = link_.now_s() + seconds;
  for (std::size_t i = from;;) {
    for (; i < heard_.size(); ++i) {
      if (wanted(heard_[i])) return heard_[i];
    }
    const double left_s = end_s - link_.now_s();
    if (left_s <= 0) return std::nullopt;
    listen(std::min(left_s, 0.1));
  }
}

std::vector<motion_status_t> DriverProbe::watch(double seconds) {
  const std::size_t from = heard_.size();
  const double end_s = link_.now_s() + seconds;
  while (link_.now_s() < end_s) listen(std::min(0.1, end_s - link_.now_s()));
  return {heard_.begin() + static_cast<std::ptrdiff_t>(from), heard_.end()};
}

motion_status_t DriverProbe::await_rest(const Wanted& also) {
  const auto rest = await(heard_.size() - 1, options_.motion_s,
                          [&](const Status& s) { return s.rest_since_utime >= 0 && also(s); });
  if (!rest) {
    throw RuleBroken{fmt::format("not at rest within {} s; the newest status is {}",
                                 options_.motion_s, text_of(newest()))};
  }
  return *rest;
}

action_command_t DriverProbe::make(std::int8_t kind, const std::string& source,
                                   std::vector<double> action) {
  Command command{};
  command.utime = newest().utime;
  command.source = source;
  command.epoch = options_.epoch;
  command.action_id = source == kSource ? next_id_++ : next_other_id_++;
  command.kind = kind;
  command.purpose = Command::PURPOSE_CONTROL;
  command.expiry_utime = newest().utime + 3'600'000'000;
  set_array(command.num_signals, command.action, std::move(action));
  return command;
}

motion_status_t DriverProbe::ask(const Command& command) {
  sent_at_ = heard_.size();
  sent_s_ = link_.now_s();
  link_.send(command);
  const auto answer =
      await(sent_at_, options_.answer_s, [&](const Status& s) { return is_answer(s, command); });
  if (!answer) {
    throw RuleBroken{fmt::format("no answer within {} s to id {} of {}", options_.answer_s,
                                 command.action_id, command.source)};
  }
  return *answer;
}

std::vector<motion_status_t> DriverProbe::life(const Command& command, std::size_t from) {
  const auto end = await(from, options_.motion_s, [&](const Status& s) {
    return is_answer(s, command) && s.state != Status::STATE_ACCEPTED &&
           s.state != Status::STATE_MOVING;
  });
  if (!end) {
    throw RuleBroken{fmt::format("the motion did not end within {} s; the newest status is {}",
                                 options_.motion_s, text_of(newest()))};
  }
  std::vector<Status> said;
  for (std::size_t i = from; i < heard_.size(); ++i) {
    if (is_answer(heard_[i], command)) said.push_back(heard_[i]);
  }
  return said;
}

motion_status_t DriverProbe::settle(const std::vector<double>& action, const std::string& source) {
  const Command command = move(action, source);
  ask(command);
  const Status end = life(command).back();
  expect(end.state == Status::STATE_SETTLED, "SETTLED", end);
  return end;
}

action_command_t DriverProbe::begin_motion(const std::vector<double>& action) {
  const Command command = move(action);
  ask(command);
  const auto next = await(sent_at_, 10, [&](const Status& s) {
    return is_answer(s, command) && s.state != Status::STATE_ACCEPTED;
  });
  expect(next && next->state == Status::STATE_MOVING, "MOVING", next);
  // In lock-step everything has been said by now.
  const auto end = await(sent_at_, kNoTime_s - (link_.now_s() - sent_s_), [&](const Status& s) {
    return is_answer(s, command) && s.state == Status::STATE_SETTLED;
  });
  if (end) throw RuleSkipped{"the motion took no time"};
  return command;
}

std::vector<motion_status_t> DriverProbe::expect_unmoved(const Status& rest, double seconds) {
  const std::vector<Status> came = watch(seconds);
  for (const Status& status : came) {
    expect(status.rest_since_utime == rest.rest_since_utime,
           fmt::format("the arm at rest since {}", rest.rest_since_utime), status);
  }
  return came;
}

void DriverProbe::expect_refused(const Command& command, std::int8_t state) {
  const Status before = newest();
  const Status answer = ask(command);
  expect(answer.state == state && !answer.reason.empty(),
         std::string(name_of_motion_state(state)) + " with a reason", answer);
  expect(answer.rest_since_utime == before.rest_since_utime,
         fmt::format("the arm at rest since {}", before.rest_since_utime), answer);
  expect_unmoved(before, 0.3);
}

void DriverProbe::restart() {
  link_.restart();
  const std::size_t from = heard_.size();
  if (!await(from, options_.restart_s, [](const Status&) { return true; })) {
    throw RuleBroken{
        fmt::format("no MOTION_STATUS within {} s of the restart", options_.restart_s)};
  }
}

bool DriverProbe::recover() {
  if (newest().stop_latched) link_.send(make(Command::KIND_RESUME));
  return await(heard_.size() - 1, options_.motion_s,
               [](const Status& s) { return s.rest_since_utime >= 0 && !s.stop_latched; })
      .has_value();
}

void DriverProbe::listen(double seconds) {
  for (const Status& status : link_.receive(seconds)) {
    if (!heard_.empty() && status.utime < newest().utime && !time_ran_backwards_) {
      time_ran_backwards_ = fmt::format("utime {} came after {}", status.utime, newest().utime);
    }
    const bool is_ours = status.source == kSource || status.source == kOtherSource;
    if (!is_ours && !heard_.empty() &&
        (status.state == Status::STATE_ACCEPTED || status.state == Status::STATE_MOVING)) {
      throw std::runtime_error(status.source +
                               " moves the arm: end it, the test must be alone with the driver");
    }
    heard_.push_back(status);
  }
}

}  // namespace bodyschema
