#include "processes/robot_simulator/robot_simulator.h"

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <cstring>
#include <sstream>
#include <stdexcept>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "common/config/yaml.h"
#include "common/geometry/angle.h"
#include "processes/robot_simulator/saved_status.h"

namespace bodyschema {
namespace {

constexpr double kStartTime_s = 1;
/// Number of answers that are remembered, and of the newest that survive a restart.
constexpr std::size_t kMaxServed = 4096;
constexpr std::size_t kMaxSaved = 64;
constexpr double kFaultTakes_s = 1;

// Quintic from 0 to 1 with zero speed and acceleration at both ends; its top speed is 15/8.
double smooth_step(double s) {
  s = std::clamp(s, 0.0, 1.0);
  return s * s * s * (10 + s * (-15 + s * 6));
}
constexpr double kSmoothStepTopSpeed = 15.0 / 8;

std::int64_t microseconds(double seconds) { return std::llround(seconds * 1e6); }

SceneDescription as_built(const RobotSimulatorConfig& config) {
  return SceneDescription::load(config.rig_folder,
                                config.is_ideal ? std::nullopt : std::optional(config.seed));
}

std::string name_of(const std::string& text) { return text.empty() ? "''" : text; }

/// True if the status answers this command; an id counts within source and epoch.
bool is_same_command(const motion_status_t& status, const std::string& source, std::int64_t epoch,
                     std::int64_t action_id) {
  return status.action_id == action_id && status.epoch == epoch && status.source == source;
}

Fault load_fault(const Yaml& yaml) {
  Fault fault;
  fault.kind = static_cast<std::int8_t>(yaml.integer("kind", 0, fault_command_t::FAULT_TARGET));
  fault.place = yaml.text("place");
  fault.number = static_cast<int>(yaml.integer("number", -1, 1'000'000));
  const std::vector<double> amounts = yaml.numbers("amount_bent_deg", 2);
  fault.amount_deg = amounts[0];
  fault.bent_deg = amounts[1];
  fault.fallen = yaml.vector3("fallen");
  fault.target_m = yaml.vector3("target_m");
  return fault;
}

}  // namespace

RobotSimulatorConfig RobotSimulatorConfig::load(const std::filesystem::path& file) {
  const Yaml yaml = Yaml::load(file);
  RobotSimulatorConfig config;
  config.rig_folder = file.parent_path();
  config.speed_share = yaml.number("speed_share", 0.01, 1);
  const Yaml settled = yaml.section("settled");
  config.settled_speed_rad_per_s = settled.number("speed_deg_per_s", 1e-6, 10) * kDegree;
  config.settled_speed_m_per_s = settled.number("speed_mm_per_s", 1e-6, 10) / 1000;
  config.settled_for_s = settled.number("for_s", 0.002, 10);
  config.settle_timeout_s = settled.number("timeout_s", 0.1, 1000);
  config.repeat_us = microseconds(yaml.number("repeat_s", 0.01, 60));
  yaml.finish();
  return config;
}

RobotSimulator::Body::Body(SceneDescription description)
    : scene(std::move(description)), data(scene.make_data()), trial(scene.make_data()) {}

RobotSimulator::RobotSimulator(RobotSimulatorConfig config)
    : config_(std::move(config)),
      as_built_(as_built(config_)),
      body_(as_built_),
      play_(Eigen::VectorXd::Zero(as_built_.robot.joints.size())) {
  const Scene whole(config_.rig_folder);  // its start pose must not collide
  for (const int part : config_.hidden_parts) {
    if (scene().plate_geoms(part).empty()) {
      throw std::invalid_argument("the rig has no part " + std::to_string(part) + " to hide");
    }
  }
  body_.data->time = kStartTime_s;
  rest_since_utime_ = start_utime_ = microseconds(kStartTime_s);
  const Eigen::VectorXd& home = as_built_.robot.home;
  at_.assign(home.begin(), home.end());
  action_command_t none{};
  none.action_id = -1;
  status_ = answer_to(none, motion_status_t::STATE_IDLE, "");
  update_state(-1);
}

std::string RobotSimulator::refusal(const action_command_t& command) const {
  if (stop_latched_) return "halted: resume first";
  const std::vector<Signal>& signals = scene().signals().signals;
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

std::optional<std::string> RobotSimulator::move(Body& body, const Eigen::VectorXd& target) const {
  const mjModel& model = body.scene.model();
  mj_copyData(body.trial.get(), &model, body.data.get());
  mjData& trial = *body.trial;
  const std::vector<RobotJoint>& joints = body.scene.robot().joints;
  const Eigen::VectorXd start = body.scene.joint_positions(trial);
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
  const double compensated_share = 1 - body.scene.robot().calibration_error.droop_share;
  int quiet = 0;
  for (int step = 1; step <= max_steps; ++step) {
    const double s = smooth_step(static_cast<double>(step) / ramp_steps);
    for (std::size_t i = 0; i < joints.size(); ++i) {
      trial.ctrl[i] = start[i] + s * (target[i] - start[i]);
    }
    mj_step1(&model, &trial);
    if (const auto problem = body.scene.collision(trial)) return problem;
    // Gravity and Coriolis forces are known to a real arm's controller as well; this version of
    // MuJoCo has no option for it. The uncompensated share lets the arm droop.
    mju_scl(trial.qfrc_applied, trial.qfrc_bias, compensated_share, model.nv);
    mj_step2(&model, &trial);

    // Each joint's speed as a multiple of its own limit: rad/s and m/s do not add up.
    double speed2 = 0;
    for (std::size_t i = 0; i < joints.size(); ++i) {
      const double limit = joints[i].kind == RobotJoint::Kind::kRevolute
                               ? config_.settled_speed_rad_per_s
                               : config_.settled_speed_m_per_s;
      const double speed = body.scene.joint_speed(trial, static_cast<int>(i)) / limit;
      speed2 += speed * speed;
    }
    if (!std::isfinite(speed2)) return "the simulation became unstable";
    quiet = step >= ramp_steps && speed2 < 1 ? quiet + 1 : 0;
    if (quiet >= quiet_needed) return std::nullopt;
  }
  return "the arm would not come to rest";
}

motion_status_t RobotSimulator::answer_to(const action_command_t& command, std::int8_t state,
                                          const std::string& reason) const {
  motion_status_t status{};
  status.utime = microseconds(body_.data->time);
  status.source = command.source;
  status.epoch = command.epoch;
  status.action_id = command.action_id;
  status.kind = command.kind;
  status.purpose = command.purpose;
  status.state = state;
  status.reason = reason;
  status.rest_since_utime = rest_since_utime_;
  status.stop_latched = stop_latched_;
  std::vector<double> commanded =
      command.kind == action_command_t::KIND_MOVE && command.action_id >= 0 ? command.action : at_;
  // NaN must not travel on.
  for (double& value : commanded) {
    if (!std::isfinite(value)) value = 0;
  }
  set_array(status.num_signals, status.commanded, std::move(commanded));
  return status;
}

motion_status_t RobotSimulator::answer_again(const motion_status_t& served) const {
  motion_status_t again = served;
  again.utime = microseconds(body_.data->time);
  again.rest_since_utime = rest_since_utime_;
  again.stop_latched = stop_latched_;
  // A receiver of SETTLED or HOLDING may look at the arm: it must be there.
  const bool is_where = served.state == motion_status_t::STATE_SETTLED ||
                        served.state == motion_status_t::STATE_HOLDING;
  if (is_where && served.commanded != at_) {
    again.state = motion_status_t::STATE_STOPPED;
    again.reason = "was carried out; the arm has moved on since";
  }
  // An answer that echoes no action has the arm's position.
  if (served.kind != action_command_t::KIND_MOVE) again.commanded = at_;
  return again;
}

RobotSimulator::Answer RobotSimulator::on_command(const action_command_t& command) {
  for (const motion_status_t& served : served_) {
    // The answer was lost, or the command was sent twice.
    if (is_same_command(served, command.source, command.epoch, command.action_id)) {
      return {{answer_again(served)}, std::nullopt};
    }
  }

  Answer answer;
  const auto conclude = [&](std::int8_t state, const std::string& reason) {
    answer.statuses.push_back(answer_to(command, state, reason));
    remember(answer.statuses.back());
  };
  switch (command.kind) {
    case action_command_t::KIND_HOLD:
      conclude(motion_status_t::STATE_HOLDING, "");
      return answer;
    case action_command_t::KIND_STOP:
      stop_latched_ = true;
      conclude(motion_status_t::STATE_STOPPED, "halted by " + name_of(command.source));
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

  if (command.action.size() != scene().signals().signals.size()) {
    // Answered, not remembered: it is for another robot, whose ids may be the same as ours.
    answer.statuses.push_back(
        answer_to(command, motion_status_t::STATE_REJECTED, refusal(command)));
    return answer;
  }
  const std::int64_t now = microseconds(body_.data->time);
  if (command.utime < start_utime_) {
    conclude(motion_status_t::STATE_EXPIRED, "sent before this start of the driver");
    return answer;
  }
  if (command.expiry_utime < now) {
    conclude(motion_status_t::STATE_EXPIRED,
             "expired " + std::to_string(now - command.expiry_utime) + " us ago");
    return answer;
  }
  if (const std::string reason = refusal(command); !reason.empty()) {
    conclude(motion_status_t::STATE_REJECTED, reason);
    return answer;
  }

  if (const std::string reason = carry_out(command, &answer); !reason.empty())
    conclude(motion_status_t::STATE_REJECTED, reason);
  return answer;
}

std::string RobotSimulator::carry_out(const action_command_t& command, Answer* answer) {
  // Drifts proceed while the arm moves, unless an obstacle keeps a link from bending further.
  std::vector<Fault> faults = faults_;
  std::optional<Body> drifted;
  if (drift(faults)) drifted = body_with(faults, nullptr);
  Body& body = drifted ? *drifted : body_;

  const Eigen::VectorXd target = body.scene.robot().joint_positions(
      Eigen::Map<const Eigen::VectorXd>(command.action.data(), command.action.size()));
  if (const auto reason = body.scene.robot().beyond_range(target)) return *reason;
  if (const auto reason = move(body, target)) return *reason;

  answer->statuses.push_back(answer_to(command, motion_status_t::STATE_ACCEPTED, ""));
  motion_status_t moving = answer_to(command, motion_status_t::STATE_MOVING, "");
  moving.rest_since_utime = -1;
  answer->statuses.push_back(moving);
  if (drifted) {
    body_ = *std::move(drifted);
    faults_ = faults;
  }
  const Eigen::VectorXd before = joint_positions() + play_;
  std::swap(body_.data, body_.trial);
  // At rest the joints' positions are all there is: what a restart restores is then the same.
  Eigen::VectorXd positions = scene().joint_positions(*body_.data);
  for (std::size_t i = 0; i < scene().robot().joints.size(); ++i) {
    positions[i] = scene().robot().joints[i].stuck_at.value_or(positions[i]);
  }
  scene().set_joint_positions(*body_.data, positions);
  follow(before);
  rest_since_utime_ = microseconds(body_.data->time - config_.settled_for_s);
  at_ = command.action;
  answer->statuses.push_back(answer_to(command, motion_status_t::STATE_SETTLED, ""));
  remember(answer->statuses.back());
  update_state(command.action_id);
  answer->state = state_;
  return "";
}

std::optional<RobotSimulator::Body> RobotSimulator::body_with(const std::vector<Fault>& faults,
                                                              std::string* problem) const {
  const Eigen::VectorXd positions = joint_positions();
  Body body(broken(as_built_, faults, positions, config_.seed));
  body.data->time = body_.data->time;
  body.scene.set_joint_positions(*body.data, positions);
  if (const auto collision = body.scene.collision(*body.data)) {
    if (problem) *problem = *collision;
    return std::nullopt;
  }
  return body;
}

RobotSimulator::Answer RobotSimulator::on_fault(const fault_command_t& command) {
  const FaultKey key{command.sender, command.epoch, command.fault_id};
  if (std::find(served_faults_.begin(), served_faults_.end(), key) != served_faults_.end()) {
    return {{}, state_};
  }
  served_faults_.push_back(key);
  if (served_faults_.size() > kMaxSaved) served_faults_.pop_front();

  std::vector<Fault> faults = faults_;
  fault_answer_ = add_fault(command, scene(), *body_.data, faults);
  Answer answer;
  if (fault_answer_.empty()) {
    std::string problem;
    if (std::optional<Body> body = body_with(faults, &problem)) {
      body_ = *std::move(body);
      faults_ = std::move(faults);
      body_.data->time += kFaultTakes_s;
      rest_since_utime_ = status_.rest_since_utime = status_.utime = microseconds(body_.data->time);
      answer.statuses.push_back(status_);
    } else {
      fault_answer_ = "here it would be in " + problem + ": move the arm elsewhere first";
    }
  }
  update_state(state_.action_id);
  answer.state = state_;
  return answer;
}

void RobotSimulator::remember(const motion_status_t& status) {
  // A refusal is sent once, and again when asked again; the answer to an accepted command is
  // repeated.
  if (status.state != motion_status_t::STATE_REJECTED &&
      status.state != motion_status_t::STATE_EXPIRED) {
    status_ = status;
  }
  served_.push_back(status);
  if (served_.size() > kMaxServed) served_.pop_front();
}

RobotSimulator::Answer RobotSimulator::on_tick(std::int64_t now_us) {
  if (now_us - last_repeat_us_ < config_.repeat_us) return {};
  last_repeat_us_ = now_us;
  return {{status_}, state_};
}

void RobotSimulator::follow(const Eigen::VectorXd& before) {
  const Robot& robot = scene().robot();
  const Eigen::VectorXd positions = joint_positions();
  for (std::size_t i = 0; i < robot.joints.size(); ++i) {
    if (robot.joints[i].kind != RobotJoint::Kind::kRevolute) continue;
    play_[i] = play_after(positions[i], before[i], robot.calibration_error.backlash_rad);
  }
}

void RobotSimulator::update_state(std::int64_t action_id) {
  state_ = scene().state(*body_.data);
  if (!play_.isZero(0)) {
    scene().set_joint_positions(*body_.trial, joint_positions() + play_);
    state_.X_WG = scene().state(*body_.trial).X_WG;
  }
  state_.action_id = action_id;
  state_.seed = config_.seed;
  state_.is_ideal = config_.is_ideal ? 1 : 0;
  for (const int part : config_.hidden_parts) {
    for (const int geom : scene().plate_geoms(part)) state_.geom_alpha[geom] = 0;
  }
  state_.fault_epoch = served_faults_.empty() ? 0 : served_faults_.back().epoch;
  state_.fault_id = served_faults_.empty() ? -1 : served_faults_.back().fault_id;
  state_.fault_answer = fault_answer_;
  std::vector<std::string> faults;
  for (const Fault& fault : faults_) faults.push_back(describe(fault, as_built_));
  set_array(state_.num_faults, state_.faults, std::move(faults));
}

void RobotSimulator::save(const std::filesystem::path& file) const {
  const Eigen::VectorXd positions = joint_positions();
  std::ostringstream text;
  text << "# robot_simulator at rest. Joint positions in rad or m, times in us.\n"
       << "robot: " << yaml_quoted(as_built_.robot.name) << "\n"
       << "seed: " << config_.seed << "\n"
       << "is_ideal: " << (config_.is_ideal ? "true" : "false") << "\n"
       << "time_s: " << yaml_list({body_.data->time}) << "\n"
       << "rest_since_us: " << rest_since_utime_ << "\n"
       << "stop_latched: " << (stop_latched_ ? "true" : "false") << "\n"
       << "joint_positions: " << yaml_list({positions.begin(), positions.end()}) << "\n"
       << "play: " << yaml_list({play_.begin(), play_.end()}) << "\n"
       << "at: " << yaml_list(at_) << "\n"
       << "state_action_id: " << state_.action_id << "\n"
       << "last: " << saved_status(status_) << "\n"
       << "served:" << (served_.empty() ? " []" : "") << "\n";
  for (std::size_t i = served_.size() - std::min(served_.size(), kMaxSaved); i < served_.size();
       ++i) {
    text << "  - " << saved_status(served_[i]) << "\n";
  }
  text << "faults:" << (faults_.empty() ? " []" : "") << "\n";
  for (const Fault& fault : faults_) {
    text << "  - {kind: " << int{fault.kind} << ", place: " << yaml_quoted(fault.place)
         << ", number: " << fault.number
         << ", amount_bent_deg: " << yaml_list({fault.amount_deg, fault.bent_deg})
         << ", fallen: " << yaml_list({fault.fallen.begin(), fault.fallen.end()})
         << ", target_m: " << yaml_list({fault.target_m.begin(), fault.target_m.end()}) << "}\n";
  }
  text << "fault_answer: " << yaml_quoted(fault_answer_) << "\n"
       << "served_faults:" << (served_faults_.empty() ? " []" : "") << "\n";
  for (const FaultKey& key : served_faults_) {
    text << "  - {sender: " << yaml_quoted(key.sender) << ", epoch: " << key.epoch
         << ", fault_id: " << key.fault_id << "}\n";
  }
  write_file_atomically(file, text.str());
}

void RobotSimulator::restore(const std::filesystem::path& file) {
  try {
    restore_from(Yaml::load(file));
  } catch (const ConfigError& error) {
    throw ConfigError(std::string(error.what()) +
                      "; the saved state cannot be continued: put a good copy in its place, or "
                      "delete it to start anew at the start pose");
  }
}

void RobotSimulator::restore_from(const Yaml& yaml) {
  if (yaml.text("robot") != as_built_.robot.name) {
    throw yaml.error("robot", "this is the state of another robot than " + as_built_.robot.name);
  }
  const int num_joints = static_cast<int>(as_built_.robot.joints.size());
  const int num_signals = static_cast<int>(as_built_.signals.signals.size());
  RobotSimulatorConfig config = config_;
  config.seed = yaml.integer("seed");
  config.is_ideal = yaml.boolean("is_ideal");
  const double time_s = yaml.numbers("time_s", 1)[0];
  const std::int64_t rest_since = yaml.integer("rest_since_us", 0);
  const bool stop_latched = yaml.boolean("stop_latched");
  const std::vector<double> positions = yaml.numbers("joint_positions", num_joints);
  const std::vector<double> play = yaml.numbers("play", num_joints);
  const std::vector<double> at = yaml.numbers("at", num_signals);
  const std::int64_t state_action_id = yaml.integer("state_action_id", -1);
  const motion_status_t last = load_status(yaml.section("last"));
  std::deque<motion_status_t> served;
  for (const Yaml& item : yaml.list("served")) served.push_back(load_status(item));
  std::vector<Fault> faults;
  for (const Yaml& item : yaml.list("faults")) faults.push_back(load_fault(item));
  const std::string fault_answer = yaml.text("fault_answer");
  std::deque<FaultKey> served_faults;
  for (const Yaml& item : yaml.list("served_faults")) {
    served_faults.push_back(
        {item.text("sender"), item.integer("epoch", 0), item.integer("fault_id", 0)});
  }
  yaml.finish();

  const Eigen::VectorXd joints = Eigen::Map<const Eigen::VectorXd>(positions.data(), num_joints);
  std::optional<Body> body;
  SceneDescription built = as_built(config);
  try {
    body.emplace(broken(built, faults, joints, config.seed));
  } catch (const std::exception& error) {
    throw yaml.error("faults", error.what());
  }
  as_built_ = std::move(built);
  body_ = *std::move(body);
  faults_ = std::move(faults);
  config_ = std::move(config);
  play_ = Eigen::Map<const Eigen::VectorXd>(play.data(), num_joints);
  at_ = at;
  rest_since_utime_ = rest_since;
  stop_latched_ = stop_latched;
  body_.data->time = time_s;
  start_utime_ = microseconds(time_s);
  scene().set_joint_positions(*body_.data, joints);
  served_ = std::move(served);
  fault_answer_ = fault_answer;
  served_faults_ = std::move(served_faults);
  status_ = last;
  status_.utime = start_utime_;
  status_.rest_since_utime = rest_since_utime_;
  status_.stop_latched = stop_latched_;
  update_state(state_action_id);
}

}  // namespace bodyschema
