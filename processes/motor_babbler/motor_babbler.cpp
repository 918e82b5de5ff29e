#include "processes/motor_babbler/motor_babbler.h"

#include <algorithm>
#include <cmath>
#include <random>

#include "common/bus/convert.h"
#include "common/config/yaml.h"

namespace bodyschema {
namespace {

constexpr char kSource[] = "motor_babbler";
constexpr int kMaxHastyRejections = 20;

std::int64_t microseconds(double seconds) { return std::llround(seconds * 1e6); }

}  // namespace

MotorBabblerConfig MotorBabblerConfig::load(const std::filesystem::path& file) {
  const Yaml yaml = Yaml::load(file);
  MotorBabblerConfig config;
  config.signals = load_signals(file.parent_path()).signals;
  config.extreme_share = yaml.number("extreme_share", 0, 1);
  config.extreme_from = yaml.number("extreme_from", 0, 1);
  config.test_every = yaml.integer("test_every", 2, 1000);
  config.expiry_us = microseconds(yaml.number("expiry_s", 0.1, 3600));
  config.resend_us = microseconds(yaml.number("resend_s", 0.1, 3600));
  config.sample_timeout_us = microseconds(yaml.number("sample_timeout_s", 0.1, 3600));
  config.verdict_timeout_us = microseconds(yaml.number("verdict_timeout_s", 0.1, 3600));
  const Yaml stop = yaml.section("stop");
  config.stop.max_samples = stop.integer("max_samples", 1, 1'000'000);
  config.stop.min_samples = stop.integer("min_samples", 1, config.stop.max_samples);
  config.stop.min_test_samples = stop.integer("min_test_samples", 1, config.stop.max_samples);
  config.stop.position_m = stop.number("position_m", 0, 10);
  config.stop.rotation_rad = stop.number("rotation_deg", 0, 180) * (M_PI / 180);
  yaml.finish();
  return config;
}

Eigen::VectorXd random_action(const MotorBabblerConfig& config, std::int64_t seed,
                              std::int64_t action_id) {
  const auto low = [](std::int64_t x) { return static_cast<std::uint32_t>(x); };
  const auto high = [](std::int64_t x) { return static_cast<std::uint32_t>(x >> 32); };
  std::seed_seq sequence{low(seed), high(seed), low(action_id), high(action_id)};
  std::mt19937_64 engine(sequence);
  std::uniform_real_distribution<double> unit(0, 1);

  const bool is_extreme = unit(engine) < config.extreme_share;
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

MotorBabbler::MotorBabbler(MotorBabblerConfig config, std::int64_t seed)
    : config_(std::move(config)), seed_(seed) {
  health_.judged_sample = -1;
}

bool MotorBabbler::is_mine(const motion_status_t& status) const {
  return status.source == kSource && status.epoch == epoch_ &&
         status.action_id == command_.action_id;
}

std::optional<action_command_t> MotorBabbler::on_motion_status(const motion_status_t& status) {
  driver_utime_ = status.utime;
  if (done_) return std::nullopt;
  if (wait_ == Wait::kDriver) {
    // Driver's time makes the epoch the same in every simulated run of a seed. A babbler that was
    // restarted goes on with the actions of its predecessor.
    epoch_ = status.utime;
    if (status.source == kSource) action_id_ = status.action_id + 1;
  }
  if (status.stop_latched) {
    wait_ = Wait::kResume;
    return std::nullopt;
  }
  const bool at_rest = status.rest_since_utime >= 0;
  if (wait_ == Wait::kDriver || wait_ == Wait::kResume) {
    return at_rest ? act() : std::nullopt;
  }
  if (wait_ != Wait::kAnswer || !is_mine(status)) return std::nullopt;
  wait_since_us_ = -1;  // the driver is not silent
  switch (status.state) {
    case motion_status_t::STATE_REJECTED:
      // Asking again while the arm moves would only be refused again.
      if (!at_rest) return std::nullopt;
      ++num_rejected_;
      rejection_ = status.reason;
      if (++num_rejected_in_a_row_ <= kMaxHastyRejections) return act();
      // A driver that refuses everything is asked at leisure: on_tick sends what act() chose.
      act();
      return std::nullopt;
    case motion_status_t::STATE_EXPIRED:
    case motion_status_t::STATE_STOPPED:
    case motion_status_t::STATE_HOLDING:
      return at_rest ? act() : std::nullopt;
    case motion_status_t::STATE_SETTLED:
      num_rejected_in_a_row_ = 0;
      wait_ = Wait::kSample;
      return std::nullopt;
    default:
      return std::nullopt;
  }
}

std::optional<action_command_t> MotorBabbler::on_sample(const sample_t& sample) {
  num_samples_ = std::max(num_samples_, sample.sample_index + 1);
  const bool is_answer = (wait_ == Wait::kSample || wait_ == Wait::kAnswer) &&
                         sample.source == kSource && sample.epoch == epoch_ &&
                         sample.action_id == command_.action_id;
  if (!is_answer) return std::nullopt;
  if (sample.purpose == action_command_t::PURPOSE_TEST) {
    last_test_sample_ = sample.sample_index;
    if (health_.judged_sample < last_test_sample_) {
      wait_ = Wait::kVerdict;
      wait_since_us_ = -1;
      return std::nullopt;
    }
  }
  return act();
}

std::optional<action_command_t> MotorBabbler::on_model_health(const model_health_t& health) {
  health_ = health;
  // What a babbler that was restarted did not hear of.
  num_samples_ = std::max(num_samples_, health.judged_sample + 1);
  if (wait_ == Wait::kVerdict && health_.judged_sample >= last_test_sample_) return act();
  return std::nullopt;
}

std::optional<action_command_t> MotorBabbler::on_tick(std::int64_t now_us) {
  if (wait_since_us_ < 0) wait_since_us_ = now_us;
  const std::int64_t waited_us = now_us - wait_since_us_;
  if (wait_ == Wait::kAnswer && waited_us >= config_.resend_us) {
    wait_since_us_ = now_us;
    return command_;
  }
  if (wait_ == Wait::kSample && waited_us >= config_.sample_timeout_us) {
    ++num_unseen_;
    return act();
  }
  if (wait_ == Wait::kVerdict && waited_us >= config_.verdict_timeout_us) return act();
  return std::nullopt;
}

bool MotorBabbler::should_stop() const {
  const StoppingRule& stop = config_.stop;
  if (num_samples_ >= stop.max_samples) return true;
  // Only right after a TEST sample is a verdict waited for; which others arrive, and when, depends
  // on the speed of learner and monitor.
  const bool has_verdict =
      last_test_sample_ == num_samples_ - 1 && health_.judged_sample >= last_test_sample_;
  return has_verdict && num_samples_ >= stop.min_samples && health_.schema_complete &&
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
  command_ = action_command_t{};
  command_.utime = driver_utime_;
  command_.source = kSource;
  command_.epoch = epoch_;
  command_.action_id = action_id_;
  command_.kind = action_command_t::KIND_MOVE;
  command_.purpose = num_samples_ % config_.test_every == config_.test_every - 1
                         ? action_command_t::PURPOSE_TEST
                         : action_command_t::PURPOSE_TRAIN;
  command_.expiry_utime = driver_utime_ + config_.expiry_us;
  const Eigen::VectorXd action = random_action(config_, seed_, action_id_);
  set_array(command_.num_signals, command_.action,
            std::vector<double>(action.data(), action.data() + action.size()));
  ++action_id_;
  wait_ = Wait::kAnswer;
  return command_;
}

std::string MotorBabbler::activity() const {
  const std::string samples = std::to_string(num_samples_) + " samples";
  switch (wait_) {
    case Wait::kDriver:
      return "waiting for MOTION_STATUS of a driver";
    case Wait::kAnswer:
      return samples + ", waiting for the driver's answer to action " +
             std::to_string(command_.action_id) +
             (num_rejected_in_a_row_ > 0 ? "; refused before: " + rejection_ : "");
    case Wait::kSample:
      return samples + ", waiting for the SAMPLE of action " + std::to_string(command_.action_id);
    case Wait::kVerdict:
      return samples + ", waiting for MODEL_HEALTH of sample " + std::to_string(last_test_sample_);
    case Wait::kResume:
      return samples + ", stopped: waiting for RESUME";
    case Wait::kDone:
      return samples + ", done";
  }
  return samples;
}

}  // namespace bodyschema
