#include "processes/motor_babbler/motor_babbler.h"

#include <gtest/gtest.h>
#include <unistd.h>

#include <fstream>
#include <functional>
#include <memory>
#include <random>
#include <regex>
#include <set>
#include <sstream>

#include "common/bus/check.h"
#include "common/bus/convert.h"
#include "common/config/yaml.h"
#include "common/geometry/angle.h"

namespace bodyschema {
namespace {

constexpr std::int64_t kSecond = 1'000'000;

MotorBabblerConfig test_config() {
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

motion_status_t idle_at_rest(std::int64_t utime) {
  motion_status_t status{};
  status.utime = utime;
  status.action_id = -1;
  status.state = motion_status_t::STATE_IDLE;
  status.rest_since_utime = utime;
  return status;
}

motion_status_t answer(const action_command_t& command, std::int8_t state, bool at_rest = true) {
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

sample_t sample_of(const action_command_t& command, std::int64_t sample_index) {
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
model_health_t good_health(std::int64_t judged_sample) {
  model_health_t health{};
  health.judged_sample = judged_sample;
  health.schema_complete = 1;
  health.num_test_samples = static_cast<std::int32_t>((judged_sample + 1) / 5);
  health.worst_position_m = 0.006;
  health.worst_rotation_rad = 0.02;
  return health;
}
model_health_t bad_health(std::int64_t judged_sample) {
  model_health_t health = good_health(judged_sample);
  health.schema_complete = 0;
  return health;
}

MotorBabblerConfig active_config() {
  MotorBabblerConfig config = test_config();
  config.choice = Choice::kActive;
  return config;
}

/// A schema of two parts and the first signal.
body_schema_t schema_of(std::int64_t version) {
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
model_health_t verdict(std::int64_t judged_sample, std::int64_t schema_version) {
  model_health_t health = bad_health(judged_sample);
  health.schema_version = schema_version;
  return health;
}

control_status_t control(bool owns_arm) {
  control_status_t status{};
  status.control_state =
      owns_arm ? control_status_t::CONTROL_MOVING : control_status_t::CONTROL_IDLE;
  status.owns_arm = owns_arm;
  return status;
}

/// A babbler that has heard that no other process wants the arm.
MotorBabbler free_babbler(MotorBabblerConfig config = test_config(), std::int64_t seed = 1) {
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

TEST(MotorBabblerTest, StaysSilentUntilADriverIsHeard) {
  MotorBabbler babbler(test_config(), 1);
  action_command_t foreign{};
  foreign.source = "motor_babbler";
  for (std::int64_t t = 0; t < 100; ++t) {
    EXPECT_FALSE(babbler.on_tick(t * kSecond));
    EXPECT_FALSE(babbler.on_sample(sample_of(foreign, t)));
    EXPECT_FALSE(babbler.on_model_health(good_health(t)));
  }
  EXPECT_FALSE(babbler.is_done());
}

TEST(MotorBabblerTest, BeforeItsFirstActionItListensWhetherTheArmIsLent) {
  MotorBabbler alone(test_config(), 1);
  EXPECT_FALSE(alone.on_tick(100 * kSecond));
  EXPECT_FALSE(alone.on_motion_status(idle_at_rest(5 * kSecond)));
  EXPECT_FALSE(alone.on_tick(101 * kSecond + kSecond / 2 - 1));
  EXPECT_TRUE(alone.on_tick(101 * kSecond + kSecond / 2));

  MotorBabbler lent(test_config(), 1);
  EXPECT_FALSE(lent.on_motion_status(idle_at_rest(5 * kSecond)));
  EXPECT_FALSE(lent.on_control_status(control(true)));
  for (std::int64_t t = 100; t < 200; ++t) EXPECT_FALSE(lent.on_tick(t * kSecond));
  const auto command = lent.on_control_status(control(false));
  ASSERT_TRUE(command);
  EXPECT_EQ(command->action_id, 0);

  // A STOP at the start does not bypass it.
  MotorBabbler stopped(test_config(), 1);
  motion_status_t latched = idle_at_rest(5 * kSecond);
  latched.stop_latched = 1;
  EXPECT_FALSE(stopped.on_motion_status(latched));
  EXPECT_FALSE(stopped.on_motion_status(idle_at_rest(6 * kSecond)));
  EXPECT_TRUE(stopped.on_control_status(control(false)));
}

TEST(MotorBabblerTest, WaitsUntilTheArmIsAtRestBeforeItsFirstAction) {
  MotorBabbler babbler = free_babbler();
  motion_status_t moving = idle_at_rest(5 * kSecond);
  moving.rest_since_utime = -1;
  EXPECT_FALSE(babbler.on_motion_status(moving));
  EXPECT_FALSE(babbler.on_tick(100 * kSecond));
  const auto command = babbler.on_motion_status(idle_at_rest(9 * kSecond));
  ASSERT_TRUE(command);
  EXPECT_EQ(command->action_id, 0);
}

TEST(MotorBabblerTest, ItsCommandsMakeSenseAndCarryTheDriversTime) {
  Bench bench;
  bench.start(5 * kSecond);
  EXPECT_EQ(check(bench.last), "");
  EXPECT_EQ(bench.last.source, "motor_babbler");
  EXPECT_EQ(bench.last.epoch, 5 * kSecond);
  EXPECT_EQ(bench.last.utime, 5 * kSecond);
  EXPECT_EQ(bench.last.expiry_utime, 65 * kSecond);
  EXPECT_EQ(bench.last.kind, action_command_t::KIND_MOVE);
  EXPECT_EQ(bench.last.num_signals, 3);
}

TEST(MotorBabblerTest, AnActionIsAFunctionOfSeedAndIdOnly) {
  const MotorBabblerConfig config = test_config();
  std::set<std::vector<double>> all;
  for (std::int64_t seed = 0; seed < 20; ++seed) {
    for (std::int64_t id = 0; id < 50; ++id) {
      const Eigen::VectorXd action = random_action(config, seed, id);
      EXPECT_EQ(action, random_action(config, seed, id));
      all.insert({action.begin(), action.end()});
    }
  }
  EXPECT_EQ(all.size(), 1000U);
  EXPECT_NE(random_action(config, std::int64_t{1} << 32, 0), random_action(config, 0, 0));
  EXPECT_NE(random_action(config, 0, std::int64_t{1} << 32), random_action(config, 0, 0));
}

TEST(MotorBabblerTest, TheActionsSentAreThoseOfTheirIdsWhateverHappenedBetween) {
  Bench smooth, rough;
  smooth.start();
  rough.start();
  smooth.run(3);
  rough.run(1);
  rough.take(rough.babbler.on_tick(10 * kSecond));
  rough.take(rough.babbler.on_tick(20 * kSecond));  // sent again
  rough.run(1);
  ASSERT_TRUE(rough.take(
      rough.babbler.on_motion_status(answer(rough.last, motion_status_t::STATE_REJECTED))));
  EXPECT_EQ(rough.last.action_id, 3);
  EXPECT_EQ(smooth.last.action_id, 3);
  EXPECT_EQ(rough.last.action, smooth.last.action);
}

TEST(MotorBabblerTest, ActionsStayWithinTheLimits) {
  const MotorBabblerConfig config = test_config();
  for (std::int64_t id = 0; id < 5000; ++id) {
    const Eigen::VectorXd action = random_action(config, 3, id);
    for (std::size_t i = 0; i < config.signals.size(); ++i) {
      EXPECT_GE(action[i], config.signals[i].lower);
      EXPECT_LE(action[i], config.signals[i].upper);
    }
  }
}

TEST(MotorBabblerTest, HalfOfTheActionsLieInTheOuterSeventyToHundredPercent) {
  const MotorBabblerConfig config = test_config();
  const int n = 5000;
  int num_outer = 0;
  Eigen::Vector3d num_upper = Eigen::Vector3d::Zero();
  double least = 1, most = 0;
  for (std::int64_t id = 0; id < n; ++id) {
    const Eigen::VectorXd action = random_action(config, 4, id);
    int outer = 0;
    for (std::size_t i = 0; i < config.signals.size(); ++i) {
      const Signal& s = config.signals[i];
      const double x = (action[i] - 0.5 * (s.lower + s.upper)) / (0.5 * (s.upper - s.lower));
      outer += std::abs(x) >= 0.7 - 1e-12;
      num_upper[i] += x > 0;
      if (std::abs(x) >= 0.7) least = std::min(least, std::abs(x));
      most = std::max(most, std::abs(x));
    }
    num_outer += outer == 3;
  }
  // Half by decision, and 0.3^3 of the other half by chance; five standard deviations.
  const double share = 0.5 + 0.5 * 0.027;
  EXPECT_NEAR(num_outer, n * share, 5 * std::sqrt(n * share * (1 - share)));
  for (int i = 0; i < 3; ++i) EXPECT_NEAR(num_upper[i], 0.5 * n, 5 * std::sqrt(0.25 * n));
  EXPECT_LT(least, 0.701);
  EXPECT_GT(most, 0.999);
}

TEST(MotorBabblerTest, EveryFifthSampleIsTest) {
  MotorBabblerConfig config = test_config();
  config.stop.max_samples = 1000;
  Bench bench(config);
  bench.start();
  for (int i = 0; i < 40; ++i) {
    EXPECT_EQ(bench.is_test(), i % 5 == 4) << i;
    bench.run(1);
  }
}

TEST(MotorBabblerTest, ARejectedTestIsReplacedByATest) {
  Bench bench;
  bench.start();
  bench.run(4);
  ASSERT_TRUE(bench.is_test());
  for (int i = 0; i < 7; ++i) {
    const std::int64_t id = bench.last.action_id;
    ASSERT_TRUE(bench.take(
        bench.babbler.on_motion_status(answer(bench.last, motion_status_t::STATE_REJECTED))));
    EXPECT_EQ(bench.last.action_id, id + 1);
    EXPECT_TRUE(bench.is_test());
  }
  EXPECT_EQ(bench.babbler.num_rejected(), 7);
}

// A driver refuses commands while the arm moves; repeating them at once would only burn ids.
TEST(MotorBabblerTest, AfterARejectionItWaitsForRest) {
  Bench bench;
  bench.start();
  EXPECT_FALSE(bench.babbler.on_motion_status(
      answer(bench.last, motion_status_t::STATE_REJECTED, /*at_rest=*/false)));
  EXPECT_TRUE(bench.babbler.on_motion_status(answer(bench.last, motion_status_t::STATE_REJECTED)));
  EXPECT_EQ(bench.babbler.num_rejected(), 1);
}

TEST(MotorBabblerTest, ADriverThatRefusesEverythingIsAskedAtLeisure) {
  Bench bench;
  bench.start();
  int num_sent = 0;
  const auto refuse = [&] {
    motion_status_t status = answer(bench.last, motion_status_t::STATE_REJECTED);
    status.reason = "three signals expected";
    return bench.take(bench.babbler.on_motion_status(status));
  };
  while (num_sent < 1000 && refuse()) ++num_sent;
  EXPECT_GE(num_sent, 5);
  EXPECT_LT(num_sent, 100);
  EXPECT_NE(bench.babbler.activity().find("three signals expected"), std::string::npos);
  // From here on one a second.
  for (int i = 0; i < 5; ++i) {
    const std::int64_t now = (1000 + 10 * i) * kSecond, id = bench.last.action_id;
    EXPECT_FALSE(bench.take(bench.babbler.on_tick(now)));
    EXPECT_FALSE(bench.take(bench.babbler.on_tick(now + kSecond / 2)));
    ASSERT_TRUE(bench.take(bench.babbler.on_tick(now + kSecond)));
    EXPECT_EQ(bench.last.action_id, id + 1);
    EXPECT_FALSE(refuse());
  }
  // An accepted command ends the caution.
  ASSERT_FALSE(bench.take(bench.babbler.on_tick(2000 * kSecond)));
  ASSERT_TRUE(bench.take(bench.babbler.on_tick(2001 * kSecond)));
  ASSERT_TRUE(bench.make_sample());
  EXPECT_TRUE(refuse());
}

TEST(MotorBabblerTest, SilenceIsAnsweredByTheSameCommandAgain) {
  Bench bench;
  bench.start();
  EXPECT_FALSE(bench.babbler.on_tick(100 * kSecond));  // the clock is first seen here
  EXPECT_FALSE(bench.babbler.on_tick(101 * kSecond - 1));
  for (int i = 1; i <= 5; ++i) {
    const auto again = bench.babbler.on_tick((100 + i) * kSecond);
    ASSERT_TRUE(again) << i;
    EXPECT_EQ(again->action_id, bench.last.action_id);
    EXPECT_EQ(again->action, bench.last.action);
    EXPECT_FALSE(bench.babbler.on_tick((100 + i) * kSecond + kSecond / 2));
  }
}

TEST(MotorBabblerTest, ADriverThatAnswersIsNotAskedAgain) {
  Bench bench;
  bench.start();
  for (int i = 0; i < 50; ++i) {
    const std::int64_t now = 100 * kSecond + i * kSecond / 2;
    EXPECT_FALSE(bench.babbler.on_motion_status(
        answer(bench.last, i < 2 ? motion_status_t::STATE_ACCEPTED : motion_status_t::STATE_MOVING,
               false)));
    EXPECT_FALSE(bench.babbler.on_tick(now)) << i;
  }
  // Then it falls silent.
  EXPECT_TRUE(bench.babbler.on_tick(130 * kSecond));
}

// Random events of a whole run: a new action comes only after the last one was settled or refused.
TEST(MotorBabblerTest, TwoActionsAreNeverOutstanding) {
  std::mt19937_64 rng(5);
  std::int64_t num_actions = 0, num_done = 0;
  for (int run = 0; run < 200; ++run) {
    MotorBabbler babbler = free_babbler(test_config(), run);
    std::int64_t now = 0, sample_index = 0;
    std::optional<action_command_t> last;
    bool is_open = false;
    const auto take = [&](const std::optional<action_command_t>& command) {
      if (!command) return;
      ASSERT_EQ(check(*command), "");
      if (last && command->action_id == last->action_id) {
        ASSERT_TRUE(is_open);
        ASSERT_EQ(command->action, last->action);
        return;
      }
      ASSERT_FALSE(is_open);
      ASSERT_EQ(command->action_id, last ? last->action_id + 1 : 0);
      last = command;
      is_open = true;
      ++num_actions;
    };
    take(babbler.on_motion_status(idle_at_rest(1)));
    for (int event = 0; event < 400 && !babbler.is_done() && !HasFatalFailure(); ++event) {
      switch (rng() % 7) {
        case 0:
          now += static_cast<std::int64_t>(rng() % (2 * kSecond));
          take(babbler.on_tick(now));
          break;
        case 1:
          if (is_open)
            take(babbler.on_motion_status(answer(*last, motion_status_t::STATE_MOVING, false)));
          break;
        case 2:
          is_open = false;
          take(babbler.on_motion_status(answer(*last, motion_status_t::STATE_SETTLED)));
          break;
        case 3:
          if (!is_open) break;
          is_open = false;
          take(babbler.on_motion_status(answer(*last, motion_status_t::STATE_REJECTED)));
          break;
        case 4:
          if (!is_open) take(babbler.on_sample(sample_of(*last, sample_index++)));
          break;
        case 5:
          take(babbler.on_model_health(rng() % 4 ? bad_health(sample_index - 1)
                                                 : good_health(sample_index - 1)));
          break;
        default:
          // Camera and observer live; the observer repeats its newest.
          for (int i = 0; i < 31; ++i, now += kSecond) {
            marker_poses_t poses{};
            poses.utime = std::int64_t{1} << 50;
            babbler.on_marker_poses(poses);
            action_command_t foreign = *last;
            foreign.source = "controller";
            take(babbler.on_sample(sample_of(foreign, 0)));
            take(babbler.on_tick(now));
          }
      }
    }
    ASSERT_FALSE(HasFatalFailure()) << "run " << run;
    num_done += babbler.is_done();
  }
  EXPECT_GT(num_actions, 5000);
  EXPECT_GT(num_done, 20);
}

TEST(MotorBabblerTest, ASampleThatOvertakesSettledIsTaken) {
  Bench bench;
  bench.start();
  const action_command_t first = bench.last;
  ASSERT_TRUE(bench.take(bench.babbler.on_sample(sample_of(first, 0))));
  EXPECT_FALSE(bench.babbler.on_motion_status(answer(first, motion_status_t::STATE_SETTLED)));
  // Still waiting for the answer to the second: silence repeats it.
  bench.babbler.on_tick(100 * kSecond);
  const auto again = bench.babbler.on_tick(102 * kSecond);
  ASSERT_TRUE(again);
  EXPECT_EQ(again->action_id, bench.last.action_id);
}

/// Seconds pass, in which a frame of the present rest and the observer are heard or not. Returns
/// the number of seconds until a command came.
struct Seconds {
  bool frames = true, observer = true;

  std::optional<int> pass(Bench& bench, int count) {
    for (int i = 0; i < count; ++i, now += kSecond) {
      if (frames) {
        marker_poses_t poses{};
        poses.utime = bench.last.utime + kSecond;
        bench.babbler.on_marker_poses(poses);
      }
      // The observer repeats its newest; which it is does not matter.
      action_command_t before = bench.last;
      before.source = "controller";
      if (observer) bench.babbler.on_sample(sample_of(before, 0));
      if (bench.take(bench.babbler.on_tick(now))) return i;
    }
    return std::nullopt;
  }
  std::int64_t now = 100 * kSecond;
};

TEST(MotorBabblerTest, AnActionWithoutASampleIsReplacedWhereCameraAndObserverLive) {
  Bench bench;
  bench.start();
  bench.run(1);
  Seconds seconds;
  for (int n = 1; n <= 3; ++n) {
    bench.babbler.on_motion_status(answer(bench.last, motion_status_t::STATE_SETTLED));
    EXPECT_EQ(seconds.pass(bench, 100), 30);
    EXPECT_EQ(bench.last.action_id, 1 + n);
    EXPECT_EQ(bench.babbler.num_unseen(), n);
  }
}

TEST(MotorBabblerTest, WithoutCameraOrObserverItDoesNotMove) {
  for (const bool is_camera : {true, false}) {
    Bench bench;
    bench.start();
    bench.run(1);
    bench.babbler.on_motion_status(answer(bench.last, motion_status_t::STATE_SETTLED));
    Seconds seconds;
    EXPECT_FALSE(seconds.pass(bench, 10));
    (is_camera ? seconds.frames : seconds.observer) = false;
    EXPECT_FALSE(seconds.pass(bench, 10'000));
    const std::string activity = bench.babbler.activity();
    EXPECT_NE(activity.find("SAMPLE of action 1"), std::string::npos) << activity;
    EXPECT_NE(activity.find(is_camera ? "marker_estimator" : "observer"), std::string::npos);
    // Frames of an earlier rest do not count.
    marker_poses_t old{};
    old.utime = bench.last.utime;
    for (int i = 0; is_camera && i < 100; ++i, seconds.now += kSecond) {
      bench.babbler.on_marker_poses(old);
      EXPECT_FALSE(bench.babbler.on_tick(seconds.now));
    }
    // They are back: its SAMPLE may still come, but is not awaited for ever.
    Bench other = bench;
    EXPECT_TRUE(other.babbler.on_sample(sample_of(other.last, other.num_samples)));
    EXPECT_EQ(other.babbler.num_unseen(), 0);
    seconds.frames = seconds.observer = true;
    const auto waited = seconds.pass(bench, 100);
    ASSERT_TRUE(waited);
    EXPECT_GT(*waited, 20);
    EXPECT_EQ(bench.last.action_id, 2);
    EXPECT_EQ(bench.babbler.num_unseen(), 1);
  }
}

TEST(MotorBabblerTest, WhereNoSampleWasEverHeardOneActionIsReplaced) {
  Bench bench;
  bench.start();
  Seconds seconds;
  seconds.observer = false;
  bench.babbler.on_motion_status(answer(bench.last, motion_status_t::STATE_SETTLED));
  EXPECT_EQ(seconds.pass(bench, 100), 30);
  bench.babbler.on_motion_status(answer(bench.last, motion_status_t::STATE_SETTLED));
  EXPECT_FALSE(seconds.pass(bench, 10'000));
  EXPECT_EQ(bench.babbler.num_unseen(), 1);
  EXPECT_TRUE(bench.babbler.on_sample(sample_of(bench.last, 0)));

  Bench blind;
  blind.start();
  blind.babbler.on_motion_status(answer(blind.last, motion_status_t::STATE_SETTLED));
  seconds.frames = false;
  EXPECT_FALSE(seconds.pass(blind, 10'000));
}

TEST(MotorBabblerTest, AfterATestItWaitsForTheVerdictOnIt) {
  Bench bench;
  bench.start();
  bench.run(4);
  ASSERT_TRUE(bench.is_test());
  EXPECT_FALSE(bench.make_sample());
  EXPECT_FALSE(bench.babbler.on_model_health(bad_health(3)));
  EXPECT_FALSE(bench.babbler.on_motion_status(idle_at_rest(50 * kSecond)));
  const auto next = bench.babbler.on_model_health(bad_health(4));
  ASSERT_TRUE(next);
  EXPECT_EQ(next->action_id, 5);
  EXPECT_FALSE(bench.babbler.on_model_health(bad_health(4)));
}

TEST(MotorBabblerTest, AVerdictThatCameFirstNeedsNoWaiting) {
  Bench bench;
  bench.start();
  bench.run(4);
  bench.babbler.on_motion_status(answer(bench.last, motion_status_t::STATE_SETTLED));
  EXPECT_FALSE(bench.babbler.on_model_health(bad_health(4)));
  EXPECT_TRUE(bench.babbler.on_sample(sample_of(bench.last, 4)));
}

TEST(MotorBabblerTest, AVerdictIsNotAwaitedForEver) {
  Bench bench;
  bench.start();
  bench.run(4);
  bench.make_sample();
  EXPECT_FALSE(bench.babbler.on_tick(200 * kSecond));
  EXPECT_FALSE(bench.babbler.on_tick(210 * kSecond - 1));
  EXPECT_TRUE(bench.babbler.on_tick(210 * kSecond));
}

/// True if the run ends when `verdict` is the monitor's on TEST sample 14, the first with three
/// tests.
bool stops_with(const model_health_t& verdict, MotorBabblerConfig config = test_config()) {
  Bench bench(config);
  bench.start();
  bench.run(14);
  EXPECT_TRUE(bench.is_test());
  EXPECT_FALSE(bench.make_sample());
  const bool sent = bench.babbler.on_model_health(verdict).has_value();
  EXPECT_NE(sent, bench.babbler.is_done());
  return bench.babbler.is_done();
}

TEST(MotorBabblerTest, StopsOnlyWhenEveryClauseOfTheRuleHolds) {
  EXPECT_TRUE(stops_with(good_health(14)));

  model_health_t health = good_health(14);
  health.schema_complete = 0;
  EXPECT_FALSE(stops_with(health));

  health = good_health(14);
  health.num_test_samples = 2;
  EXPECT_FALSE(stops_with(health));

  health = good_health(14);
  health.worst_position_m = 0.0060001;
  EXPECT_FALSE(stops_with(health));

  health = good_health(14);
  health.worst_rotation_rad = 0.0200001;
  EXPECT_FALSE(stops_with(health));

  // Nothing was tested.
  health = good_health(14);
  health.worst_position_m = health.worst_rotation_rad = -1;
  EXPECT_FALSE(stops_with(health));
  health = good_health(14);
  health.worst_rotation_rad = -1;
  EXPECT_FALSE(stops_with(health));

  MotorBabblerConfig config = test_config();
  config.stop.min_samples = 16;
  EXPECT_FALSE(stops_with(good_health(14), config));
}

TEST(MotorBabblerTest, StopsAfterTheLargestNumberOfSamplesWhateverTheVerdict) {
  MotorBabblerConfig config = test_config();
  config.stop.min_samples = config.stop.max_samples = 7;
  Bench bench(config);
  bench.start();
  bench.run(6);
  EXPECT_FALSE(bench.make_sample());
  EXPECT_TRUE(bench.babbler.is_done());
  EXPECT_EQ(bench.babbler.num_samples(), 7);
}

// Verdicts on TRAIN samples come when the learner has time; the end must not depend on them.
TEST(MotorBabblerTest, TheRunEndsAtTheSameSampleHoweverFastTheMonitorIs) {
  for (int arrives_after = 15; arrives_after < 19; ++arrives_after) {
    Bench bench;
    bench.start();
    bench.run(arrives_after);
    bench.babbler.on_model_health(good_health(arrives_after - 1));
    while (bench.num_samples < 19) {
      ASSERT_TRUE(bench.make_sample()) << arrives_after;
    }
    ASSERT_TRUE(bench.is_test());
    EXPECT_FALSE(bench.make_sample());
    EXPECT_FALSE(bench.babbler.is_done());
    EXPECT_FALSE(bench.babbler.on_model_health(good_health(19)));
    EXPECT_TRUE(bench.babbler.is_done());
  }
}

TEST(MotorBabblerTest, DoneIsFinal) {
  Bench bench;
  bench.start();
  bench.run(14);
  bench.make_sample();
  bench.babbler.on_model_health(good_health(14));
  ASSERT_TRUE(bench.babbler.is_done());
  motion_status_t stopped = idle_at_rest(900 * kSecond);
  stopped.stop_latched = 1;
  for (std::int64_t i = 0; i < 50; ++i) {
    EXPECT_FALSE(bench.babbler.on_motion_status(stopped));
    EXPECT_FALSE(bench.babbler.on_motion_status(idle_at_rest((1000 + i) * kSecond)));
    EXPECT_FALSE(
        bench.babbler.on_motion_status(answer(bench.last, motion_status_t::STATE_SETTLED)));
    EXPECT_FALSE(
        bench.babbler.on_motion_status(answer(bench.last, motion_status_t::STATE_REJECTED)));
    EXPECT_FALSE(bench.babbler.on_sample(sample_of(bench.last, 15 + i)));
    EXPECT_FALSE(bench.babbler.on_model_health(bad_health(15 + i)));
    EXPECT_FALSE(bench.babbler.on_tick(i * 100 * kSecond));
    EXPECT_TRUE(bench.babbler.is_done());
  }
}

TEST(MotorBabblerTest, AStopIsObeyedUntilResume) {
  for (const bool after_settling : {false, true}) {
    Bench bench;
    bench.start();
    bench.run(2);
    if (after_settling)
      bench.babbler.on_motion_status(answer(bench.last, motion_status_t::STATE_SETTLED));
    motion_status_t stopped = answer(bench.last, motion_status_t::STATE_STOPPED);
    stopped.source = "operator";
    stopped.kind = action_command_t::KIND_STOP;
    stopped.stop_latched = 1;
    EXPECT_FALSE(bench.babbler.on_motion_status(stopped));
    for (std::int64_t i = 0; i < 100; ++i) {
      EXPECT_FALSE(bench.babbler.on_tick(i * 10 * kSecond));
      EXPECT_FALSE(bench.babbler.on_motion_status(stopped));
      EXPECT_FALSE(bench.babbler.on_model_health(good_health(1)));
    }
    motion_status_t resumed = stopped;
    resumed.kind = action_command_t::KIND_RESUME;
    resumed.stop_latched = 0;
    resumed.rest_since_utime = -1;
    EXPECT_FALSE(bench.babbler.on_motion_status(resumed));
    resumed.rest_since_utime = resumed.utime;
    const auto next = bench.babbler.on_motion_status(resumed);
    ASSERT_TRUE(next);
    EXPECT_EQ(next->action_id, 3);
    EXPECT_EQ(next->epoch, bench.last.epoch);
  }
}

TEST(MotorBabblerTest, AStopThatIsLatchedAtStartIsObeyedToo) {
  MotorBabbler babbler = free_babbler();
  motion_status_t stopped = idle_at_rest(5 * kSecond);
  stopped.stop_latched = 1;
  EXPECT_FALSE(babbler.on_motion_status(stopped));
  EXPECT_FALSE(babbler.on_tick(50 * kSecond));
  const auto command = babbler.on_motion_status(idle_at_rest(9 * kSecond));
  ASSERT_TRUE(command);
  EXPECT_EQ(command->action_id, 0);
}

TEST(MotorBabblerTest, AHoldEndsTheActionButNotTheBabbling) {
  for (const auto state : {motion_status_t::STATE_HOLDING, motion_status_t::STATE_EXPIRED,
                           motion_status_t::STATE_STOPPED}) {
    Bench bench;
    bench.start();
    EXPECT_FALSE(bench.babbler.on_motion_status(answer(bench.last, state, false)));
    const auto next = bench.babbler.on_motion_status(answer(bench.last, state, true));
    ASSERT_TRUE(next);
    EXPECT_EQ(next->action_id, 1);
  }
}

TEST(MotorBabblerTest, ARestartGoesOnAfterTheLastActionOfItsPredecessor) {
  Bench before;
  before.start();
  before.run(7);
  MotorBabbler after = free_babbler();
  const auto command = after.on_motion_status(answer(before.last, motion_status_t::STATE_SETTLED));
  ASSERT_TRUE(command);
  EXPECT_EQ(command->action_id, before.last.action_id + 1);
  EXPECT_NE(command->epoch, before.last.epoch);
  const Eigen::VectorXd expected = random_action(test_config(), 1, command->action_id);
  EXPECT_EQ(command->action, std::vector<double>(expected.begin(), expected.end()));
}

TEST(MotorBabblerTest, ARestartKeepsEveryFifthSampleTest) {
  Bench before;
  before.start();
  before.run(9);
  ASSERT_TRUE(before.is_test());
  MotorBabbler after = free_babbler();
  // The monitor repeats its verdict at 1 Hz, so it may be heard before the driver is.
  EXPECT_FALSE(after.on_model_health(bad_health(8)));
  const auto command = after.on_motion_status(answer(before.last, motion_status_t::STATE_SETTLED));
  ASSERT_TRUE(command);
  EXPECT_EQ(command->purpose, action_command_t::PURPOSE_TEST);
}

TEST(MotorBabblerTest, WhileTheControllerOwnsTheArmItSendsNothing) {
  for (const int stage : {0, 1, 2, 3}) {
    Bench bench;
    if (stage > 0) {
      bench.start();
      bench.run(4);
    }
    const auto settled = [&] { return answer(bench.last, motion_status_t::STATE_SETTLED); };
    if (stage == 2) bench.babbler.on_motion_status(settled());
    if (stage == 3) bench.make_sample();  // a TEST: waits for the verdict
    EXPECT_FALSE(bench.babbler.on_control_status(control(true)));
    for (std::int64_t i = 0; i < 60; ++i) {
      EXPECT_FALSE(bench.babbler.on_tick((100 + i) * kSecond)) << stage;
      EXPECT_FALSE(bench.babbler.on_motion_status(stage == 0 ? idle_at_rest(kSecond) : settled()));
      EXPECT_FALSE(bench.babbler.on_model_health(bad_health(stage == 0 ? -1 : i)));
    }
    EXPECT_NE(bench.babbler.activity().find("controller has the arm"), std::string::npos);
    EXPECT_NE(bench.babbler.activity().find("silent"), std::string::npos);
    EXPECT_FALSE(bench.babbler.on_control_status(control(true)));
    EXPECT_EQ(bench.babbler.activity().find("silent"), std::string::npos);
    // When the arm is given back, the unfinished action is replaced.
    const auto next = bench.babbler.on_control_status(control(false));
    ASSERT_TRUE(next) << stage;
    EXPECT_EQ(next->action_id, stage == 0 ? 0 : 5);
    EXPECT_EQ(next->purpose == action_command_t::PURPOSE_TEST, stage == 1 || stage == 2);
  }
}

TEST(MotorBabblerTest, ASampleThatComesWhileTheArmIsLentIsCounted) {
  Bench bench;
  bench.start();
  bench.run(2);
  bench.babbler.on_motion_status(answer(bench.last, motion_status_t::STATE_SETTLED));
  bench.babbler.on_control_status(control(true));
  EXPECT_FALSE(bench.babbler.on_sample(sample_of(bench.last, 2)));
  EXPECT_EQ(bench.babbler.num_samples(), 3);
  motion_status_t moving = answer(bench.last, motion_status_t::STATE_MOVING, false);
  moving.source = "controller";
  EXPECT_FALSE(bench.babbler.on_motion_status(moving));
  EXPECT_FALSE(bench.babbler.on_control_status(control(false)));  // not yet at rest
  moving.rest_since_utime = moving.utime;
  EXPECT_TRUE(bench.babbler.on_motion_status(moving));
  EXPECT_EQ(bench.babbler.num_unseen(), 0);
}

TEST(MotorBabblerTest, EveryFifthOfItsOwnSamplesIsTestWhateverOthersDoInBetween) {
  Bench bench;
  bench.start();
  std::int64_t own = 0;
  for (int i = 0; i < 20; ++i) {
    EXPECT_EQ(bench.is_test(), own % 5 == 4);
    if (i % 3 == 0) {
      action_command_t foreign = bench.last;
      foreign.source = "controller";
      bench.babbler.on_sample(sample_of(foreign, bench.num_samples++));
    }
    bench.run(1);
    EXPECT_EQ(bench.babbler.num_samples(), ++own);
  }
}

/// `message`: a command or its SAMPLE.
template <class Message>
bool is_drawn(const Message& message, const MotorBabblerConfig& config = active_config()) {
  const Eigen::VectorXd drawn = random_action(config, 1, message.action_id);
  return message.action == std::vector<double>(drawn.begin(), drawn.end());
}
/// After the first TEST sample, which is not judged yet.
Bench after_first_test() {
  Bench bench(active_config());
  bench.start();
  bench.run(4);
  EXPECT_FALSE(bench.make_sample());
  return bench;
}

TEST(MotorBabblerTest, CandidatesAreAFunctionOfSeedAndIdWithinTheLimits) {
  const MotorBabblerConfig config = test_config();
  std::set<std::vector<double>> all;
  for (std::int64_t id = 0; id < 50; ++id) {
    const auto candidates = candidate_actions(config, 3, id);
    EXPECT_EQ(candidates, candidate_actions(config, 3, id));
    EXPECT_EQ(candidates.size(), 40U);
    for (const Eigen::VectorXd& action : candidates) {
      all.insert({action.begin(), action.end()});
      for (std::size_t i = 0; i < config.signals.size(); ++i) {
        EXPECT_GE(action[i], config.signals[i].lower);
        EXPECT_LE(action[i], config.signals[i].upper);
      }
    }
  }
  EXPECT_EQ(all.size(), 2000U);
}

TEST(MotorBabblerTest, AnActionIsChosenByTheSchemaOfTheNewestVerdictAndAllSamples) {
  Bench bench = after_first_test();
  ASSERT_FALSE(bench.take(bench.babbler.on_body_schema(schema_of(5))));
  ASSERT_TRUE(bench.take(bench.babbler.on_model_health(verdict(4, 5))));
  std::vector<SeenAction> memory;
  for (int n = 0; n < 5; ++n) {
    memory.push_back({n, n != 4, random_action(active_config(), 1, n), {}});
  }
  const auto candidates = candidate_actions(active_config(), 1, 5);
  const Eigen::VectorXd expected =
      candidates[choose_action(from_message(schema_of(5)), memory, candidates)];
  EXPECT_EQ(bench.last.action, std::vector<double>(expected.begin(), expected.end()));
}

TEST(MotorBabblerTest, WhichOfSampleVerdictAndSchemaComesFirstDoesNotMatter) {
  Bench straight = after_first_test();
  straight.babbler.on_body_schema(schema_of(5));
  ASSERT_TRUE(straight.take(straight.babbler.on_model_health(verdict(4, 5))));

  Bench late = after_first_test();
  EXPECT_FALSE(late.take(late.babbler.on_model_health(verdict(4, 5))));
  EXPECT_NE(late.babbler.activity().find("BODY_SCHEMA version 5"), std::string::npos);
  EXPECT_FALSE(late.take(late.babbler.on_body_schema(schema_of(4))));
  ASSERT_TRUE(late.take(late.babbler.on_body_schema(schema_of(5))));
  EXPECT_EQ(late.last.action, straight.last.action);

  Bench early(active_config());
  early.start();
  early.run(4);
  early.babbler.on_motion_status(answer(early.last, motion_status_t::STATE_SETTLED));
  early.babbler.on_body_schema(schema_of(5));
  EXPECT_FALSE(early.take(early.babbler.on_model_health(verdict(4, 5))));
  // It hears the sample too early: there is a gap before it.
  EXPECT_FALSE(early.take(early.babbler.on_sample(sample_of(early.last, 4))));
  EXPECT_NE(early.babbler.activity().find("samples up to 4"), std::string::npos);
  ASSERT_TRUE(early.take(early.babbler.remember(sample_of(early.last, 4))));
  EXPECT_EQ(early.last.action, straight.last.action);
}

TEST(MotorBabblerTest, TestActionsAndWhatReplacesARefusedOneAreDrawn) {
  Bench bench = after_first_test();
  bench.babbler.on_body_schema(schema_of(5));
  ASSERT_TRUE(bench.take(bench.babbler.on_model_health(verdict(4, 5))));
  for (int n = 5; n < 9; ++n) {
    EXPECT_FALSE(is_drawn(bench.last)) << n;
    if (n == 6) {
      ASSERT_TRUE(bench.take(
          bench.babbler.on_motion_status(answer(bench.last, motion_status_t::STATE_REJECTED))));
      EXPECT_TRUE(is_drawn(bench.last));
    }
    ASSERT_TRUE(bench.make_sample());
  }
  ASSERT_TRUE(bench.is_test());
  EXPECT_TRUE(is_drawn(bench.last));
}

TEST(MotorBabblerTest, WhatTheMonitorFindsBetweenTwoVerdictsDoesNotChangeWhatIsChosen) {
  Bench undisturbed = after_first_test(), bench = after_first_test();
  for (Bench* each : {&undisturbed, &bench}) {
    each->babbler.on_body_schema(schema_of(5));
    ASSERT_TRUE(each->take(each->babbler.on_model_health(verdict(4, 5))));
  }
  for (int n = 5; n < 8; ++n) {
    bench.babbler.on_body_schema(schema_of(n + 1));
    bench.babbler.on_model_health(verdict(4, n + 1));
    ASSERT_TRUE(undisturbed.make_sample());
    ASSERT_TRUE(bench.make_sample());
    EXPECT_FALSE(is_drawn(bench.last));
    EXPECT_EQ(bench.last.action, undisturbed.last.action) << n;
  }
  // By the next verdict it counts, also if its schema was heard before.
  ASSERT_TRUE(bench.make_sample());
  ASSERT_FALSE(bench.make_sample());
  EXPECT_TRUE(bench.take(bench.babbler.on_model_health(verdict(9, 8))));
}

TEST(MotorBabblerTest, AProbeThatIsWantedIsTheFirstActionAfterTheVerdict) {
  for (const Choice choice : {Choice::kActive, Choice::kRandom}) {
    MotorBabblerConfig config = active_config();
    config.choice = choice;
    Bench bench(config);
    bench.start();
    bench.run(4);
    ASSERT_TRUE(bench.is_test());
    ASSERT_FALSE(bench.make_sample());
    model_health_t wants = verdict(4, 5);
    wants.probe_sample = 3;
    std::vector<double> probe;
    for (const Signal& signal : config.signals)
      probe.push_back(0.3 * signal.lower + 0.7 * signal.upper);
    set_array(wants.num_probe, wants.probe_action, probe);
    bench.babbler.on_body_schema(schema_of(5));
    ASSERT_TRUE(bench.take(bench.babbler.on_model_health(wants)));
    EXPECT_EQ(bench.last.action, wants.probe_action);
    EXPECT_EQ(bench.last.purpose, action_command_t::PURPOSE_PROBE);
    // A refused probe is not tried again and again.
    Bench refused = bench;
    ASSERT_TRUE(refused.take(
        refused.babbler.on_motion_status(answer(refused.last, motion_status_t::STATE_REJECTED))));
    EXPECT_EQ(refused.last.purpose, action_command_t::PURPOSE_TRAIN);
    EXPECT_NE(refused.last.action, wants.probe_action);
    // It takes the place of a TRAIN action: the rhythm of the TEST ones stays.
    for (int n = 5; n < 9; ++n) {
      EXPECT_FALSE(bench.is_test()) << n;
      ASSERT_TRUE(bench.make_sample());
      EXPECT_NE(bench.last.purpose, action_command_t::PURPOSE_PROBE);
    }
    EXPECT_TRUE(bench.is_test());
  }
}

TEST(MotorBabblerTest, AProbeBeyondTheLimitsIsNotMade) {
  Bench bench = after_first_test();
  model_health_t wants = verdict(4, 5);
  wants.probe_sample = 3;
  set_array(wants.num_probe, wants.probe_action,
            std::vector<double>(active_config().signals.size(), 1e3));
  bench.babbler.on_body_schema(schema_of(5));
  ASSERT_TRUE(bench.take(bench.babbler.on_model_health(wants)));
  EXPECT_EQ(bench.last.purpose, action_command_t::PURPOSE_TRAIN);
}

/// A verdict with `num` actions of the refiner, of which the third is beyond the limits.
model_health_t wanting(model_health_t health, std::int64_t wanted_sample, int num = 10) {
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
/// Takes the verdict on the newest sample, with its schema. Returns the next `num` actions, all of
/// them TRAIN.
std::vector<std::vector<double>> actions_after(Bench* bench, const model_health_t& health,
                                               int num) {
  bench->babbler.on_body_schema(schema_of(health.schema_version));
  EXPECT_TRUE(bench->take(bench->babbler.on_model_health(health)));
  std::vector<std::vector<double>> actions;
  for (int n = 0; n < num; ++n) {
    EXPECT_FALSE(bench->is_test());
    actions.push_back(bench->last.action);
    bench->make_sample();
  }
  return actions;
}

TEST(MotorBabblerTest, TheActionsThatTheRefinerWantsAreMadeOnceEachAndInOrder) {
  Bench bench = after_first_test();
  const model_health_t first = wanting(verdict(4, 5), 4), second = wanting(verdict(9, 10), 4),
                       third = wanting(verdict(14, 15), 4);
  std::vector<std::vector<double>> made = actions_after(&bench, first, 4);
  EXPECT_TRUE(is_drawn(bench.last));  // TEST
  ASSERT_FALSE(bench.make_sample());
  for (const auto& action : actions_after(&bench, second, 4)) made.push_back(action);
  ASSERT_FALSE(bench.make_sample());
  std::vector<std::vector<double>> wanted;
  for (int n = 0; n < 10; ++n)
    if (n != 2) wanted.push_back(first.wanted_actions[n].wanted_action);
  const auto rest = actions_after(&bench, third, 2);
  made.push_back(rest[0]);
  EXPECT_EQ(made, wanted);
  // None is left.
  EXPECT_EQ(bench.babbler.num_wanted_taken(), 9);
  EXPECT_EQ(std::count(wanted.begin(), wanted.end(), rest[1]), 0);
}

TEST(MotorBabblerTest, AWantedActionThatIsRefusedIsNotTriedAgain) {
  Bench bench = after_first_test();
  const model_health_t wants = wanting(verdict(4, 5), 4);
  bench.babbler.on_body_schema(schema_of(5));
  ASSERT_TRUE(bench.take(bench.babbler.on_model_health(wants)));
  EXPECT_EQ(bench.last.action, wants.wanted_actions[0].wanted_action);
  ASSERT_TRUE(bench.take(
      bench.babbler.on_motion_status(answer(bench.last, motion_status_t::STATE_REJECTED))));
  EXPECT_TRUE(is_drawn(bench.last));
  ASSERT_TRUE(bench.make_sample());
  EXPECT_EQ(bench.last.action, wants.wanted_actions[1].wanted_action);
}

TEST(MotorBabblerTest, WantedActionsOfASchemaThatIsGoneAreDroppedForThoseOfANewOne) {
  Bench bench = after_first_test();
  actions_after(&bench, wanting(verdict(4, 5), 4), 4);
  ASSERT_FALSE(bench.make_sample());
  Bench newer = bench;
  for (const auto& action : actions_after(&bench, verdict(9, 10), 4))
    for (const auto& wanted : wanting(verdict(4, 5), 4).wanted_actions)
      EXPECT_NE(action, wanted.wanted_action);
  EXPECT_EQ(bench.babbler.num_wanted_taken(), 4);

  const model_health_t others = wanting(verdict(9, 10), 9);
  EXPECT_EQ(actions_after(&newer, others, 4)[0], others.wanted_actions[0].wanted_action);
}

TEST(MotorBabblerTest, OnlyWhereActionsAreChosenAreThoseOfTheRefinerMade) {
  Bench bench;
  bench.start();
  bench.run(4);
  ASSERT_FALSE(bench.make_sample());
  ASSERT_TRUE(bench.take(bench.babbler.on_model_health(wanting(verdict(4, 5), 4))));
  EXPECT_TRUE(is_drawn(bench.last, test_config()));
}

TEST(MotorBabblerTest, AMonitorThatWaitsForTheRefinerIsWaitedFor) {
  Bench bench = after_first_test();
  model_health_t waiting = verdict(-1, 0);
  waiting.awaited_refinement = 4;
  for (int t = 200; t < 230; ++t) {
    EXPECT_FALSE(bench.take(bench.babbler.on_tick(t * kSecond)));
    EXPECT_FALSE(bench.take(bench.babbler.on_model_health(waiting)));
  }
  const model_health_t wants = wanting(verdict(4, 5), 4);
  EXPECT_EQ(actions_after(&bench, wants, 1)[0], wants.wanted_actions[0].wanted_action);
  EXPECT_EQ(bench.babbler.num_without_schema(), 0);
}

TEST(MotorBabblerTest, WithoutASchemaActionsAreDrawn) {
  Bench bench = after_first_test();
  ASSERT_TRUE(bench.take(bench.babbler.on_model_health(verdict(4, 0))));
  EXPECT_TRUE(is_drawn(bench.last));
  EXPECT_EQ(bench.babbler.num_without_schema(), 0);
}

TEST(MotorBabblerTest, AnInitialSchemaThatStandsIsChosenByToo) {
  Bench bench = after_first_test();
  model_health_t health = verdict(4, 0);
  set_array(health.num_edges, health.edge_health, {edge_health_t{}});
  EXPECT_FALSE(bench.take(bench.babbler.on_model_health(health)));
  ASSERT_TRUE(bench.take(bench.babbler.on_body_schema(schema_of(0))));
  EXPECT_FALSE(is_drawn(bench.last));
}

TEST(MotorBabblerTest, ASchemaThatDoesNotComeIsGivenUpUntilTheNextTest) {
  Bench bench = after_first_test();
  EXPECT_FALSE(bench.take(bench.babbler.on_model_health(verdict(4, 5))));
  EXPECT_FALSE(bench.take(bench.babbler.on_tick(200 * kSecond)));
  EXPECT_FALSE(bench.take(bench.babbler.on_tick(210 * kSecond - 1)));
  ASSERT_TRUE(bench.take(bench.babbler.on_tick(210 * kSecond)));
  EXPECT_EQ(bench.babbler.num_without_schema(), 1);
  // Late is not in between.
  bench.babbler.on_body_schema(schema_of(5));
  for (int n = 5; n < 9; ++n) {
    EXPECT_TRUE(is_drawn(bench.last)) << n;
    ASSERT_TRUE(bench.make_sample());
  }
  ASSERT_FALSE(bench.make_sample());
  bench.babbler.on_body_schema(schema_of(10));
  ASSERT_TRUE(bench.take(bench.babbler.on_model_health(verdict(9, 10))));
  EXPECT_FALSE(is_drawn(bench.last));
  EXPECT_EQ(bench.babbler.num_without_schema(), 1);
}

TEST(MotorBabblerTest, ARunThatIsOverWaitsForNoSchema) {
  MotorBabblerConfig config = active_config();
  config.stop.min_samples = config.stop.max_samples = 10;
  Bench bench(config);
  bench.start();
  bench.run(9);
  ASSERT_TRUE(bench.is_test());
  bench.make_sample();
  bench.babbler.on_model_health(verdict(9, 10));
  EXPECT_TRUE(bench.babbler.is_done());
}

MotorBabblerConfig single_config(double share = 0.34) {
  MotorBabblerConfig config = test_config();
  config.single_joint_share = share;
  config.stop.min_samples = config.stop.max_samples = 200;
  return config;
}

/// SAMPLE of an arm of which these parts are seen.
sample_t ends_seen(const action_command_t& command, std::int64_t sample_index,
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

/// Signals in which two actions differ.
std::vector<std::size_t> differences(const std::vector<double>& a, const std::vector<double>& b) {
  std::vector<std::size_t> result;
  for (std::size_t s = 0; s < a.size(); ++s)
    if (a[s] != b[s]) result.push_back(s);
  return result;
}

/// The samples of a run whose TEST samples all find the schema incomplete.
std::vector<sample_t> ends_run(const MotorBabblerConfig& config, int num_samples,
                               const std::function<std::vector<int>(int)>& parts_at) {
  Bench bench(config);
  bench.start();
  std::vector<sample_t> samples;
  for (int n = 0; n < num_samples; ++n) {
    samples.push_back(ends_seen(bench.last, n, parts_at(n)));
    bench.babbler.on_motion_status(answer(bench.last, motion_status_t::STATE_SETTLED));
    bench.babbler.remember(samples.back());
    bench.take(bench.babbler.on_sample(samples.back()));
    if (samples.back().purpose == action_command_t::PURPOSE_TEST)
      bench.take(bench.babbler.on_model_health(bad_health(n)));
  }
  return samples;
}

TEST(MotorBabblerTest, WhereTwoPartsAreSeenAThirdOfTheTrainActionsMovesOneJointAlone) {
  for (const Choice choice : {Choice::kRandom, Choice::kActive}) {
    MotorBabblerConfig config = single_config();
    config.choice = choice;
    const auto samples = ends_run(config, 100, [](int) { return std::vector{1, 2}; });
    int num_single = 0;
    std::set<std::vector<double>> poses;
    std::vector<double> pose;
    for (int n = 0; n < 100; ++n) {
      const bool is_test = n % 5 == 4;
      EXPECT_EQ(samples[n].purpose == action_command_t::PURPOSE_TEST, is_test) << n;
      if (is_drawn(samples[n], config)) {
        if (!is_test && num_single % 3 == 0) pose = samples[n].action;
        continue;
      }
      EXPECT_FALSE(is_test) << n;
      EXPECT_GT(n, 4) << "before the first verdict";
      // About one pose, each signal in turn and far.
      const std::size_t s = num_single++ % 3;
      ASSERT_EQ(differences(samples[n].action, pose), std::vector{s}) << n;
      poses.insert(pose);
      const Signal& signal = config.signals[s];
      EXPECT_GE(std::abs(samples[n].action[s] - pose[s]), 0.2499 * (signal.upper - signal.lower));
      EXPECT_GE(samples[n].action[s], signal.lower);
      EXPECT_LE(samples[n].action[s], signal.upper);
    }
    EXPECT_NEAR(num_single, 0.34 * 80, 2);
    EXPECT_EQ(poses.size(), (num_single + 2U) / 3);
  }
}

TEST(MotorBabblerTest, OnceAThirdPartWasSeenOrTheSchemaIsCompleteNoJointMovesAlone) {
  const MotorBabblerConfig config = single_config(1);
  const auto with_third = ends_run(config, 60, [](int n) {
    return n == 20 ? std::vector{1, 2, 3} : std::vector{1, 2};
  });
  for (int n = 0; n < 60; ++n)
    EXPECT_EQ(is_drawn(with_third[n], config), n < 5 || n > 20 || n % 5 == 4) << n;

  for (const int complete_at : {24, 29}) {
    Bench bench(config);
    bench.start();
    for (int n = 0; n < 60; ++n) {
      const sample_t sample = ends_seen(bench.last, n);
      EXPECT_EQ(is_drawn(sample, config), n < 5 || n > complete_at || n % 5 == 4) << n;
      // A verdict may come before its sample.
      const model_health_t health = n < complete_at ? bad_health(n) : good_health(n);
      const bool is_early = complete_at == 29;
      if (is_early && bench.is_test()) bench.take(bench.babbler.on_model_health(health));
      const bool was_test = bench.is_test();
      bench.babbler.on_motion_status(answer(bench.last, motion_status_t::STATE_SETTLED));
      bench.take(bench.babbler.on_sample(sample));
      if (!is_early && was_test) bench.take(bench.babbler.on_model_health(health));
      // What is found in between changes nothing.
      if (n > 5 && !was_test) bench.babbler.on_model_health(good_health(n / 5 * 5 - 1));
    }
  }
}

TEST(MotorBabblerTest, AJointMovesAloneFromAPoseAtWhichBothPartsWereSeen) {
  const MotorBabblerConfig config = single_config();
  const auto samples = ends_run(config, 100, [](int n) {
    return n % 3 ? std::vector{1} : std::vector{1, 2};
  });
  int num_single = 0;
  for (int n = 0; n < 100; ++n) {
    if (is_drawn(samples[n], config)) continue;
    ++num_single;
    const bool has_pose = std::any_of(samples.begin(), samples.begin() + n, [&](const sample_t& s) {
      return s.num_parts == 2 && s.purpose != action_command_t::PURPOSE_TEST &&
             differences(s.action, samples[n].action).size() == 1;
    });
    EXPECT_TRUE(has_pose) << n;
  }
  EXPECT_GT(num_single, 20);
  for (const sample_t& sample : ends_run(config, 50, [](int) { return std::vector{1}; }))
    EXPECT_TRUE(is_drawn(sample, config));
}

TEST(MotorBabblerTest, ARefusedMoveOfOneJointIsReplacedByAnotherOfThatJoint) {
  const MotorBabblerConfig config = single_config(1);
  Bench bench(config);
  bench.start();
  for (int n = 0; n < 12; ++n) {
    const bool was_test = bench.is_test();
    bench.babbler.on_motion_status(answer(bench.last, motion_status_t::STATE_SETTLED));
    bench.take(bench.babbler.on_sample(ends_seen(bench.last, n)));
    if (was_test) bench.take(bench.babbler.on_model_health(bad_health(n)));
    if (n < 5 || bench.is_test()) continue;
    const std::vector<double> refused = bench.last.action;
    ASSERT_TRUE(bench.take(
        bench.babbler.on_motion_status(answer(bench.last, motion_status_t::STATE_REJECTED))));
    EXPECT_EQ(differences(bench.last.action, refused).size(), 1U) << n;
  }
}

/// Driver, observer and monitor that outlive the babbler. Each answers and repeats as in a group.
class World {
 public:
  World(double kill_share, std::uint64_t seed, MotorBabblerConfig config = test_config())
      : config_(std::move(config)), kill_share_(kill_share), rng_(seed) {}
  ~World() { std::filesystem::remove(file_); }

  /// Runs until the babbler is done; every message may be the last that this babbler hears or
  /// sends.
  void run() {
    start();
    for (int i = 0; i < 20'000 && !babbler_->is_done(); ++i) {
      now_ += kSecond / 10;
      tell(babbler_->on_tick(now_));
      if (i % 10) continue;
      tell(babbler_->on_motion_status(status_));
      if (!samples.empty()) tell(babbler_->on_sample(samples.back()));
      tell_verdict();
    }
  }

  std::vector<action_command_t> served;
  std::vector<sample_t> samples;
  int num_kills = 0;

 private:
  void start() {
    babbler_ = std::make_unique<MotorBabbler>(config_, 1);
    if (!kept_.empty()) {
      std::ofstream(file_) << kept_;
      babbler_->restore(file_);
    }
    num_remembered_ = 0;
    while (num_remembered_ < samples.size()) babbler_->remember(samples[num_remembered_++]);
  }
  /// The schema after sample n is version n + 1; every TEST sample makes one.
  void tell_verdict() {
    std::int64_t version = 0;
    for (const sample_t& sample : samples) {
      if (sample.purpose == action_command_t::PURPOSE_TEST) version = sample.sample_index + 1;
    }
    if (version > 0) tell(babbler_->on_body_schema(schema_of(version)));
    model_health_t health = verdict(samples.empty() ? -1 : newest_index(), version);
    // Of every second schema actions are wanted.
    const std::int64_t wanted_sample = version / 10 * 10 - 1;
    if (wanted_sample > 0) health = wanting(health, wanted_sample, 3);
    tell(babbler_->on_model_health(health));
  }
  std::int64_t newest_index() const { return samples.back().sample_index; }
  bool is_killed() {
    if (std::uniform_real_distribution<double>(0, 1)(rng_) >= kill_share_) return false;
    ++num_kills;
    start();
    return true;
  }
  /// As MotorBabblerProcess does: saved, then sent.
  void tell(const std::optional<action_command_t>& command) {
    if (is_killed()) return;
    kept_ = babbler_->state_text();
    if (is_killed() || !command) return;
    serve(*command);
  }
  void serve(const action_command_t& command) {
    const bool is_new = std::none_of(served.begin(), served.end(), [&](const auto& before) {
      return before.epoch == command.epoch && before.action_id == command.action_id;
    });
    if (is_new) served.push_back(command);
    const bool is_refused = command.action_id % 7 == 3;
    status_ = answer(command,
                     is_refused ? motion_status_t::STATE_REJECTED : motion_status_t::STATE_SETTLED);
    if (!is_refused && is_new)
      samples.push_back(ends_seen(command, static_cast<std::int64_t>(samples.size())));
    tell(babbler_->on_motion_status(status_));
    if (is_refused || !is_new) return;
    if (num_remembered_ < samples.size()) tell(babbler_->remember(samples[num_remembered_++]));
    tell(babbler_->on_sample(samples.back()));
    tell_verdict();
  }

  const std::filesystem::path file_ =
      std::filesystem::path(testing::TempDir()) / ("babbler_state_" + std::to_string(getpid()));
  const MotorBabblerConfig config_;
  std::size_t num_remembered_ = 0;  ///< by this babbler
  std::string kept_;
  const double kill_share_;
  std::mt19937_64 rng_;
  std::unique_ptr<MotorBabbler> babbler_;
  motion_status_t status_ = idle_at_rest(5 * kSecond);
  std::int64_t now_ = 100 * kSecond;
};

void kill_and_compare(const MotorBabblerConfig& config) {
  World undisturbed(0, 0, config);
  undisturbed.run();
  ASSERT_EQ(undisturbed.samples.size(), 40U);
  int num_kills = 0;
  for (std::uint64_t seed = 0; seed < 10; ++seed) {
    World world(0.05, seed, config);
    world.run();
    ASSERT_EQ(world.served.size(), undisturbed.served.size()) << seed;
    for (std::size_t i = 0; i < world.served.size(); ++i) {
      const action_command_t &a = world.served[i], &b = undisturbed.served[i];
      EXPECT_EQ(std::tie(a.epoch, a.action_id, a.purpose, a.utime, a.expiry_utime, a.action),
                std::tie(b.epoch, b.action_id, b.purpose, b.utime, b.expiry_utime, b.action))
          << seed << " " << i;
    }
    EXPECT_EQ(world.samples.size(), undisturbed.samples.size());
    num_kills += world.num_kills;
  }
  EXPECT_GT(num_kills, 200);
}

TEST(MotorBabblerTest, KilledAtAnyMomentItGoesOnAsIfNothingHadHappened) {
  kill_and_compare(test_config());
}

TEST(MotorBabblerTest, KilledAtAnyMomentItChoosesTheSameActions) {
  kill_and_compare(active_config());
}

TEST(MotorBabblerTest, KilledAtAnyMomentItMovesTheSameJointsAlone) {
  for (MotorBabblerConfig config : {test_config(), active_config()}) {
    config.single_joint_share = 0.5;
    kill_and_compare(config);
  }
}

TEST(MotorBabblerTest, ARestartListensFirstWhetherTheArmIsLent) {
  Bench before;
  before.start();
  before.run(3);
  const std::filesystem::path file =
      std::filesystem::path(testing::TempDir()) / ("babbler_restart_" + std::to_string(getpid()));
  std::ofstream(file) << before.babbler.state_text();
  const auto restarted = [&] {
    MotorBabbler babbler(test_config(), 1);
    babbler.restore(file);
    return babbler;
  };
  const motion_status_t status = answer(before.last, motion_status_t::STATE_SETTLED);

  MotorBabbler alone = restarted();
  EXPECT_FALSE(alone.on_tick(100 * kSecond));
  EXPECT_FALSE(alone.on_motion_status(status));
  EXPECT_FALSE(alone.on_tick(101 * kSecond));
  const auto again = alone.on_tick(101 * kSecond + kSecond / 2);
  ASSERT_TRUE(again);
  EXPECT_EQ(again->action_id, before.last.action_id);
  EXPECT_EQ(again->expiry_utime, before.last.expiry_utime);

  MotorBabbler free = restarted();
  EXPECT_FALSE(free.on_motion_status(status));
  EXPECT_TRUE(free.on_control_status(control(false)));

  MotorBabbler lent = restarted();
  EXPECT_FALSE(lent.on_control_status(control(true)));
  EXPECT_FALSE(lent.on_motion_status(status));
  EXPECT_FALSE(lent.on_tick(100 * kSecond));
  EXPECT_FALSE(lent.on_tick(200 * kSecond));
  EXPECT_FALSE(lent.on_sample(sample_of(before.last, 3)));  // its SAMPLE is there
  const auto next = lent.on_control_status(control(false));
  ASSERT_TRUE(next);
  EXPECT_EQ(next->action_id, before.last.action_id + 1);
  EXPECT_EQ(next->purpose, action_command_t::PURPOSE_TEST);

  EXPECT_THROW(MotorBabbler(test_config(), 2).restore(file), ConfigError);
  MotorBabblerConfig other = test_config();
  other.signals.pop_back();
  EXPECT_THROW(MotorBabbler(other, 1).restore(file), ConfigError);
  std::filesystem::remove(file);
}

TEST(MotorBabblerTest, BeforeItsFirstCommandThereIsNothingToKeep) {
  MotorBabbler babbler(test_config(), 1);
  babbler.on_model_health(bad_health(8));
  EXPECT_EQ(babbler.state_text(), "");
}

TEST(MotorBabblerTest, AnswersAndSamplesOfOthersAreIgnored) {
  Bench bench;
  bench.start();
  bench.run(1);
  const auto foreign = [&](auto message) {
    std::vector<decltype(message)> result(3, message);
    result[0].source = "controller";
    result[1].epoch -= 1;
    result[2].action_id -= 1;
    return result;
  };
  for (const auto& status : foreign(answer(bench.last, motion_status_t::STATE_REJECTED)))
    EXPECT_FALSE(bench.babbler.on_motion_status(status));
  for (const auto& status : foreign(answer(bench.last, motion_status_t::STATE_SETTLED)))
    EXPECT_FALSE(bench.babbler.on_motion_status(status));
  for (const auto& sample : foreign(sample_of(bench.last, 1)))
    EXPECT_FALSE(bench.babbler.on_sample(sample));
  EXPECT_EQ(bench.babbler.num_rejected(), 0);
  // It still waits for its own answer.
  bench.babbler.on_tick(100 * kSecond);
  const auto again = bench.babbler.on_tick(101 * kSecond);
  ASSERT_TRUE(again);
  EXPECT_EQ(again->action_id, bench.last.action_id);
}

TEST(MotorBabblerTest, AnOldSampleThatIsReplayedDoesNotTurnTheCountBack) {
  Bench bench;
  bench.start();
  bench.run(3);
  action_command_t foreign = bench.last;
  foreign.source = "controller";
  bench.babbler.on_sample(sample_of(foreign, 0));
  EXPECT_EQ(bench.babbler.num_samples(), 3);
}

TEST(MotorBabblerTest, SaysWhatItWaitsFor) {
  Bench bench;
  EXPECT_EQ(bench.babbler.activity(), "waiting for MOTION_STATUS of a driver");
  bench.start();
  EXPECT_EQ(bench.babbler.activity(), "0 samples, waiting for the driver's answer to action 0");
  bench.run(4);
  bench.babbler.on_motion_status(answer(bench.last, motion_status_t::STATE_SETTLED));
  EXPECT_EQ(bench.babbler.activity(), "4 samples, waiting for the SAMPLE of action 4");
  bench.babbler.on_sample(sample_of(bench.last, 4));
  EXPECT_EQ(bench.babbler.activity(), "5 samples, waiting for MODEL_HEALTH of sample 4");
}

TEST(MotorBabblerTest, TheConfigurationIsReadInSiUnits) {
  const MotorBabblerConfig config =
      MotorBabblerConfig::load(std::string(BODYSCHEMA_CONFIG) + "/arm2/motor_babbler.yaml");
  EXPECT_EQ(config.choice, Choice::kRandom);
  EXPECT_EQ(config.signals.size(), 2U);
  EXPECT_EQ(config.resend_us, 1 * kSecond);
  EXPECT_EQ(config.expiry_us, 60 * kSecond);
  EXPECT_NEAR(config.stop.rotation_rad, kDegree, 1e-12);
  EXPECT_EQ(config.extreme_from, 0.7);
}

TEST(MotorBabblerTest, MoreLeastSamplesThanMostAreRefusedByName) {
  namespace fs = std::filesystem;
  const fs::path rig = fs::path(testing::TempDir()) / "motor_babbler_least_samples";
  fs::remove_all(rig);
  fs::copy(std::string(BODYSCHEMA_CONFIG) + "/arm2", rig, fs::copy_options::recursive);
  const fs::path file = rig / "motor_babbler.yaml";
  std::stringstream text;
  text << std::ifstream(file).rdbuf();
  std::ofstream(file) << std::regex_replace(text.str(), std::regex("max_samples: *[0-9]+"),
                                            "max_samples: 3");
  try {
    MotorBabblerConfig::load(file);
    ADD_FAILURE() << "accepted";
  } catch (const ConfigError& error) {
    EXPECT_NE(std::string(error.what()).find("above max_samples, 3"), std::string::npos)
        << error.what();
  }
  fs::remove_all(rig);
}

}  // namespace
}  // namespace bodyschema
