#include "processes/robot_driver_example/robot_driver_example.h"

#include <algorithm>
#include <cmath>
#include <sstream>

#include "common/bus/convert.h"
#include "common/config/yaml.h"

namespace bodyschema {
namespace {

using Command = action_command_t;
using Status = motion_status_t;

constexpr std::size_t kMaxServed = 4096;
/// Largest lead of the record over driver's time, when it is written: a restarted driver is ahead
/// of the clock by no more than this. And the lead that is left when the record is renewed.
constexpr std::int64_t kAheadUs = 5'000'000;
constexpr std::int64_t kLeftUs = 1'000'000;
/// Driver's time that is ahead of the clock by less than this runs at half speed until they meet;
/// a larger lead means that the clock was set back, and it is ignored.
constexpr std::int64_t kMeetUs = 10'000'000;

bool is_refusal(const Status& status) {
  return status.state == Status::STATE_REJECTED || status.state == Status::STATE_EXPIRED;
}

}  // namespace

RobotDriverConfig RobotDriverConfig::load(const std::filesystem::path& file) {
  const Yaml yaml = Yaml::load(file);
  RobotDriverConfig config;
  config.signals = load_signals(file.parent_path());
  std::filesystem::path device = yaml.text("device");
  if (device.is_relative()) device = file.parent_path() / device;
  config.device = device;
  config.silent_us = std::llround(1e6 * yaml.number("silent_s", 0.2, 10));
  config.motion_timeout_us = std::llround(1e6 * yaml.number("motion_timeout_s", 0.1, 3600));
  config.repeat_us = std::llround(1e6 * yaml.number("repeat_s", 0.1, 1));
  yaml.finish();
  return config;
}

// The robot's protocol -----------------------------------------------------------------------

std::optional<RobotDriver::Report> RobotDriver::parse(const std::string& line) const {
  std::istringstream words(line);
  std::string at, state;
  Report report;
  if (!(words >> at >> report.order >> state) || at != "AT") return std::nullopt;
  if (state != "REST" && state != "MOVING") return std::nullopt;
  report.is_moving = state == "MOVING";
  for (double q; words >> q;) report.position.push_back(q);
  if (!words.eof() || report.position.size() != config_.signals.signals.size()) return std::nullopt;
  return report;
}

std::string RobotDriver::go(const std::vector<double>& action) {
  unheard_halt_.clear();
  std::ostringstream line;
  line.precision(15);
  line << "GO " << ++order_;
  for (const double q : action) line << ' ' << q;
  return line.str();
}

std::string RobotDriver::halt() { return unheard_halt_ = "HALT " + std::to_string(++order_); }

// --------------------------------------------------------------------------------------------

RobotDriver::RobotDriver(RobotDriverConfig config, std::optional<motion_status_t> record, Save save,
                         Now now)
    : config_(std::move(config)), save_(std::move(save)) {
  // R3: not even if the clock was set back meanwhile.
  utime_ = start_ = std::max(now.clock_us, record ? record->utime + 1 : 0);
  steady_ = now.steady_us;
  said_at_ = tried_at_ = steady_ - config_.repeat_us;
  // A report that was on its way when the last driver died must not pass for an answer.
  order_ = start_ / 1000;
  if (record) {
    // R15: nobody watched the end of the motion.
    if (record->state == Status::STATE_ACCEPTED || record->state == Status::STATE_MOVING ||
        record->state == Status::STATE_SETTLED) {
      record->state = Status::STATE_STOPPED;
      record->reason = "the driver was restarted during or after this motion";
    }
    is_stopped_ = is_stop_recorded_ = record->stop_latched != 0;  // R17
    status_ = *record;
    if (status_.action_id >= 0) served_.push_back(status_);
  } else {
    status_.action_id = -1;
  }
  status_.utime = utime_;
  status_.rest_since_utime = -1;
}

std::string RobotDriver::refusal(const Command& command) const {
  if (is_stopped_) return "halted: resume first";  // R12
  if (is_lost_) return "the robot does not answer";
  if (motion_) return "the arm moves";  // R6
  if (!is_at_rest()) return "the arm is being halted";
  const std::vector<Signal>& signals = config_.signals.signals;
  if (command.action.size() != signals.size()) {  // R5
    return "the robot has " + std::to_string(signals.size()) + " signals, the action " +
           std::to_string(command.action.size());
  }
  for (std::size_t i = 0; i < signals.size(); ++i) {
    const double q = command.action[i];
    // Written so that NaN is refused as well.
    if (!(q >= signals[i].lower && q <= signals[i].upper)) {
      std::ostringstream text;
      text << "signal " << signals[i].name << " = " << q << " is outside its limits "
           << signals[i].lower << " … " << signals[i].upper;
      return text.str();
    }
  }
  // A driver refuses collisions here: with the robot's own check, or a model of the cell.
  return "";
}

Status RobotDriver::make_status(const Command& command, std::int8_t state,
                                const std::string& reason) const {
  Status status{};
  status.utime = utime_;
  status.source = command.source;
  status.epoch = command.epoch;
  status.action_id = command.action_id;
  status.kind = command.kind;
  status.purpose = command.purpose;
  status.state = state;
  status.reason = reason;
  status.rest_since_utime = rest_since_utime_;
  status.stop_latched = is_stopped_;
  std::vector<double> commanded = command.kind == Command::KIND_MOVE ? command.action : position_;
  for (double& q : commanded) {
    if (!std::isfinite(q)) q = 0;  // what is not a number must not travel on
  }
  set_array(status.num_signals, status.commanded, std::move(commanded));
  return status;
}

void RobotDriver::conclude(const Command& command, std::int8_t state, const std::string& reason,
                           Answer& answer) {
  const Status status = make_status(command, state, reason);
  answer.statuses.push_back(status);
  served_.push_back(status);
  if (served_.size() > kMaxServed) served_.pop_front();
  if (is_refusal(status)) return;  // R4: sent, not repeated
  status_ = status;
  said_at_ = steady_;
  // The record that must be on disk before the arm moves was written by on_command.
  if (state != Status::STATE_MOVING) answer.must_save = true;
}

std::string RobotDriver::save_record(Status status) {
  status.utime = utime_ + kAheadUs;
  status.stop_latched = is_stopped_;
  tried_at_ = steady_;
  record_problem_ = save_(status);
  if (record_problem_.empty()) {
    record_utime_ = status.utime;
    is_stop_recorded_ = is_stopped_;
  }
  return record_problem_;
}

void RobotDriver::save(Answer& answer) {
  if (answer.must_save) {
    const bool was_told = is_stopped_ && !is_stop_recorded_ && !record_problem_.empty();
    if (save_record(status_).empty() && was_told) refresh_status(answer);
  }
  if (is_stop_recorded_ || record_problem_.empty()) return;
  for (Status& status : answer.statuses) {  // R17
    if (status.kind == Command::KIND_STOP && status.stop_latched) {
      status.reason += "; a restart of the driver would forget it: " + record_problem_;
    }
  }
}

std::optional<Status> RobotDriver::answer_again(const Command& command) const {
  // Backwards: a MOVE has several answers, the newest holds.
  for (auto served = served_.rbegin(); served != served_.rend(); ++served) {
    if (served->source != command.source || served->epoch != command.epoch ||
        served->action_id != command.action_id) {
      continue;
    }
    const bool is_newest = status_.source == command.source && status_.epoch == command.epoch &&
                           status_.action_id == command.action_id;
    Status again = is_newest ? status_ : *served;
    again.utime = utime_;
    again.rest_since_utime = rest_since_utime_;
    again.stop_latched = is_stopped_;
    const bool is_where =
        again.state == Status::STATE_SETTLED || again.state == Status::STATE_HOLDING;
    if (is_where && !is_newest) {
      again.state = Status::STATE_STOPPED;
      again.reason = "was carried out; the arm may have moved since";
    }
    if (again.kind != Command::KIND_MOVE) {
      set_array(again.num_signals, again.commanded, position_);  // where the arm is
    }
    return again;
  }
  return std::nullopt;
}

RobotDriver::Answer RobotDriver::on_command(const Command& command, Now now) {
  advance_time(now);
  Answer answer;
  if (const auto again = answer_again(command)) {  // R8
    answer.statuses.push_back(*again);
    return answer;
  }

  const std::string kLost = "the robot does not answer; it is halted when it does";
  switch (command.kind) {
    case Command::KIND_HOLD:  // R10, R11
      answer.lines.push_back(halt());
      interrupt("HOLD by " + command.source, answer);
      conclude(command, is_lost_ ? Status::STATE_STOPPED : Status::STATE_HOLDING,
               is_lost_ ? kLost : "", answer);
      return answer;
    case Command::KIND_STOP:  // R12, R13
      answer.lines.push_back(halt());
      is_stopped_ = true;
      interrupt("halted by " + command.source, answer);
      conclude(command, Status::STATE_STOPPED, is_lost_ ? kLost : "halted by " + command.source,
               answer);
      return answer;
    case Command::KIND_RESUME:  // R14
      is_stopped_ = false;
      conclude(command, Status::STATE_IDLE, "", answer);
      return answer;
    default:
      break;
  }

  if (command.utime < start_) {  // R16
    conclude(command, Status::STATE_EXPIRED, "sent before this start of the driver", answer);
    return answer;
  }
  if (command.expiry_utime < utime_) {  // R7
    conclude(command, Status::STATE_EXPIRED,
             "expired " + std::to_string(utime_ - command.expiry_utime) + " us ago", answer);
    return answer;
  }
  if (const std::string reason = refusal(command); !reason.empty()) {
    conclude(command, Status::STATE_REJECTED, reason, answer);
    return answer;
  }
  // R15: a driver that is killed from here on must know what it had begun.
  const Status accepted = make_status(command, Status::STATE_ACCEPTED, "");
  if (const std::string problem = save_record(accepted); !problem.empty()) {
    conclude(command, Status::STATE_REJECTED, "no record of the motion: " + problem, answer);
    return answer;
  }
  answer.statuses.push_back(accepted);
  answer.lines.push_back(go(command.action));
  motion_ = command;
  motion_since_ = steady_;
  rest_since_utime_ = -1;
  conclude(command, Status::STATE_MOVING, "", answer);  // R2
  return answer;
}

void RobotDriver::interrupt(const std::string& reason, Answer& answer) {
  if (!motion_) return;
  const Command motion = *motion_;
  motion_.reset();
  conclude(motion, Status::STATE_STOPPED, reason, answer);
}

void RobotDriver::lose(const std::string& reason, Answer& answer) {
  if (is_lost_) return;
  is_lost_ = true;
  rest_since_utime_ = -1;
  // A silent robot may still hear.
  if (is_open_) answer.lines.push_back(halt());
  interrupt(reason, answer);
  // The position of the arm is unknown: it is neither settled nor holding.
  status_.state = Status::STATE_STOPPED;
  status_.reason = reason;
  refresh_status(answer);
}

void RobotDriver::refresh_status(Answer& answer) {
  status_.utime = utime_;
  status_.rest_since_utime = rest_since_utime_;
  status_.stop_latched = is_stopped_;
  if (status_.kind != Command::KIND_MOVE || status_.action_id < 0) {
    set_array(status_.num_signals, status_.commanded, position_);
  }
  said_at_ = steady_;
  answer.statuses.push_back(status_);
}

RobotDriver::Answer RobotDriver::on_connect(Now now) {
  advance_time(now);
  is_open_ = true;
  return {{halt(), "?"}, {}};
}

RobotDriver::Answer RobotDriver::on_disconnect(const std::string& problem, Now now) {
  advance_time(now);
  is_open_ = false;
  Answer answer;
  lose(problem, answer);
  return answer;
}

RobotDriver::Answer RobotDriver::on_line(const std::string& line, Now now) {
  advance_time(now);
  Answer answer;
  const std::optional<Report> report = parse(line);
  if (!report) {
    ++num_strange_lines_;
    return answer;
  }
  // Older than the newest order, which for a robot that was lost is a HALT.
  if (report->order != order_) return answer;
  heard_at_ = steady_;
  unheard_halt_.clear();
  is_lost_ = false;
  position_ = report->position;
  if (report->is_moving) {
    if (!motion_ && is_at_rest()) {
      // By its pendant, or by hand.
      rest_since_utime_ = -1;
      status_.state = Status::STATE_STOPPED;
      status_.reason = "the robot moves without a command";
      answer.lines.push_back(halt());
      refresh_status(answer);
    }
    return answer;
  }
  if (is_at_rest()) return answer;
  rest_since_utime_ = utime_;
  if (motion_) {
    const Command motion = *motion_;
    motion_.reset();
    conclude(motion, Status::STATE_SETTLED, "", answer);
  } else {
    refresh_status(answer);
  }
  return answer;
}

RobotDriver::Answer RobotDriver::on_tick(Now now) {
  advance_time(now);
  Answer answer;
  if (is_open_ && !unheard_halt_.empty()) {
    answer.lines.push_back(unheard_halt_);  // under its number: a late echo of the first one counts
  }
  if (!is_lost_ && steady_ - heard_at_ > config_.silent_us) {
    lose("the robot has been silent for " + std::to_string(steady_ - heard_at_) + " us", answer);
  }
  if (motion_ && steady_ - motion_since_ > config_.motion_timeout_us) {
    answer.lines.push_back(halt());
    interrupt("the motion did not end in time", answer);
  }
  if (is_open_) answer.lines.push_back("?");
  if (steady_ - said_at_ >= config_.repeat_us) refresh_status(answer);
  const bool is_record_old = !record_problem_.empty() || record_utime_ - utime_ < kLeftUs;
  if (is_record_old && steady_ - tried_at_ >= config_.repeat_us) answer.must_save = true;
  return answer;
}

RobotDriver::Answer RobotDriver::on_end(Now now) {
  advance_time(now);
  Answer answer;
  answer.lines = {halt(), "?"};
  interrupt("the driver was told to end", answer);
  return answer;
}

void RobotDriver::advance_time(Now now) {
  const std::int64_t elapsed = std::max<std::int64_t>(0, now.steady_us - steady_);
  steady_ += elapsed;
  // R3: the clock may be set back.
  const bool is_guide = utime_ + elapsed - now.clock_us < kMeetUs;
  utime_ = std::max(now.clock_us, utime_ + (is_guide ? elapsed / 2 : elapsed));
}

}  // namespace bodyschema
