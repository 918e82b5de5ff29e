// Class MotorBabbler: its commands, what the driver answers, and an arm that is lent.

#include <gtest/gtest.h>

#include <random>

#include "common/bus/check.h"
#include "tests/processes/motor_babbler/motor_babbler_bench.h"

namespace bodyschema::test {
namespace {

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
// Long, for every kind of event is a case of its own.
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

}  // namespace
}  // namespace bodyschema::test
