// Class MotorBabbler: how it waits for samples and verdicts, and when it stops.

#include <gtest/gtest.h>

#include "tests/processes/motor_babbler/motor_babbler_bench.h"

namespace bodyschema::test {
namespace {

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

}  // namespace
}  // namespace bodyschema::test
