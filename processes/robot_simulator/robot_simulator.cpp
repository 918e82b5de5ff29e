#include "processes/robot_simulator/robot_simulator.h"

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <cstring>
#include <iomanip>
#include <limits>
#include <sstream>
#include <stdexcept>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "common/config/yaml.h"

namespace bodyschema {
namespace {

constexpr double kStartTime_s = 1;
constexpr std::size_t kMaxServed = 4096;

// Quintic from 0 to 1 with zero speed and acceleration at both ends; its top speed is 15/8.
double smooth_step(double s) {
  s = std::clamp(s, 0.0, 1.0);
  return s * s * s * (10 + s * (-15 + s * 6));
}
constexpr double kSmoothStepTopSpeed = 15.0 / 8;

std::int64_t microseconds(double seconds) { return std::llround(seconds * 1e6); }

std::string name_of(const std::string& text) { return text.empty() ? "''" : text; }

// YAML's double quoted style.
std::string quoted(const std::string& text) {
  std::ostringstream result;
  result << '"';
  for (const char c : text) {
    if (c == '"' || c == '\\')
      result << '\\' << c;
    else if (static_cast<unsigned char>(c) < 0x20)
      result << ' ';
    else
      result << c;
  }
  result << '"';
  return result.str();
}

std::string list_of(const double* values, std::size_t count) {
  std::ostringstream result;
  result << std::setprecision(std::numeric_limits<double>::max_digits10) << '[';
  for (std::size_t i = 0; i < count; ++i) result << (i ? ", " : "") << values[i];
  result << ']';
  return result.str();
}

}  // namespace

RobotSimulatorConfig RobotSimulatorConfig::load(const std::filesystem::path& file) {
  const Yaml yaml = Yaml::load(file);
  RobotSimulatorConfig config;
  config.rig_folder = file.parent_path();
  config.speed_share = yaml.number("speed_share", 0.01, 1);
  const Yaml settled = yaml.section("settled");
  config.settled_speed = settled.number("speed_deg_per_s", 1e-6, 10) * (M_PI / 180);
  config.settled_for_s = settled.number("for_s", 0.002, 10);
  config.settle_timeout_s = settled.number("timeout_s", 0.1, 1000);
  config.repeat_us = microseconds(yaml.number("repeat_s", 0.01, 60));
  yaml.finish();
  return config;
}

RobotSimulator::RobotSimulator(RobotSimulatorConfig config)
    : config_(std::move(config)),
      scene_(config_.rig_folder),
      data_(scene_.make_data()),
      trial_(scene_.make_data()) {
  for (const int part : config_.hidden_parts) {
    if (scene_.plate_geoms(part).empty()) {
      throw std::invalid_argument("the rig has no part " + std::to_string(part) + " to hide");
    }
  }
  data_->time = kStartTime_s;
  rest_since_utime_ = microseconds(kStartTime_s);
  action_command_t none{};
  none.action_id = -1;
  none.num_signals = static_cast<std::int32_t>(scene_.robot().home.size());
  none.action.assign(scene_.robot().home.begin(), scene_.robot().home.end());
  status_ = answer_to(none, motion_status_t::STATE_IDLE, "");
  update_state(-1);
}

std::string RobotSimulator::refusal(const action_command_t& command) const {
  if (stop_latched_) return "stopped: RESUME first";
  const std::vector<Signal>& signals = scene_.signals().signals;
  if (command.action.size() != signals.size()) {
    return "the robot has " + std::to_string(signals.size()) + " signals, the action " +
           std::to_string(command.action.size());
  }
  for (std::size_t i = 0; i < signals.size(); ++i) {
    const double value = command.action[i];
    if (!std::isfinite(value)) return "signal " + signals[i].name + " is not a finite number";
    if (value < signals[i].lower || value > signals[i].upper) {
      std::ostringstream text;
      text << "signal " << signals[i].name << " = " << value << " is outside its limits "
           << signals[i].lower << " … " << signals[i].upper;
      return text.str();
    }
  }
  return "";
}

std::optional<std::string> RobotSimulator::move(mjData& trial,
                                                const Eigen::VectorXd& target) const {
  const mjModel& model = scene_.model();
  const std::vector<RobotJoint>& joints = scene_.robot().joints;
  const Eigen::VectorXd start = scene_.joint_positions(trial);
  // All joints start and stop together, the slowest at its top speed.
  double duration_s = 0.1;
  for (std::size_t i = 0; i < joints.size(); ++i) {
    duration_s = std::max(duration_s, kSmoothStepTopSpeed * std::abs(target[i] - start[i]) /
                                          (joints[i].max_speed * config_.speed_share));
  }
  const double step_s = model.opt.timestep;
  const int ramp_steps = static_cast<int>(std::ceil(duration_s / step_s));
  const int quiet_needed = static_cast<int>(std::ceil(config_.settled_for_s / step_s));
  const int max_steps = ramp_steps + static_cast<int>(config_.settle_timeout_s / step_s);
  int quiet = 0;
  for (int step = 1; step <= max_steps; ++step) {
    const double s = smooth_step(static_cast<double>(step) / ramp_steps);
    for (std::size_t i = 0; i < joints.size(); ++i) {
      trial.ctrl[i] = start[i] + s * (target[i] - start[i]);
    }
    mj_step1(&model, &trial);
    if (const auto problem = scene_.collision(trial)) return problem;
    // Gravity and Coriolis forces are known to a real arm's controller as well; this version of
    // MuJoCo has no option for it.
    mju_copy(trial.qfrc_applied, trial.qfrc_bias, model.nv);
    mj_step2(&model, &trial);

    const double fastest = mju_norm(trial.qvel, model.nv);
    if (!std::isfinite(fastest)) return "the simulation became unstable";
    quiet = step >= ramp_steps && fastest < config_.settled_speed ? quiet + 1 : 0;
    if (quiet >= quiet_needed) return std::nullopt;
  }
  return "the arm would not come to rest";
}

motion_status_t RobotSimulator::answer_to(const action_command_t& command, std::int8_t state,
                                          const std::string& reason) const {
  motion_status_t status{};
  status.utime = microseconds(data_->time);
  status.source = command.source;
  status.epoch = command.epoch;
  status.action_id = command.action_id;
  status.kind = command.kind;
  status.purpose = command.purpose;
  status.state = state;
  status.reason = reason;
  status.rest_since_utime = rest_since_utime_;
  status.stop_latched = stop_latched_;
  // What is not a number must not travel on.
  std::vector<double> commanded = command.action;
  for (double& value : commanded) {
    if (!std::isfinite(value)) value = 0;
  }
  set_array(status.num_signals, status.commanded, std::move(commanded));
  return status;
}

RobotSimulator::Answer RobotSimulator::on_command(const action_command_t& command) {
  for (const Served& served : served_) {
    if (served.action_id == command.action_id && served.epoch == command.epoch &&
        served.source == command.source) {
      // The answer was lost, or the command was sent twice: what holds now is what was said then,
      // but for the latch, which may have changed since.
      motion_status_t again = served.status;
      again.stop_latched = stop_latched_;
      return {{again}, std::nullopt};
    }
  }

  Answer answer;
  const auto conclude = [&](std::int8_t state, const std::string& reason) {
    answer.statuses.push_back(answer_to(command, state, reason));
    finish(answer.statuses.back());
  };
  switch (command.kind) {
    case action_command_t::KIND_HOLD:
      conclude(motion_status_t::STATE_HOLDING, "");
      return answer;
    case action_command_t::KIND_STOP:
      stop_latched_ = true;
      conclude(motion_status_t::STATE_STOPPED, "STOP by " + name_of(command.source));
      return answer;
    case action_command_t::KIND_RESUME:
      stop_latched_ = false;
      conclude(motion_status_t::STATE_IDLE, "");
      return answer;
    case action_command_t::KIND_MOVE:
      break;
    default:
      conclude(motion_status_t::STATE_REJECTED, "unknown kind of command");
      return answer;
  }

  if (command.action.size() != scene_.signals().signals.size()) {
    // Answered, not remembered: it is for another robot, whose ids may be the same as ours.
    answer.statuses.push_back(
        answer_to(command, motion_status_t::STATE_REJECTED, refusal(command)));
    return answer;
  }
  const std::int64_t now = microseconds(data_->time);
  if (command.expiry_utime < now) {
    conclude(motion_status_t::STATE_EXPIRED,
             "expired " + std::to_string(now - command.expiry_utime) + " us ago");
    return answer;
  }
  if (const std::string reason = refusal(command); !reason.empty()) {
    conclude(motion_status_t::STATE_REJECTED, reason);
    return answer;
  }
  const Eigen::VectorXd target = scene_.robot().joint_positions(
      Eigen::Map<const Eigen::VectorXd>(command.action.data(), command.action.size()));
  if (const auto reason = scene_.robot().beyond_range(target)) {
    conclude(motion_status_t::STATE_REJECTED, *reason);
    return answer;
  }
  mj_copyData(trial_.get(), &scene_.model(), data_.get());
  if (const auto reason = move(*trial_, target)) {
    conclude(motion_status_t::STATE_REJECTED, *reason);
    return answer;
  }

  answer.statuses.push_back(answer_to(command, motion_status_t::STATE_ACCEPTED, ""));
  motion_status_t moving = answer_to(command, motion_status_t::STATE_MOVING, "");
  moving.rest_since_utime = -1;
  answer.statuses.push_back(moving);
  std::swap(data_, trial_);
  // At rest the joints' positions are all there is: what a restart restores is then the same.
  scene_.set_joint_positions(*data_, scene_.joint_positions(*data_));
  rest_since_utime_ = microseconds(data_->time - config_.settled_for_s);
  conclude(motion_status_t::STATE_SETTLED, "");
  update_state(command.action_id);
  answer.state = state_;
  return answer;
}

void RobotSimulator::finish(const motion_status_t& status) {
  status_ = status;
  served_.push_back({status.source, status.epoch, status.action_id, status});
  if (served_.size() > kMaxServed) served_.pop_front();
}

RobotSimulator::Answer RobotSimulator::on_tick(std::int64_t now_us) {
  if (now_us - last_repeat_us_ < config_.repeat_us) return {};
  last_repeat_us_ = now_us;
  return {{status_}, state_};
}

void RobotSimulator::update_state(std::int64_t action_id) {
  state_ = scene_.state(*data_);
  state_.action_id = action_id;
  state_.seed = config_.seed;
  for (const int part : config_.hidden_parts) {
    for (const int geom : scene_.plate_geoms(part)) state_.geom_alpha[geom] = 0;
  }
}

void RobotSimulator::save(const std::filesystem::path& file) const {
  const Eigen::VectorXd positions = scene_.joint_positions(*data_);
  std::ostringstream text;
  text << "# robot_simulator at rest. Joint positions in rad or m, times in us.\n"
       << "robot: " << quoted(scene_.robot().name) << "\n"
       << "seed: " << config_.seed << "\n"
       << "time_s: " << list_of(&data_->time, 1) << "\n"
       << "rest_since_us: " << rest_since_utime_ << "\n"
       << "stop_latched: " << (stop_latched_ ? "true" : "false") << "\n"
       << "joint_positions: " << list_of(positions.data(), positions.size()) << "\n"
       << "state_action_id: " << state_.action_id << "\n"
       << "last: {source: " << quoted(status_.source) << ", epoch: " << status_.epoch
       << ", action_id: " << status_.action_id << ", kind: " << int{status_.kind}
       << ", purpose: " << int{status_.purpose} << ", state: " << int{status_.state}
       << ", reason: " << quoted(status_.reason)
       << ", commanded: " << list_of(status_.commanded.data(), status_.commanded.size()) << "}\n";
  write_file_atomically(file, text.str());
}

void RobotSimulator::restore(const std::filesystem::path& file) {
  const Yaml yaml = Yaml::load(file);
  if (yaml.text("robot") != scene_.robot().name) {
    throw yaml.error("robot", "this is the state of another robot than " + scene_.robot().name);
  }
  const std::int64_t seed = yaml.integer("seed");
  const double time_s = yaml.numbers("time_s", 1)[0];
  const std::int64_t rest_since = yaml.integer("rest_since_us", 0);
  const bool stop_latched = yaml.boolean("stop_latched");
  const std::vector<double> positions =
      yaml.numbers("joint_positions", static_cast<int>(scene_.robot().joints.size()));
  const std::int64_t state_action_id = yaml.integer("state_action_id");
  const Yaml last = yaml.section("last");
  action_command_t command{};
  command.source = last.text("source");
  command.epoch = last.integer("epoch");
  command.action_id = last.integer("action_id");
  command.kind = static_cast<std::int8_t>(last.integer("kind", 0, 3));
  command.purpose = static_cast<std::int8_t>(last.integer("purpose", 0, 3));
  const auto state = static_cast<std::int8_t>(last.integer("state", 0, 7));
  const std::string reason = last.text("reason");
  command.action = last.numbers("commanded");
  yaml.finish();

  config_.seed = seed;
  rest_since_utime_ = rest_since;
  stop_latched_ = stop_latched;
  data_->time = time_s;
  scene_.set_joint_positions(*data_,
                             Eigen::Map<const Eigen::VectorXd>(positions.data(), positions.size()));
  const motion_status_t status = answer_to(command, state, reason);
  served_.clear();
  if (status.action_id >= 0) finish(status);
  status_ = status;
  update_state(state_action_id);
}

}  // namespace bodyschema
