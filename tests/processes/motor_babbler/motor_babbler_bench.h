#pragma once

#include <gtest/gtest.h>

#include "common/bus/convert.h"
#include "processes/motor_babbler/motor_babbler.h"

// What the babbler's tests have in common: a driver, an observer and a monitor.

namespace bodyschema::test {

inline constexpr std::int64_t kSecond = 1'000'000;

inline MotorBabblerConfig test_config() {
  MotorBabblerConfig config;
  config.signals = {{"q1", -1, 1}, {"q2", -60, 60}, {"q3", 0.2, 0.9}};
  config.extreme_share = 0.5;
  config.extreme_from = 0.7;
  config.test_every = 5;
  config.expiry_us = 60 * kSecond;
  config.resend_us = 1 * kSecond;
  config.sample_timeout_us = 30 * kSecond;
  config.verdict_timeout_us = 10 * kSecond;
  config.stop.min_samples = 10;
  config.stop.max_samples = 40;
  config.stop.min_test_samples = 3;
  config.stop.position_m = 0.006;
  config.stop.rotation_rad = 0.02;
  return config;
}

inline motion_status_t idle_at_rest(std::int64_t utime) {
  motion_status_t status{};
  status.utime = utime;
  status.action_id = -1;
  status.state = motion_status_t::STATE_IDLE;
  status.rest_since_utime = utime;
  return status;
}

inline motion_status_t answer(const action_command_t& command, std::int8_t state,
                              bool at_rest = true) {
  motion_status_t status{};
  status.utime = command.utime + kSecond;
  status.source = command.source;
  status.epoch = command.epoch;
  status.action_id = command.action_id;
  status.kind = command.kind;
  status.purpose = command.purpose;
  status.state = state;
  status.rest_since_utime = at_rest ? status.utime : -1;
  set_array(status.num_signals, status.commanded, command.action);
  return status;
}

inline sample_t sample_of(const action_command_t& command, std::int64_t sample_index) {
  sample_t sample{};
  sample.utime = command.utime + kSecond;
  sample.sample_index = sample_index;
  sample.source = command.source;
  sample.epoch = command.epoch;
  sample.action_id = command.action_id;
  sample.purpose = command.purpose;
  set_array(sample.num_signals, sample.action, command.action);
  return sample;
}

/// A verdict that fulfils every clause of test_config()'s stopping rule.
inline model_health_t good_health(std::int64_t judged_sample) {
  model_health_t health{};
  health.judged_sample = judged_sample;
  health.schema_complete = 1;
  health.num_test_samples = static_cast<std::int32_t>((judged_sample + 1) / 5);
  health.worst_position_m = 0.006;
  health.worst_rotation_rad = 0.02;
  return health;
}
inline model_health_t bad_health(std::int64_t judged_sample) {
  model_health_t health = good_health(judged_sample);
  health.schema_complete = 0;
  return health;
}

inline MotorBabblerConfig active_config() {
  MotorBabblerConfig config = test_config();
  config.choice = Choice::kActive;
  return config;
}

/// A schema of two parts and the first signal.
inline body_schema_t schema_of(std::int64_t version) {
  BodySchema schema;
  schema.version = version;
  schema.last_sample_index = version - 1;
  schema.signals = test_config().signals;
  schema.parts = {1, 2};
  schema.root = 1;
  schema.noise = {0.001, 0.005};
  Edge edge;
  edge.from = 1;
  edge.to = 2;
  edge.joints.resize(1);
  edge.joints[0].turn = 1;
  edge.joints[0].X_after.translation() << 0.1 * double(version), 0.2, 0;
  edge.parameter_covariance = 1e-4 * Eigen::MatrixXd::Identity(14, 14);
  schema.edges = {edge};
  return to_message(schema);
}
inline model_health_t verdict(std::int64_t judged_sample, std::int64_t schema_version) {
  model_health_t health = bad_health(judged_sample);
  health.schema_version = schema_version;
  return health;
}

inline control_status_t control(bool owns_arm) {
  control_status_t status{};
  status.control_state =
      owns_arm ? control_status_t::CONTROL_MOVING : control_status_t::CONTROL_IDLE;
  status.owns_arm = owns_arm;
  return status;
}

/// A babbler that has heard that no other process wants the arm.
inline MotorBabbler free_babbler(MotorBabblerConfig config = test_config(), std::int64_t seed = 1) {
  MotorBabbler babbler(std::move(config), seed);
  babbler.on_control_status(control(false));
  return babbler;
}

/// Plays driver, observer and monitor.
class Bench {
 public:
  explicit Bench(MotorBabblerConfig config = test_config(), std::int64_t seed = 1)
      : babbler(free_babbler(std::move(config), seed)) {}

  /// The first command, as the driver hears it.
  void start(std::int64_t utime = 5 * kSecond) {
    const auto command = babbler.on_motion_status(idle_at_rest(utime));
    ASSERT_TRUE(command);
    last = *command;
  }
  /// The driver settles, the observer makes the sample; true if a command followed.
  bool make_sample() {
    EXPECT_FALSE(babbler.on_motion_status(answer(last, motion_status_t::STATE_SETTLED)));
    babbler.remember(sample_of(last, num_samples));
    return take(babbler.on_sample(sample_of(last, num_samples++)));
  }
  bool is_test() const { return last.purpose == action_command_t::PURPOSE_TEST; }
  /// Up to the command that follows `count` samples, refusing every TEST.
  void run(int count) {
    for (int i = 0; i < count; ++i) {
      const bool was_test = is_test();
      const bool sent = make_sample();
      ASSERT_EQ(sent, !was_test);
      if (was_test) {
        ASSERT_TRUE(take(babbler.on_model_health(bad_health(num_samples - 1))));
      }
    }
  }
  bool take(const std::optional<action_command_t>& command) {
    if (command) last = *command;
    return command.has_value();
  }

  MotorBabbler babbler;
  action_command_t last{};
  std::int64_t num_samples = 0;
};

/// `message`: a command or its SAMPLE.
template <class Message>
bool is_drawn(const Message& message, const MotorBabblerConfig& config = active_config()) {
  const Eigen::VectorXd drawn = random_action(config, 1, message.action_id);
  return message.action == std::vector<double>(drawn.begin(), drawn.end());
}

/// A verdict with `num` actions of the refiner, of which the third is beyond the limits.
inline model_health_t wanting(model_health_t health, std::int64_t wanted_sample, int num = 10) {
  health.wanted_sample = wanted_sample;
  std::vector<wanted_action_t> wanted(num);
  for (int n = 0; n < num; ++n) {
    std::vector<double> action;
    for (const Signal& signal : active_config().signals)
      action.push_back(signal.lower + (signal.upper - signal.lower) * (n == 2 ? 1.01 : 0.09 * n) +
                       1e-3 * double(wanted_sample));
    set_array(wanted[n].num_signals, wanted[n].wanted_action, action);
  }
  set_array(health.num_wanted, health.wanted_actions, wanted);
  return health;
}

/// SAMPLE of an arm of which these parts are seen.
inline sample_t ends_seen(const action_command_t& command, std::int64_t sample_index,
                          const std::vector<int>& parts = {1, 2}) {
  sample_t sample = sample_of(command, sample_index);
  std::vector<part_observation_t> seen;
  for (const int part : parts) {
    part_observation_t& observation = seen.emplace_back();
    observation.part_id = part;
    observation.has_rotation = 1;
  }
  set_array(sample.num_parts, sample.parts, seen);
  return sample;
}

}  // namespace bodyschema::test
