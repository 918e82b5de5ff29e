#include "processes/motor_babbler/motor_babbler.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <random>
#include <sstream>
#include <utility>

#include "common/bus/convert.h"
#include "common/config/yaml.h"
#include "common/geometry/angle.h"

namespace bodyschema {
namespace {

constexpr char kSource[] = "motor_babbler";
constexpr int kMaxHastyRejections = 20;
constexpr std::int64_t kListen_us = 1'500'000;  // CONTROL_STATUS repeats at 1 Hz
constexpr std::int64_t kControlSilent_us = 3'000'000;
constexpr std::int64_t kEyesSilent_us = 5'000'000;  // frames and SAMPLE repeat at 1 Hz at least

constexpr std::size_t kNumCandidates = 40;
// Other streams of random numbers than that of the draw.
constexpr std::int64_t kCandidates = 1;
constexpr std::int64_t kSingleJoint = 2;
// Size of the memory: old actions matter little, and a choice takes time for each.
constexpr std::size_t kMaxMemory = 500;

std::int64_t microseconds(double seconds) { return std::llround(seconds * 1e6); }

std::mt19937_64 engine_of(std::initializer_list<std::int64_t> numbers) {
  std::vector<std::uint32_t> words;
  for (const std::int64_t x : numbers) {
    words.push_back(static_cast<std::uint32_t>(x));
    words.push_back(static_cast<std::uint32_t>(x >> 32));
  }
  std::seed_seq sequence(words.begin(), words.end());
  return std::mt19937_64(sequence);
}

Eigen::VectorXd draw(const MotorBabblerConfig& config, double extreme_share,
                     std::mt19937_64& engine) {
  std::uniform_real_distribution<double> unit(0, 1);
  const bool is_extreme = unit(engine) < extreme_share;
  Eigen::VectorXd action(config.signals.size());
  for (std::size_t i = 0; i < config.signals.size(); ++i) {
    const Signal& signal = config.signals[i];
    const double u = unit(engine);
    // Position within the range, −1..1.
    double x = 2 * u - 1;
    if (is_extreme) {
      const double side = u < 0.5 ? -1 : 1;
      x = side * (config.extreme_from + (1 - config.extreme_from) * std::abs(x));
    }
    action[i] = 0.5 * (signal.lower + signal.upper) + 0.5 * (signal.upper - signal.lower) * x;
  }
  return action;
}

}  // namespace

MotorBabblerConfig MotorBabblerConfig::load(const std::filesystem::path& file) {
  const Yaml yaml = Yaml::load(file);
  MotorBabblerConfig config;
  config.signals = load_signals(file.parent_path()).signals;
  config.choice =
      yaml.choice("choice", {"active", "random"}) == "active" ? Choice::kActive : Choice::kRandom;
  config.extreme_share = yaml.number("extreme_share", 0, 1);
  config.extreme_from = yaml.number("extreme_from", 0, 1);
  config.single_joint_share = yaml.number("single_joint_share", 0, 1);
  config.test_every = yaml.integer("test_every", 2, 1000);
  config.expiry_us = microseconds(yaml.number("expiry_s", 0.1, 3600));
  config.resend_us = microseconds(yaml.number("resend_s", 0.1, 3600));
  config.sample_timeout_us = microseconds(yaml.number("sample_timeout_s", 0.1, 3600));
  config.verdict_timeout_us = microseconds(yaml.number("verdict_timeout_s", 0.1, 3600));
  const Yaml stop = yaml.section("stop");
  config.stop.max_samples = stop.integer("max_samples", 1, 1'000'000);
  for (const auto& [key, least] : {std::pair{"min_samples", &config.stop.min_samples},
                                   {"min_test_samples", &config.stop.min_test_samples}}) {
    *least = stop.integer(key, 1, 1'000'000);
    if (*least > config.stop.max_samples)
      throw stop.error(key,
                       fmt::format("{} is above max_samples, {}", *least, config.stop.max_samples));
  }
  config.stop.position_m = stop.number("position_m", 0, 10);
  config.stop.rotation_rad = stop.number("rotation_deg", 0, 180) * kDegree;
  yaml.finish();
  return config;
}

Eigen::VectorXd random_action(const MotorBabblerConfig& config, std::int64_t seed,
                              std::int64_t action_id) {
  std::mt19937_64 engine = engine_of({seed, action_id});
  return draw(config, config.extreme_share, engine);
}

std::vector<Eigen::VectorXd> candidate_actions(const MotorBabblerConfig& config, std::int64_t seed,
                                               std::int64_t action_id) {
  std::mt19937_64 engine = engine_of({seed, action_id, kCandidates});
  std::vector<Eigen::VectorXd> candidates;
  while (candidates.size() < kNumCandidates) candidates.push_back(draw(config, 0, engine));
  return candidates;
}

MotorBabbler::MotorBabbler(MotorBabblerConfig config, std::int64_t seed)
    : config_(std::move(config)),
      seed_(seed),
      single_joint_moves_(config_.signals, config_.single_joint_share),
      wanted_actions_(config_.signals) {
  health_.judged_sample = health_.wanted_sample = heard_schema_.schema_version = -1;
}

bool MotorBabbler::is_mine(const motion_status_t& status) const {
  return status.source == kSource && status.epoch == epoch_ &&
         status.action_id == command_.action_id;
}

std::optional<action_command_t> MotorBabbler::on_motion_status(const motion_status_t& status) {
  driver_utime_ = status.utime;
  is_at_rest_ = status.rest_since_utime >= 0;
  rest_utime_ = status.rest_since_utime;
  is_stopped_ = status.stop_latched == 1;
  if (done_) return std::nullopt;
  if (wait_ == Wait::kDriver && !is_restored_) {
    // Driver's time makes the epoch the same in every simulated run of a seed. Without kept state
    // it at least avoids a predecessor's ids.
    epoch_ = status.utime;
    if (status.source == kSource) action_id_ = std::max(action_id_, status.action_id + 1);
  }
  if (is_stopped_) {
    if (wait_ != Wait::kDriver) wait_ = Wait::kRest;
    return std::nullopt;
  }
  if (wait_ == Wait::kDriver) return begin();
  if (wait_ == Wait::kRest) return may_move() ? act() : std::nullopt;
  if (wait_ != Wait::kAnswer || !is_mine(status)) return std::nullopt;
  wait_since_us_ = -1;  // the driver is not silent
  switch (status.state) {
    case motion_status_t::STATE_REJECTED:
      // A repetition while the arm moves would only be refused again.
      if (!is_at_rest_) return std::nullopt;
      ++num_rejected_;
      rejection_ = status.reason;
      if (++num_rejected_in_a_row_ <= kMaxHastyRejections) return act();
      // A driver that refuses everything is asked slowly: on_tick sends the action that act()
      // chose.
      act();
      return std::nullopt;
    case motion_status_t::STATE_EXPIRED:
    case motion_status_t::STATE_STOPPED:
    case motion_status_t::STATE_HOLDING:
      return is_at_rest_ ? act() : std::nullopt;
    case motion_status_t::STATE_SETTLED:
      num_rejected_in_a_row_ = 0;
      wait_ = Wait::kSample;
      frame_us_ = observer_us_ = 0;
      has_seen_frame_ = has_heard_observer_ = false;
      return std::nullopt;
    default:
      return std::nullopt;
  }
}

std::optional<action_command_t> MotorBabbler::begin() {
  if (!may_move() || !has_heard_control_) return std::nullopt;
  if (!is_restored_) return act();
  wait_since_us_ = -1;
  if (!is_seen_) {
    wait_ = Wait::kAnswer;
    return command_;
  }
  return go_on();
}

std::optional<action_command_t> MotorBabbler::go_on() {
  const bool is_test_new = last_test_sample_ == last_sample_;
  if ((!is_test_new || has_verdict()) && (!is_to_choose() || can_choose())) return act();
  if (wait_ != Wait::kVerdict) wait_since_us_ = -1;
  wait_ = Wait::kVerdict;
  return std::nullopt;
}

std::int8_t MotorBabbler::next_purpose() const {
  return num_samples_ % config_.test_every == config_.test_every - 1
             ? action_command_t::PURPOSE_TEST
             : action_command_t::PURPOSE_TRAIN;
}

bool MotorBabbler::is_to_choose() const {
  return config_.choice == Choice::kActive && next_purpose() == action_command_t::PURPOSE_TRAIN &&
         is_seen_ && last_test_sample_ >= 0 && without_schema_since_ != last_test_sample_ &&
         !single_joint_action() && !should_stop();
}

std::optional<std::vector<double>> MotorBabbler::single_joint_action() const {
  if (next_purpose() != action_command_t::PURPOSE_TRAIN) return std::nullopt;
  std::mt19937_64 engine = engine_of({seed_, action_id_, kSingleJoint});
  const double u = std::uniform_real_distribution<double>(0, 1)(engine);
  return single_joint_moves_.action(num_train(), u);
}

bool MotorBabbler::can_choose() const {
  if (!has_verdict()) return false;
  const bool has_memory = !memory_.empty() && memory_.back().sample_index >= last_sample_;
  return !has_schema() || (schema_version_ == health_.schema_version && has_memory);
}

Eigen::VectorXd MotorBabbler::next_action() {
  if (is_to_probe())
    return Eigen::Map<const Eigen::VectorXd>(health_.probe_action.data(), health_.num_probe);
  if (const auto single = single_joint_action())
    return Eigen::Map<const Eigen::VectorXd>(single->data(), std::ssize(*single));
  if (!is_to_choose() || !can_choose() || !has_schema())
    return random_action(config_, seed_, action_id_);
  if (const auto wanted = wanted_actions_.take(health_)) return *wanted;
  const auto candidates = candidate_actions(config_, seed_, action_id_);
  return candidates[choose_action(schema_, {memory_.begin(), memory_.end()}, candidates)];
}

bool MotorBabbler::is_to_probe() const {
  return next_purpose() == action_command_t::PURPOSE_TRAIN && is_seen_ && last_test_sample_ >= 0 &&
         last_sample_ == last_test_sample_ && has_verdict() && !should_stop() &&
         is_within_limits(health_.probe_action, config_.signals);
}

void MotorBabbler::note_verdict() {
  if (has_verdict())
    single_joint_moves_.on_verdict(last_test_sample_, health_.schema_complete == 1);
}

void MotorBabbler::take_schema() {
  if (heard_schema_.schema_version != health_.schema_version ||
      heard_schema_.schema_version == schema_version_)
    return;
  schema_ = from_message(heard_schema_);
  schema_version_ = heard_schema_.schema_version;
}

std::optional<action_command_t> MotorBabbler::on_body_schema(const body_schema_t& schema) {
  if (config_.choice == Choice::kRandom) return std::nullopt;
  heard_schema_ = schema;
  take_schema();
  return wait_ == Wait::kVerdict ? go_on() : std::nullopt;
}

std::optional<action_command_t> MotorBabbler::remember(const sample_t& sample) {
  if (config_.choice == Choice::kRandom) return std::nullopt;
  // Samples of a samples file have not passed the rig's door.
  if (sample.num_signals != static_cast<std::int32_t>(config_.signals.size()))
    throw std::invalid_argument("a sample of another rig: " + std::to_string(sample.num_signals) +
                                " signals");
  SeenAction seen;
  seen.sample_index = sample.sample_index;
  seen.is_learned_from = sample.purpose == action_command_t::PURPOSE_TRAIN ||
                         sample.purpose == action_command_t::PURPOSE_PROBE;
  seen.action = Eigen::Map<const Eigen::VectorXd>(sample.action.data(), sample.num_signals);
  for (const part_observation_t& part : sample.parts) seen.parts.insert(part.part_id);
  for (const part_observation_t& part : sample.contradictions) seen.parts.insert(part.part_id);
  memory_.push_back(std::move(seen));
  if (memory_.size() > kMaxMemory) memory_.pop_front();
  return wait_ == Wait::kVerdict ? go_on() : std::nullopt;
}

std::optional<action_command_t> MotorBabbler::on_sample(const sample_t& sample) {
  has_heard_observer_ = has_ever_heard_observer_ = true;
  if (wait_ == Wait::kDriver && !is_restored_) {
    // The only trace of a predecessor for a babbler without kept state.
    num_samples_ = std::max(num_samples_, sample.sample_index + 1);
    if (sample.source == kSource) action_id_ = std::max(action_id_, sample.action_id + 1);
  }
  const bool is_own = sample.source == kSource && sample.epoch == epoch_ &&
                      sample.action_id < action_id_ && sample.sample_index > last_sample_;
  if (!is_own) return std::nullopt;
  ++num_samples_;
  last_sample_ = sample.sample_index;
  const bool is_test = sample.purpose == action_command_t::PURPOSE_TEST;
  if (is_test) last_test_sample_ = last_sample_;
  single_joint_moves_.on_sample(sample, num_train());
  note_verdict();
  if (sample.action_id != command_.action_id) return std::nullopt;
  is_seen_ = true;
  num_unseen_in_a_row_ = 0;
  if (wait_ != Wait::kSample && wait_ != Wait::kAnswer) return std::nullopt;
  return go_on();
}

void MotorBabbler::on_marker_poses(const marker_poses_t& poses) {
  if (is_at_rest_ && poses.utime >= rest_utime_) has_seen_frame_ = true;
}

std::optional<action_command_t> MotorBabbler::on_model_health(const model_health_t& health) {
  // The first verdict on a TEST sample counts until the next: later findings of the monitor may
  // come before or after the next action is chosen.
  if (last_test_sample_ < 0 || !has_verdict() || health.judged_sample != health_.judged_sample) {
    health_ = health;
    take_schema();
    note_verdict();
  }
  if (last_sample_ < 0 && !is_restored_) {
    num_samples_ = std::max(num_samples_, health.judged_sample + 1);
  }
  if (wait_ != Wait::kVerdict) return std::nullopt;
  // The monitor itself waits, and not for ever.
  if (health.awaited_refinement == last_test_sample_) wait_since_us_ = -1;
  return go_on();
}

std::optional<action_command_t> MotorBabbler::on_control_status(const control_status_t& status) {
  const bool was_lent = std::exchange(is_lent_, status.owns_arm == 1);
  has_heard_control_ = true;
  is_control_silent_ = false;
  control_since_us_ = -1;
  if (done_ || is_lent_) return std::nullopt;
  if (wait_ == Wait::kDriver) return begin();
  // An action that was not finished when the arm was taken is replaced.
  if (was_lent && (wait_ == Wait::kAnswer || wait_ == Wait::kSample)) wait_ = Wait::kRest;
  return wait_ == Wait::kRest && may_move() ? act() : std::nullopt;
}

std::optional<action_command_t> MotorBabbler::on_tick(std::int64_t now_us) {
  if (started_us_ < 0) started_us_ = now_us;
  if (control_since_us_ < 0) control_since_us_ = now_us;
  is_control_silent_ = now_us - control_since_us_ > kControlSilent_us;
  if (!has_heard_control_ && now_us - started_us_ >= kListen_us) {
    has_heard_control_ = true;  // there is no controller
    if (wait_ == Wait::kDriver) return begin();
  }
  now_us_ = now_us;
  if (std::exchange(has_seen_frame_, false)) frame_us_ = now_us;
  if (std::exchange(has_heard_observer_, false)) observer_us_ = now_us;
  if (wait_since_us_ < 0) wait_since_us_ = now_us;
  const std::int64_t waited_us = now_us - wait_since_us_;
  if (wait_ == Wait::kAnswer && waited_us >= config_.resend_us && !is_lent_) {
    wait_since_us_ = now_us;
    return command_;
  }
  // Only the time in which a SAMPLE could have come is counted.
  if (wait_ == Wait::kSample && waited_us > kEyesSilent_us && !blindness().empty()) {
    wait_since_us_ = now_us - kEyesSilent_us;
    return std::nullopt;
  }
  if (wait_ == Wait::kSample && waited_us >= config_.sample_timeout_us) {
    ++num_unseen_;
    ++num_unseen_in_a_row_;
    return act();
  }
  if (wait_ == Wait::kVerdict && waited_us >= config_.verdict_timeout_us) {
    if (is_to_choose()) {
      without_schema_since_ = last_test_sample_;
      ++num_without_schema_;
    }
    return act();
  }
  return std::nullopt;
}

std::string MotorBabbler::blindness() const {
  const auto is_silent = [&](std::int64_t heard_us) {
    return heard_us == 0 || now_us_ - heard_us > kEyesSilent_us;
  };
  if (is_silent(frame_us_)) {
    return "no MARKER_POSES of this rest: are camera and marker_estimator running?";
  }
  const bool may_be_alive = !has_ever_heard_observer_ && num_unseen_in_a_row_ == 0;
  if (is_silent(observer_us_) && !may_be_alive) return "is the observer running?";
  return "";
}

bool MotorBabbler::should_stop() const {
  const StoppingRule& stop = config_.stop;
  if (num_samples_ >= stop.max_samples) return true;
  // A verdict is awaited only right after a TEST sample; the arrival of others depends on the speed
  // of learner and monitor.
  const bool is_judged = last_sample_ >= 0 && last_test_sample_ == last_sample_ && has_verdict();
  return is_judged && num_samples_ >= stop.min_samples && health_.schema_complete &&
         health_.num_test_samples >= stop.min_test_samples && health_.worst_position_m >= 0 &&
         health_.worst_position_m <= stop.position_m && health_.worst_rotation_rad >= 0 &&
         health_.worst_rotation_rad <= stop.rotation_rad;
}

std::optional<action_command_t> MotorBabbler::act() {
  wait_since_us_ = -1;
  if (should_stop()) {
    done_ = true;
    wait_ = Wait::kDone;
    return std::nullopt;
  }
  if (is_lent_) {
    wait_ = Wait::kRest;
    return std::nullopt;
  }
  const Eigen::VectorXd action = next_action();
  const std::int8_t purpose =
      is_to_probe() ? std::int8_t{action_command_t::PURPOSE_PROBE} : next_purpose();
  is_seen_ = false;
  command_ = action_command_t{};
  command_.utime = driver_utime_;
  command_.source = kSource;
  command_.epoch = epoch_;
  command_.action_id = action_id_;
  command_.kind = action_command_t::KIND_MOVE;
  command_.purpose = purpose;
  command_.expiry_utime = driver_utime_ + config_.expiry_us;
  set_array(command_.num_signals, command_.action,
            std::vector<double>(action.data(), action.data() + action.size()));
  ++action_id_;
  wait_ = Wait::kAnswer;
  return command_;
}

std::string MotorBabbler::activity() const {
  const std::string samples = std::to_string(num_samples_) + " samples";
  if (is_lent_ && !done_) {
    return samples + ", waiting: the controller has the arm" +
           (is_control_silent_ ? " but is silent; start it again, it gives the arm back or holds it"
                               : "");
  }
  switch (wait_) {
    case Wait::kDriver:
      if (driver_utime_ == 0) return "waiting for MOTION_STATUS of a driver";
      return samples + (is_stopped_ ? ", halted, until: ./run resume"
                                    : ", waiting until the arm is at rest and nobody else's");
    case Wait::kAnswer:
      return samples + ", waiting for the driver's answer to action " +
             std::to_string(command_.action_id) +
             (num_rejected_in_a_row_ > 0 ? "; refused before: " + rejection_ : "");
    case Wait::kSample: {
      const std::string text =
          samples + ", waiting for the SAMPLE of action " + std::to_string(command_.action_id);
      const bool is_late = wait_since_us_ >= 0 && now_us_ - wait_since_us_ >= kEyesSilent_us;
      return is_late && !blindness().empty() ? text + "; " + blindness() : text;
    }
    case Wait::kVerdict:
      if (!has_verdict())
        return samples + ", waiting for MODEL_HEALTH of sample " +
               std::to_string(last_test_sample_);
      if (schema_version_ != health_.schema_version)
        return samples + ", waiting for BODY_SCHEMA version " +
               std::to_string(health_.schema_version);
      return samples + ", waiting for the samples up to " + std::to_string(last_sample_);
    case Wait::kRest:
      return samples +
             (is_stopped_ ? ", halted, until: ./run resume" : ", waiting for the arm to rest");
    case Wait::kDone:
      return samples + ", done";
  }
  return samples;
}

std::string MotorBabbler::state_text() const {
  if (command_.source.empty()) return "";
  std::ostringstream text;
  text << "# motor_babbler: its samples, and the last command with whether its SAMPLE came.\n"
       << "seed: " << seed_ << "\n"
       << "samples: " << num_samples_ << "\n"
       << "last_sample: " << last_sample_ << "\n"
       << "last_test_sample: " << last_test_sample_ << "\n"
       << "seen: " << (is_seen_ ? "true" : "false") << "\n"
       << "command: {utime: " << command_.utime << ", epoch: " << command_.epoch
       << ", action_id: " << command_.action_id << ", purpose: " << int{command_.purpose}
       << ", expiry_utime: " << command_.expiry_utime << ", action: " << yaml_list(command_.action)
       << "}\n"
       << single_joint_moves_.state_text() << wanted_actions_.state_text();
  return text.str();
}

void MotorBabbler::restore(const std::filesystem::path& file) {
  const Yaml yaml = Yaml::load(file);
  if (yaml.integer("seed") != seed_) {
    throw yaml.error("seed",
                     "this is the state of another run; begin with its seed, or without "
                     "this file");
  }
  num_samples_ = yaml.integer("samples", 0);
  last_sample_ = yaml.integer("last_sample", -1);
  last_test_sample_ = yaml.integer("last_test_sample", -1);
  is_seen_ = yaml.boolean("seen");
  const Yaml last = yaml.section("command");
  command_.utime = last.integer("utime", 0);
  command_.source = kSource;
  command_.epoch = epoch_ = last.integer("epoch", 0);
  command_.action_id = last.integer("action_id", 0);
  command_.kind = action_command_t::KIND_MOVE;
  command_.purpose = static_cast<std::int8_t>(last.integer("purpose", 0, 3));
  command_.expiry_utime = last.integer("expiry_utime", 0);
  set_array(command_.num_signals, command_.action,
            last.numbers("action", static_cast<int>(config_.signals.size())));
  single_joint_moves_.restore(yaml.section("single_joint_moves"));
  wanted_actions_.restore(yaml.section("wanted_actions"));
  yaml.finish();
  action_id_ = command_.action_id + 1;
  is_restored_ = true;
}

}  // namespace bodyschema
