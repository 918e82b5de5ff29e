#include "processes/controller/controller.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <cstring>
#include <sstream>
#include <tuple>
#include <utility>

#include "common/bus/convert.h"
#include "common/bus/process.h"
#include "common/config/yaml.h"

namespace bodyschema {
namespace {

using S = control_status_t;

constexpr char kSource[] = "controller";
constexpr char kHalted[] = "the arm is halted; first: ./run resume (or bodyschema resume)";
constexpr char kWasHalted[] = "the arm was halted; it is resumed: give the target again";
constexpr char kHeldAsBefore[] = "held as before the restart: ";
constexpr std::int64_t kRepeat_us = 1'000'000;
constexpr int kMaxExpired = 3;         // in a row
constexpr double kMovedCamera = 33.1;  // chi^2_6(0.99999): the camera is not where the schema says
constexpr double kSurprise = 14.2;     // chi^2_3(0.9973): what is seen refutes the schema
constexpr int kLentForProbe = 8;       // samples: the babbler probes after every fifth, a TEST
constexpr double kArrived = 1e-9;      // of a range

std::int64_t microseconds(double seconds) { return std::llround(seconds * 1e6); }

std::string millimetres(double m) {
  std::ostringstream text;
  text.precision(1);
  text << std::fixed << m * 1e3 << " mm";
  return text.str();
}

std::string seconds(std::int64_t us) {
  std::ostringstream text;
  text << static_cast<double>(us) / 1e6 << " s";
  return text.str();
}

std::string name_of(std::int64_t action_id, const std::string& source) {
  return "action " + std::to_string(action_id) + " of " + source;
}

Eigen::VectorXd vector_of(const std::vector<double>& values) {
  return Eigen::Map<const Eigen::VectorXd>(values.data(), static_cast<Eigen::Index>(values.size()));
}

Eigen::Vector3d position_of(const pose_target_t& target) {
  return Eigen::Map<const Eigen::Vector3d>(target.position_m);
}

bool is_same_action(const motion_status_t& motion, const sample_t& sample) {
  return motion.source == sample.source && motion.epoch == sample.epoch &&
         motion.action_id == sample.action_id;
}

bool is_same_action(const sample_t& a, const sample_t& b) {
  return a.source == b.source && a.epoch == b.epoch && a.action_id == b.action_id;
}

bool is_same(const control_status_t& a, const control_status_t& b) {
  const auto fields = [](const control_status_t& s) {
    return std::tie(s.sender, s.target_epoch, s.target_id, s.control_state, s.owns_arm, s.why,
                    s.schema_version, s.target_part, s.predicted_error_m, s.observed_error_m,
                    s.num_moves);
  };
  return fields(a) == fields(b) &&
         std::equal(std::begin(a.target_position_m), std::end(a.target_position_m),
                    std::begin(b.target_position_m));
}

}  // namespace

ControllerConfig ControllerConfig::load(const std::filesystem::path& file) {
  const Yaml yaml = Yaml::load(file);
  ControllerConfig config;
  config.signals = load_signals(file.parent_path()).signals;
  config.measurement = load_noise(file.parent_path()).measurement;
  config.reached_m = yaml.number("reached_m", 1e-6, 1);
  config.max_step = yaml.number("max_step", 1e-3, 1);
  config.slow_step = yaml.number("slow_step", 1e-3, config.max_step);
  config.max_corrections = static_cast<int>(yaml.integer("max_corrections", 0, 100));
  config.max_correction_m = yaml.number("max_correction_m", 0, 1);
  config.max_solutions = static_cast<int>(yaml.integer("max_solutions", 1, 1000));
  config.expiry_us = microseconds(yaml.number("expiry_s", 0.1, 3600));
  config.resend_us = microseconds(yaml.number("resend_s", 0.1, 3600));
  config.take_us = microseconds(yaml.number("take_s", 0, 60));
  config.sample_timeout_us = microseconds(yaml.number("sample_timeout_s", 0.1, 3600));
  config.rest_timeout_us = microseconds(yaml.number("rest_timeout_s", 1, 3600));
  config.lent_timeout_us = microseconds(yaml.number("lent_timeout_s", 1, 36'000));
  const Yaml silence = yaml.section("silence");
  const auto limit = [&](const char* key) { return microseconds(silence.number(key, 0.5, 60)); };
  config.max_motion_status_silence_us = limit("motion_status_s");
  config.max_marker_poses_silence_us = limit("marker_poses_s");
  config.max_body_schema_silence_us = limit("body_schema_s");
  const Yaml ik = yaml.section("inverse_kinematics");
  config.inverse_kinematics.tolerance_m = ik.number("tolerance_m", 1e-9, config.reached_m);
  config.inverse_kinematics.damping_m = ik.number("damping_m", 1e-4, 100);
  config.inverse_kinematics.max_iterations =
      static_cast<int>(ik.integer("max_iterations", 1, 10'000));
  config.inverse_kinematics.max_starts = static_cast<int>(ik.integer("max_starts", 1, 1000));
  yaml.finish();
  return config;
}

Controller::Controller(ControllerConfig config) : config_(std::move(config)) {
  target_.target_id = -1;
  target_.target_part = -1;
}

// ---- what is told

control_status_t Controller::status() const {
  control_status_t status{};
  status.utime = motion_ ? motion_->utime : 0;
  status.sender = target_.sender;
  status.target_epoch = target_.epoch;
  status.target_id = target_.target_id;
  status.control_state = state_;
  status.owns_arm = owns_arm_;
  status.why = why_;
  status.schema_version = schema_ ? schema_->version : -1;
  status.target_part = target_.target_part;
  std::copy(std::begin(target_.position_m), std::end(target_.position_m),
            std::begin(status.target_position_m));
  status.predicted_error_m = predicted_error_m_;
  status.observed_error_m = observed_error_m_;
  status.num_moves = num_moves_;
  return status;
}

Controller::Answer Controller::answer(Command command, std::int64_t now_us) {
  Answer result{std::move(command), std::nullopt};
  const control_status_t status = this->status();
  const bool is_due = now_us >= 0 && status_age_.elapsed_us(now_us) >= kRepeat_us;
  if (is_due || !told_ || !is_same(*told_, status)) {
    result.status = told_ = status;
    status_age_.restart(now_us);
  }
  return result;
}

void Controller::enter(std::int8_t control_state, bool owns_arm, std::string why) {
  state_ = control_state;
  owns_arm_ = owns_arm;
  why_ = std::move(why);
}

void Controller::refuse(const std::string& why) {
  forget_plan();
  is_taken_ = false;
  enter(S::CONTROL_REFUSED, false, why);
}

void Controller::halt(const std::string& why) {
  forget_plan();
  command_.reset();
  awaited_.reset();
  is_taken_ = false;
  enter(S::CONTROL_HOLDING, true, why);
}

Controller::Command Controller::hold(const std::string& why) {
  halt(why);
  return send_hold();
}

Controller::Command Controller::send_hold() {
  wants_hold_ = true;
  if (!motion_) return std::nullopt;
  wants_hold_ = false;
  hold_command_ = make_command(action_command_t::KIND_HOLD);
  hold_wait_.restart();
  return hold_command_;
}

action_command_t Controller::make_command(std::int8_t kind) {
  action_command_t command{};
  command.utime = motion_->utime;
  command.source = kSource;
  command.epoch = epoch_;
  command.action_id = next_action_id_++;
  command.kind = kind;
  command.purpose = action_command_t::PURPOSE_CONTROL;
  command.expiry_utime = motion_->utime + config_.expiry_us;
  return command;
}

// ---- what is known

bool Controller::is_active() const {
  return state_ == S::CONTROL_WAITING || state_ == S::CONTROL_MOVING ||
         state_ == S::CONTROL_REACHED || state_ == S::CONTROL_LENT;
}

std::string Controller::unheard() const {
  if (!motion_) return "MOTION_STATUS: does the driver run?";
  if (!schema_) return "BODY_SCHEMA: nothing was learned yet, or does model_monitor run?";
  if (is_at_rest() && seen_until_utime_ < motion_->rest_since_utime) {
    return "MARKER_POSES of the arm at rest: do camera and marker_estimator run?";
  }
  return "";
}

std::string Controller::silence(std::int64_t now_us) {
  // Every stopwatch is looked at on every tick: it starts when it is first seen.
  const std::int64_t motion_us = motion_silence_.elapsed_us(now_us);
  const std::int64_t schema_us = schema_silence_.elapsed_us(now_us);
  const bool is_image_due = motion_ && seen_until_utime_ < motion_->utime;
  if (!is_image_due) eyes_silence_.restart();
  const std::int64_t eyes_us = eyes_silence_.elapsed_us(now_us);
  if (motion_us > config_.max_motion_status_silence_us) {
    return "no MOTION_STATUS for " + seconds(config_.max_motion_status_silence_us) +
           ": is the driver alive?";
  }
  if (eyes_us > config_.max_marker_poses_silence_us) {
    return "no MARKER_POSES for " + seconds(config_.max_marker_poses_silence_us) +
           ": are camera and marker_estimator alive?";
  }
  if (schema_us > config_.max_body_schema_silence_us) {
    return "no BODY_SCHEMA for " + seconds(config_.max_body_schema_silence_us) +
           ": is model_monitor alive?";
  }
  return "";
}

void Controller::see(std::int64_t frame_utime) {
  // A frame from far ahead would make the eyes look open for ever.
  if (!motion_ || frame_utime > motion_->utime + config_.max_motion_status_silence_us +
                                    config_.max_marker_poses_silence_us) {
    return;
  }
  if (frame_utime <= seen_until_utime_) return;
  seen_until_utime_ = frame_utime;
  if (motion_->utime - frame_utime <= config_.max_marker_poses_silence_us) {
    eyes_silence_.restart();
  }
}

void Controller::locate() {
  if (!is_at_rest()) {
    position_.reset();
    return;
  }
  if (motion_->rest_since_utime != position_rest_utime_) position_.reset();
  const bool is_whole = motion_->commanded.size() == config_.signals.size();
  const bool is_settled = motion_->state == motion_status_t::STATE_SETTLED &&
                          motion_->kind == action_command_t::KIND_MOVE;
  // A driver that never moved, or that answers a HOLD, may say where it stands.
  const bool is_told = motion_->action_id < 0 || motion_->kind != action_command_t::KIND_MOVE;
  if (is_whole && (is_settled || is_told)) {
    position_ = vector_of(motion_->commanded);
  } else if (!position_ && sample_ && sample_->rest_begin_utime == motion_->rest_since_utime) {
    position_ = vector_of(sample_->action);
  }
  position_rest_utime_ = motion_->rest_since_utime;
}

double Controller::predicted_error_m() const {
  if (!schema_ || !position_ || target_.target_part < 0) return -1;
  const auto X_RB = schema_->predict(schema_->root, target_.target_part, *position_);
  return X_RB ? (X_RB->X_AB.translation() - position_of(target_)).norm() : -1;
}

void Controller::observe(const sample_t& message) {
  observed_error_m_ = -1;
  if (!schema_) return;
  ActionPoseSample sample = from_message(message);
  drop_moved_tags(schema_->moved_tags, &sample);
  const PartObservation* part = sample.find(target_.target_part);
  if (part == nullptr) return;
  // One view of the root is worse than the schema's mean over all: half a degree is 9 mm at 1 m.
  // Unless the camera was moved since.
  Pose X_CR = schema_->X_CR;
  if (const PartObservation* root = sample.find(schema_->root)) {
    const Vector6d off = log(X_CR.inverse() * root->X_CB);
    const Matrix6d covariance = config_.measurement.covariance(*root) + schema_->X_CR_covariance;
    if (squared_mahalanobis(off, covariance) > kMovedCamera) X_CR = root->X_CB;
  }
  observed_offset_ = position_of(target_) - X_CR.inverse() * part->X_CB.translation();
  observed_error_m_ = observed_offset_.norm();
  const Eigen::Matrix3d R_RB = (X_CR.inverse() * part->X_CB).linear();
  Eigen::Matrix3d covariance = config_.measurement.covariance(*part).topLeftCorner<3, 3>();
  if (const auto X_RB = schema_->predict(schema_->root, part->part, sample.action))
    covariance += X_RB->covariance.topLeftCorner<3, 3>();
  covariance = (R_RB * covariance * R_RB.transpose()).eval();
  // By the schema the part is at the aim.
  const Eigen::Vector3d surprise = observed_offset_ - (position_of(target_) - aim_);
  is_observation_sure_ =
      !part->X_CB_other && surprise.dot(covariance.ldlt().solve(surprise)) > kSurprise;
}

EdgeState Controller::worst_edge(std::string* name) const {
  EdgeState worst = EdgeState::kOk;
  const auto severity = [](EdgeState state) {
    return state == EdgeState::kOk ? 0 : state == EdgeState::kInvalid ? 2 : 1;
  };
  const auto chain = chain_to(*schema_, target_.target_part);
  if (!chain) return worst;
  for (const Edge& edge : chain->edges) {
    EdgeState state = edge.state;
    // The monitor's judgement is newer than the schema that it judges.
    if (health_ && health_->schema_version == schema_->version) {
      for (const edge_health_t& health : health_->edge_health) {
        if (health.health_from != edge.from || health.health_to != edge.to) continue;
        const auto judged = static_cast<EdgeState>(health.edge_state);
        if (severity(judged) > severity(state)) state = judged;
      }
    }
    if (severity(state) <= severity(worst)) continue;
    worst = state;
    if (name) *name = "edge " + std::to_string(edge.from) + "–" + std::to_string(edge.to);
  }
  // The marker by which the part is seen, and that of the root or the camera.
  if (health_ && health_->schema_version == schema_->version && worst != EdgeState::kInvalid) {
    for (const part_health_t& health : health_->part_health) {
      if (health.part_state != schema_edge_t::EDGE_INVALID ||
          (health.health_part != target_.target_part && health.health_part != schema_->root))
        continue;
      worst = EdgeState::kInvalid;
      if (name) *name = "the marker of part " + std::to_string(health.health_part);
      break;
    }
  }
  return worst;
}

std::string Controller::objection() const {
  const int part = target_.target_part;
  if (motion_->stop_latched) return kHalted;
  if (!schema_->has_part(part)) {
    return "the body schema has no part " + std::to_string(part) + "; see: ./run status";
  }
  if (!chain_to(*schema_, part)) {
    return "part " + std::to_string(part) + " is not connected to the root " +
           std::to_string(schema_->root) + " in body schema version " +
           std::to_string(schema_->version) + "; let the babbler go on learning";
  }
  return "";
}

// ---- serving a target

bool Controller::is_newer(const pose_target_t& target) const {
  return std::tie(target.epoch, target.target_id) > std::tie(floor_epoch_, floor_id_);
}

bool Controller::is_from_ahead(std::int64_t epoch, std::int64_t wall_clock_us) {
  return wall_clock_us >= 0 && epoch > wall_clock_us + kClockTolerance_us;
}

void Controller::forget_plan() {
  goal_.reset();
  rejected_.clear();
  rejection_.clear();
  num_expired_ = 0;
}

Controller::Answer Controller::on_pose_target(const pose_target_t& target,
                                              std::int64_t wall_clock_us) {
  if (is_from_ahead(target.epoch, wall_clock_us)) {
    ++counters_["POSE_TARGET from a clock ahead"];
    return answer(std::nullopt);
  }
  if (!is_newer(target)) {
    const bool is_repeated = target.epoch == floor_epoch_ && target.target_id == floor_id_;
    if (!is_repeated) ++counters_["older POSE_TARGET"];
    return answer(std::nullopt);
  }
  floor_epoch_ = target.epoch;
  floor_id_ = target.target_id;
  target_ = target;
  aim_ = position_of(target);
  forget_plan();
  num_moves_ = num_corrections_ = 0;
  predicted_error_m_ = observed_error_m_ = -1;
  wants_hold_ = false;
  hold_command_.reset();
  switch (target.target_kind) {
    case pose_target_t::KIND_HOLD:
      return answer(hold("hold, asked for by " + target.sender));
    case pose_target_t::KIND_RELEASE:
      command_.reset();
      awaited_.reset();
      is_taken_ = false;
      enter(S::CONTROL_RELEASED, false, "released by " + target.sender);
      return answer(std::nullopt);
    default:
      // An action that is under way is waited for; the arm may be the controller's already.
      guard_.restart();
      taking_.restart();
      idle_.restart();
      enter(S::CONTROL_WAITING, owns_arm_, "taking up the target");
      return answer(advance());
  }
}

Controller::Command Controller::advance() {
  if (!is_active() || state_ == S::CONTROL_REACHED || command_ || awaited_) return std::nullopt;
  if (const std::string input = unheard(); !input.empty()) {
    why_ = "waiting for " + input;
    return std::nullopt;
  }
  if (const std::string why = objection(); !why.empty()) {
    refuse(why);
    return std::nullopt;
  }
  std::string edge;
  const EdgeState worst = worst_edge(&edge);
  const bool is_probe = worst != EdgeState::kOk && health_ && health_->probe_sample > probed_;
  if (worst == EdgeState::kInvalid || is_probe) {
    goal_.reset();
    is_taken_ = false;
    if (state_ != S::CONTROL_LENT) {
      lent_.restart();
      num_lent_samples_ = 0;
    }
    is_lent_for_probe_ = worst != EdgeState::kInvalid;
    enter(S::CONTROL_LENT, false,
          is_lent_for_probe_ ? edge + " can be told two ways: the babbler has the arm for a probe"
                             : edge + " is invalid: the babbler has the arm until it is mended");
    return std::nullopt;
  }
  if (!owns_arm_ || state_ == S::CONTROL_LENT) {
    is_taken_ = false;
    taking_.restart();
    enter(S::CONTROL_WAITING, true, "taking the arm");
  }
  // Until the arm is taken, on_tick goes on.
  if (!is_taken_ || !silent_.empty() || !is_at_rest() || !position_) return std::nullopt;
  return step();
}

Controller::Command Controller::take(std::int64_t now_us) {
  const std::int64_t waited_us = taking_.elapsed_us(now_us);
  if (!is_at_rest()) {
    why_ = "waiting for the arm to come to rest";
    taking_.restart(now_us);
    return std::nullopt;
  }
  if (quiet_.elapsed_us(now_us) < config_.take_us || waited_us < config_.take_us) {
    return std::nullopt;
  }
  const bool has_patience = waited_us < config_.sample_timeout_us;
  const bool is_settled = motion_->state == motion_status_t::STATE_SETTLED &&
                          motion_->kind == action_command_t::KIND_MOVE;
  if (is_settled && has_patience && !(sample_ && is_same_action(*motion_, *sample_))) {
    why_ = "waiting for the SAMPLE of " + name_of(motion_->action_id, motion_->source);
    return std::nullopt;
  }
  if (!position_) {
    why_ = "waiting to hear where the arm is";
    if (!has_patience) {
      refuse(
          "where the arm is was not heard: neither MOTION_STATUS nor SAMPLE tell the action it "
          "rests at; release the arm, so that the babbler moves it");
    }
    return std::nullopt;
  }
  is_taken_ = true;
  return advance();
}

Controller::Command Controller::step() {
  if (!goal_) {
    const InverseKinematicsSolution solution =
        solve_position(*schema_, target_.target_part, aim_, config_.signals, *position_,
                       config_.inverse_kinematics, rejected_);
    if (solution.error_m > config_.reached_m) {
      const std::string after =
          num_moves_ > 0 ? " (after " + std::to_string(num_moves_) + " moves)" : "";
      if (num_corrections_ > 0) {
        aim_ = position_of(target_);  // beyond reach only with the correction
        return arrive();
      }
      if (rejected_.empty()) {
        predicted_error_m_ = solution.error_m;
        refuse("out of reach: within the limits part " + std::to_string(target_.target_part) +
               " comes no nearer than " + millimetres(solution.error_m) + after);
      } else {
        refuse("the driver refuses every way found" + after + ": " + rejection_);
      }
      return std::nullopt;
    }
    goal_ = solution.action;
  }
  predicted_error_m_ = predicted_error_m();

  Eigen::ArrayXd range(config_.signals.size()), lower(config_.signals.size());
  for (std::size_t i = 0; i < config_.signals.size(); ++i) {
    const Signal& signal = config_.signals[i];
    lower[static_cast<Eigen::Index>(i)] = signal.lower;
    range[static_cast<Eigen::Index>(i)] = signal.upper - signal.lower;
  }
  const Eigen::ArrayXd way = goal_->array() - position_->array();
  const double longest = (way / range).abs().maxCoeff();
  if (longest <= kArrived) return arrive();
  std::string doubtful;
  const bool is_slow = worst_edge(&doubtful) != EdgeState::kOk;
  const double share = is_slow ? config_.slow_step : config_.max_step;
  const Eigen::VectorXd action =
      longest <= share
          ? *goal_
          : (position_->array() + way * (share / longest)).max(lower).min(lower + range).matrix();
  command_ = make_command(action_command_t::KIND_MOVE);
  set_array(command_->num_signals, command_->action,
            std::vector<double>(action.begin(), action.end()));
  answer_wait_.restart();
  ++num_moves_;
  enter(S::CONTROL_MOVING, true,
        is_slow ? "in small steps: " + doubtful + " is in doubt" : "towards the target");
  return command_;
}

Controller::Command Controller::arrive() {
  if (sample_ && sample_->rest_begin_utime == motion_->rest_since_utime) observe(*sample_);
  predicted_error_m_ = predicted_error_m();
  const bool is_off = observed_error_m_ > config_.reached_m;
  if (is_off && is_observation_sure_ && num_corrections_ < config_.max_corrections &&
      observed_error_m_ <= config_.max_correction_m) {
    ++num_corrections_;
    aim_ += observed_offset_;
    goal_.reset();
    return step();
  }
  enter(S::CONTROL_REACHED, true,
        observed_error_m_ < 0 ? "reached by the schema; the part is not seen there"
        : is_off ? "reached by the schema, but seen " + millimetres(observed_error_m_) + " away"
                 : "reached, and seen there");
  keep_.restart();
  return std::nullopt;
}

Controller::Command Controller::on_own_answer(const motion_status_t& motion) {
  answer_wait_.restart();
  switch (motion.state) {
    case motion_status_t::STATE_SETTLED:
      awaited_ = command_->action_id;
      sample_wait_.restart();
      command_.reset();
      num_expired_ = 0;
      predicted_error_m_ = predicted_error_m();
      if (sample_ && is_same_action(motion, *sample_)) {
        awaited_.reset();
        observe(*sample_);
      }
      return advance();
    case motion_status_t::STATE_REJECTED:
      num_moves_ = std::max(0, num_moves_ - 1);  // it was none; the target may be another by now
      command_.reset();
      ++counters_["action rejected"];
      if (!is_at_rest()) {
        why_ = "waiting for the arm to come to rest";
        return std::nullopt;
      }
      rejection_ = motion.reason;
      if (goal_) rejected_.push_back(*goal_);
      goal_.reset();
      if (static_cast<int>(rejected_.size()) >= config_.max_solutions) {
        refuse("the driver refused " + std::to_string(rejected_.size()) + " ways: " + rejection_);
        return std::nullopt;
      }
      return advance();
    case motion_status_t::STATE_EXPIRED:
      num_moves_ = std::max(0, num_moves_ - 1);
      command_.reset();
      ++counters_["action expired"];
      if (++num_expired_ >= kMaxExpired) {
        refuse("the driver let " + std::to_string(num_expired_) +
               " actions expire; is its clock right? " + motion.reason);
        return std::nullopt;
      }
      return advance();
    case motion_status_t::STATE_STOPPED:
    case motion_status_t::STATE_HOLDING:
      halt("the driver ended the motion. " + motion.reason);
      return std::nullopt;
    default:
      return std::nullopt;
  }
}

// ---- what is heard

Controller::Answer Controller::on_motion_status(const motion_status_t& motion) {
  const std::optional<motion_status_t> previous = std::exchange(motion_, motion);
  motion_silence_.restart();
  if (epoch_ < 0) epoch_ = motion.utime;
  const bool is_mine = motion.source == kSource && motion.epoch == epoch_;
  // Where no state was kept, at least no id of a predecessor's is used again.
  if (is_mine && !previous) next_action_id_ = std::max(next_action_id_, motion.action_id + 1);
  // A refusal is said once, or repeated until the next answer; what the arm does is repeated.
  const bool is_refusal = motion.state == motion_status_t::STATE_REJECTED ||
                          motion.state == motion_status_t::STATE_EXPIRED;
  const bool began_anew = (previous && motion.utime < previous->utime) ||
                          (is_mine && !is_refusal && motion.action_id < last_done_id_);
  if (began_anew) {
    seen_until_utime_ = position_rest_utime_ = -1;
    position_.reset();
  }
  bool is_news = false;
  if (!is_refusal) {
    if (is_mine) last_done_id_ = motion.action_id;
    const Deed deed{motion.source, motion.epoch, motion.action_id, motion.state};
    is_news = std::exchange(deed_, deed) != deed;
    if (is_news) quiet_.restart();
  }
  locate();
  if (state_ == S::CONTROL_REFUSED && why_ == kHalted && !motion.stop_latched) why_ = kWasHalted;
  if (hold_command_ && is_mine && motion.action_id == hold_command_->action_id) {
    hold_command_.reset();
  }
  if (wants_hold_) return answer(send_hold());
  if (!is_active()) return answer(std::nullopt);

  if (motion.stop_latched) {
    if (state_ == S::CONTROL_WAITING && !owns_arm_) {
      refuse(kHalted);
    } else {
      halt(motion.reason + "; after ./run resume give another target, or release the arm");
    }
    return answer(std::nullopt);
  }
  if (owns_arm_ && began_anew) {
    ++counters_["driver began anew"];
    return answer(hold("the driver began anew: its time or its answers went back"));
  }
  if (owns_arm_ && is_news && previous && !is_mine) {
    if (motion.kind == action_command_t::KIND_HOLD) {
      halt(motion.source + " told the driver to hold");
      return answer(std::nullopt);
    }
    if (motion.kind == action_command_t::KIND_MOVE && state_ != S::CONTROL_REACHED) {
      is_taken_ = false;  // somebody else moved it; what was planned no longer begins here
      goal_.reset();
      taking_.restart();
    }
  }
  if (is_mine && command_ && motion.action_id == command_->action_id) {
    return answer(on_own_answer(motion));
  }
  return answer(advance());
}

Controller::Answer Controller::on_marker_poses(const marker_poses_t& poses) {
  see(poses.utime);
  return answer(advance());
}

Controller::Answer Controller::on_sample(const sample_t& sample) {
  if (!sample_ || !is_same_action(*sample_, sample)) {
    lent_.restart();
    ++num_lent_samples_;
  }
  sample_ = sample;
  // A babbler that may probe does so after its next TEST sample.
  if (state_ == S::CONTROL_LENT &&
      (sample.purpose == action_command_t::PURPOSE_PROBE || num_lent_samples_ >= kLentForProbe))
    probed_ = std::max(probed_, sample.sample_index);
  see(sample.utime);
  locate();
  if (awaited_ && sample.source == kSource && sample.epoch == epoch_ &&
      sample.action_id == *awaited_) {
    awaited_.reset();
    observe(sample);
  }
  return answer(advance());
}

Controller::Answer Controller::on_body_schema(const body_schema_t& message) {
  // An older version counts only when the newer one has fallen silent.
  if (schema_ && message.schema_version < schema_->version) {
    ++counters_["older BODY_SCHEMA"];
    return answer(std::nullopt);
  }
  schema_silence_.restart();
  if (!schema_ || message.schema_version != schema_->version) {
    schema_ = from_message(message);
    goal_.reset();
    rejected_.clear();
  }
  return answer(advance());
}

Controller::Answer Controller::on_model_health(const model_health_t& health) {
  health_ = health;
  return answer(advance());
}

Controller::Answer Controller::on_tick(std::int64_t now_us) {
  silent_ = silence(now_us);
  quiet_.elapsed_us(now_us);
  const bool is_serving =
      owns_arm_ && (state_ == S::CONTROL_WAITING || state_ == S::CONTROL_MOVING);
  if (!is_serving || command_ || awaited_) idle_.restart(now_us);
  Command command;
  if (schema_ && !owns_arm_ &&
      schema_silence_.elapsed_us(now_us) > config_.max_body_schema_silence_us) {
    // Nobody stands behind it any more; the next that is heard counts, whatever its version.
    schema_.reset();
    goal_.reset();
  }
  if (is_serving) {
    if (!silent_.empty()) {
      command = hold(silent_);
    } else if (command_) {
      if (answer_wait_.elapsed_us(now_us) >= config_.resend_us) {
        answer_wait_.restart(now_us);
        command = command_;
      }
    } else if (awaited_) {
      why_ = "waiting for the SAMPLE of " + name_of(*awaited_, kSource);
      if (sample_wait_.elapsed_us(now_us) >= config_.sample_timeout_us) {
        command = hold("no SAMPLE of " + name_of(*awaited_, kSource) + " within " +
                       seconds(config_.sample_timeout_us) + ": is the observer alive?");
      }
    } else if (idle_.elapsed_us(now_us) >= config_.rest_timeout_us) {
      refuse("given up after " + seconds(config_.rest_timeout_us) + ": " + why_);
    } else if (!is_taken_) {
      command = take(now_us);
    }
  } else if (state_ == S::CONTROL_WAITING) {
    const std::int64_t patience_us =
        std::max({config_.max_motion_status_silence_us, config_.max_marker_poses_silence_us,
                  config_.max_body_schema_silence_us});
    if (guard_.elapsed_us(now_us) > patience_us) refuse("not heard: " + unheard());
  } else if (state_ == S::CONTROL_LENT) {
    if (is_lent_for_probe_ && lent_.elapsed_us(now_us) >= config_.rest_timeout_us) {
      // Nobody probes: go on with what is known.
      if (health_) probed_ = std::max(probed_, health_->probe_sample);
      command = advance();
    } else if (lent_.elapsed_us(now_us) >= config_.lent_timeout_us) {
      refuse("no new SAMPLE for " + seconds(config_.lent_timeout_us) + " while " + why_ +
             "; does the babbler run, or is it done?");
    }
  } else if (state_ == S::CONTROL_REACHED && target_.keep_s >= 0 &&
             keep_.elapsed_us(now_us) >= microseconds(target_.keep_s)) {
    enter(S::CONTROL_RELEASED, false, why_ + "; kept for " + seconds(microseconds(target_.keep_s)));
  } else if (hold_command_ && hold_wait_.elapsed_us(now_us) >= config_.resend_us) {
    hold_wait_.restart(now_us);
    command = hold_command_;
  }
  return answer(std::move(command), now_us);
}

// ---- what survives

std::string Controller::state_text() const {
  // A target that is kept until another is a hold as well.
  const bool holds =
      state_ == S::CONTROL_HOLDING || (state_ == S::CONTROL_REACHED && target_.keep_s < 0);
  std::ostringstream text;
  text << "# controller: its own action ids, the newest target, whether the arm is its own.\n"
       << "epoch: " << epoch_ << "\n"
       << "next_action_id: " << next_action_id_ << "\n"
       << "target: {sender: " << yaml_quoted(target_.sender) << ", epoch: " << floor_epoch_
       << ", target_id: " << floor_id_ << "}\n"
       << "was_served: " << (is_active() ? "false" : "true") << "\n"
       << "owns_arm: " << (owns_arm_ ? "true" : "false") << "\n"
       << "holds: " << (holds ? "true" : "false") << "\n"
       << "why: " << yaml_quoted(holds ? why_ : "") << "\n";
  return text.str();
}

void Controller::restore(const std::filesystem::path& file, std::int64_t wall_clock_us) {
  const Yaml yaml = Yaml::load(file);
  epoch_ = yaml.integer("epoch", -1);
  next_action_id_ = yaml.integer("next_action_id", 0);
  const Yaml target = yaml.section("target");
  const std::string sender = target.text("sender");
  std::int64_t epoch = target.integer("epoch", 0);
  std::int64_t id = target.integer("target_id", -1);
  const bool was_served = yaml.boolean("was_served");
  const bool owns_arm = yaml.boolean("owns_arm");
  const bool holds = yaml.boolean("holds");
  std::string why = yaml.text("why");
  yaml.finish();
  const std::string name = "target " + std::to_string(id) + " of " + sender;
  if (is_from_ahead(epoch, wall_clock_us)) {
    epoch = 0;
    id = -1;
    ++counters_["POSE_TARGET from a clock ahead"];
  }
  floor_epoch_ = epoch;
  // A sender repeats what was not acknowledged: then the same target counts again.
  floor_id_ = owns_arm ? id : id - 1;
  if (owns_arm) {
    target_.sender = sender;
    target_.epoch = epoch;
    target_.target_id = id;
    if (why.starts_with(kHeldAsBefore)) why.erase(0, std::strlen(kHeldAsBefore));
    hold(holds ? kHeldAsBefore + why
               : "restarted in the middle of " + name + ": give another, or release the arm");
  } else if (id >= 0) {
    why_ = was_served ? "restarted; no target is open"
                      : "restarted: " + name + " was not begun; give it again";
  }
}

}  // namespace bodyschema
