// Class Controller: what must be heard before and while it moves anything.

#include <gtest/gtest.h>

#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "tests/processes/controller/controller_bench.h"

namespace bodyschema::test {
namespace {

TEST(ControllerTest, NothingIsSentBeforeEveryInputWasHeard) {
  const struct {
    const char* input;
    std::function<void(Bench&)> mute;
  } cases[] = {{"MOTION_STATUS", [](Bench& b) { b.driver_speaks = false; }},
               {"BODY_SCHEMA", [](Bench& b) { b.monitor_speaks = false; }},
               {"MARKER_POSES", [](Bench& b) { b.eyes_open = false; }}};
  for (const auto& c : cases) {
    Bench bench;
    c.mute(bench);
    bench.start();
    bench.give(position_target(0, kNear));
    bench.run(2);
    EXPECT_EQ(bench.status.control_state, S::CONTROL_WAITING) << c.input;
    EXPECT_TRUE(bench.has_why(c.input)) << bench.status.why;
    EXPECT_EQ(bench.status.owns_arm, 0) << "the babbler may be what is missing";
    bench.run(2);
    EXPECT_EQ(bench.status.control_state, S::CONTROL_REFUSED) << c.input;
    EXPECT_TRUE(bench.has_why(c.input)) << bench.status.why;
    // What comes later does not revive it.
    bench.driver_speaks = bench.monitor_speaks = bench.eyes_open = true;
    bench.start();
    bench.run(10);
    EXPECT_TRUE(bench.moves.empty());
    EXPECT_EQ(bench.num_holds, 0);
    EXPECT_EQ(bench.status.control_state, S::CONTROL_REFUSED);
  }
}

TEST(ControllerTest, AnInputThatComesInTimeIsWaitedFor) {
  Bench bench;
  bench.monitor_speaks = false;
  bench.start();
  bench.give(position_target(0, kNear));
  bench.run(2);
  bench.monitor_speaks = true;
  EXPECT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
}

TEST(ControllerTest, AHoldBeforeTheDriverIsHeardIsSentAsSoonAsItIs) {
  Bench bench;
  bench.driver_speaks = false;
  bench.run(2);
  bench.give(other_target(0, Target::KIND_HOLD));
  bench.run(5);
  EXPECT_EQ(bench.num_holds, 0);
  EXPECT_EQ(bench.status.owns_arm, 1);
  bench.driver_speaks = true;
  bench.repeat();
  EXPECT_EQ(bench.num_holds, 1);
}

TEST(ControllerTest, FromAPositionThatWasNotHeardItDoesNotMove) {
  // A restarted controller hears the answer to a rejection, which says nothing about the arm.
  const auto rejected = [](Bench& bench) {
    motion_status_t message = bench.motion;
    message.source = "motor_babbler";
    message.action_id = 12;
    message.state = motion_status_t::STATE_REJECTED;
    message.reason = "collision";
    bench.motion = message;
  };
  Bench bench;
  rejected(bench);
  bench.start();
  bench.give(position_target(0, kNear));
  bench.run(20);
  EXPECT_TRUE(bench.moves.empty());
  EXPECT_EQ(bench.status.control_state, S::CONTROL_REFUSED);
  EXPECT_TRUE(bench.has_why("where the arm is")) << bench.status.why;

  // The SAMPLE of this rest tells it.
  Bench second;
  rejected(second);
  second.motion.commanded = {-30, 0.2, 1};
  second.start();
  second.show_sample();
  second.give(position_target(0, kNear));
  EXPECT_TRUE(second.run_until_state(S::CONTROL_REACHED)) << second.status.why;
}

TEST(ControllerTest, TakingTheArmWaitsForRestAndForTheBabblersSample) {
  Bench bench;
  bench.start();
  bench.observer_works = false;
  bench.arm = {20, 0.1, 4};
  bench.settle("motor_babbler", 1, 12, bench.arm);
  motion_status_t moving = bench.motion;
  moving.state = motion_status_t::STATE_MOVING;
  moving.rest_since_utime = -1;
  const motion_status_t settled = bench.motion;
  bench.say(moving);
  bench.give(position_target(0, kNear));
  bench.run(2);
  EXPECT_EQ(bench.status.owns_arm, 1);
  EXPECT_TRUE(bench.has_why("rest")) << bench.status.why;
  bench.say(settled);
  bench.run(2);
  EXPECT_TRUE(bench.has_why("SAMPLE of action 12 of motor_babbler")) << bench.status.why;
  EXPECT_TRUE(bench.moves.empty());
  bench.observer_works = true;
  bench.show_sample();
  EXPECT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
}

// The babbler's newest action is a TEST, which the monitor has yet to judge.
Bench bench_with_unjudged_test() {
  Bench bench;
  bench.health = health_of(1, 2, 3, schema_edge_t::EDGE_OK);
  bench.health->judged_sample = bench.health->awaited_refinement = -1;
  bench.start();
  bench.arm = {20, 0.1, 4};
  bench.settle("motor_babbler", 1, 12, bench.arm, action_command_t::PURPOSE_TEST);
  return bench;
}

// So that what is learned and refined does not depend on when a target was given.
TEST(ControllerTest, TakingTheArmWaitsForTheVerdictOnATestSample) {
  Bench bench = bench_with_unjudged_test();
  bench.give(position_target(0, kNear));
  bench.run(5);
  EXPECT_TRUE(bench.moves.empty());
  EXPECT_EQ(bench.status.owns_arm, 1);
  EXPECT_TRUE(bench.has_why("verdict on sample 0")) << bench.status.why;
  // As long as the monitor waits for the refiner.
  bench.health->awaited_refinement = 0;
  bench.run(60);
  EXPECT_TRUE(bench.moves.empty());
  bench.health->judged_sample = 0;
  bench.health->awaited_refinement = -1;
  EXPECT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
}

TEST(ControllerTest, AVerdictIsNotAwaitedForEver) {
  // Nobody judges; or who waited for the refiner is heard no more.
  for (const std::int64_t awaited : {-1, 0}) {
    Bench bench = bench_with_unjudged_test();
    bench.health->awaited_refinement = awaited;
    bench.repeat();
    bench.give(position_target(0, kNear));
    if (awaited == 0) bench.health.reset();
    bench.run(8);
    EXPECT_TRUE(bench.moves.empty());
    EXPECT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  }
}

TEST(ControllerTest, AMoveThatNeverEndsIsHeld) {
  Bench bench;
  bench.start();
  bench.driver_serves = false;
  bench.give(position_target(0, kFar));
  ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
  bench.motion.rest_since_utime = -1;
  bench.answer_last_move(motion_status_t::STATE_MOVING);
  const auto go_on = [&](double seconds) {
    for (int n = 0; n < 2 * seconds; ++n) {
      bench.motion.utime += kSecond / 2;
      bench.answer_last_move(motion_status_t::STATE_MOVING);
      bench.show_frame();
      bench.run(0.5);
    }
  };
  go_on(19);
  EXPECT_EQ(bench.status.control_state, S::CONTROL_MOVING) << bench.status.why;
  EXPECT_EQ(bench.num_holds, 0);
  bench.driver_serves = true;
  go_on(2);
  EXPECT_EQ(bench.num_holds, 1);
  EXPECT_EQ(bench.status.control_state, S::CONTROL_HOLDING) << bench.status.why;
}

TEST(ControllerTest, AnArmThatNeverRestsIsGivenBack) {
  for (const bool in_the_middle : {false, true}) {
    Bench bench;
    bench.start();
    bench.driver_serves = false;
    if (in_the_middle) {
      bench.give(position_target(0, kFar));
      ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
    }
    const std::size_t num_moves = bench.moves.size();
    bench.motion.rest_since_utime = -1;
    if (in_the_middle) {
      bench.answer_last_move(motion_status_t::STATE_REJECTED, "the arm moves");
    } else {
      bench.motion.source = "motor_babbler";
      bench.motion.action_id = 12;
      bench.motion.kind = action_command_t::KIND_MOVE;
      bench.motion.state = motion_status_t::STATE_MOVING;
      bench.say(bench.motion);
      bench.give(position_target(0, kFar));
    }
    bench.run(19.5);
    EXPECT_EQ(bench.status.owns_arm, 1) << bench.status.why;
    EXPECT_TRUE(bench.has_why("rest")) << bench.status.why;
    bench.run(1);
    EXPECT_EQ(bench.status.control_state, S::CONTROL_REFUSED);
    EXPECT_EQ(bench.status.owns_arm, 0);
    EXPECT_TRUE(bench.has_why("given up after 20 s: waiting for the arm to come to rest"))
        << bench.status.why;
    EXPECT_EQ(bench.moves.size(), num_moves);
  }
}

TEST(ControllerTest, ASampleThatNeverComesDoesNotBlockTheArmForEver) {
  Bench bench;
  bench.start();
  bench.observer_works = false;
  bench.arm = {20, 0.1, 4};
  bench.settle("motor_babbler", 1, 12, bench.arm);
  bench.give(position_target(0, kNear));
  bench.run(4.5);
  EXPECT_TRUE(bench.moves.empty());
  bench.observer_works = true;
  EXPECT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
}

TEST(ControllerTest, WhoMovesTheArmInBetweenIsFollowedFromWhereItIsThen) {
  Bench bench;
  bench.start();
  bench.give(position_target(0, kFar));
  ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 2; }));
  bench.arm = {60, -0.5, 9};
  bench.settle("motor_babbler", 1, 30, bench.arm);
  // The bench insists on steps from there of at most max_step.
  EXPECT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
}

// ---- what cannot be served

TEST(ControllerTest, WhatCannotBeServedIsRefusedAndTheArmIsNotMoved) {
  Target unknown = position_target(0, kNear), unconnected = unknown;
  unknown.target_part = 42;
  unconnected.target_part = 5;
  const struct {
    Target target;
    const char* why;
  } cases[] = {{unknown, "no part 42"},
               {unconnected, "not connected"},
               {position_target(0, kBeyond), "no nearer than 900.0 mm"}};
  for (const auto& c : cases) {
    Bench bench;
    bench.start();
    bench.give(c.target);
    bench.run(2);
    EXPECT_EQ(bench.status.control_state, S::CONTROL_REFUSED);
    EXPECT_TRUE(bench.has_why(c.why)) << bench.status.why;
    EXPECT_EQ(bench.status.owns_arm, 0);
    EXPECT_EQ(bench.status.num_moves, 0);
    EXPECT_TRUE(bench.moves.empty());
    EXPECT_EQ(bench.num_holds, 0);
  }
  Bench bench;
  bench.start();
  bench.give(position_target(0, kBeyond));
  bench.run(2);
  EXPECT_NEAR(bench.status.predicted_error_m, 0.9, 1e-3);
}

TEST(ControllerTest, ARejectedWayIsReplacedByAnother) {
  Bench bench;
  bench.start();
  int num_rejections = 0;
  std::optional<std::vector<double>> first;
  bench.rejects = [&](const action_command_t& command) -> std::string {
    if (!first) first = command.action;
    return num_rejections++ < 2 ? "link2 touches link4" : "";
  };
  bench.give(position_target(0, kNear));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_GT(num_rejections, 2);
  EXPECT_NE(bench.arm, *first);
  EXPECT_LT((bench.part_position() - kNear).norm(), 1e-4);
  EXPECT_EQ(bench.controller.counters().at("action rejected"), 2);
  EXPECT_EQ(bench.status.num_moves, static_cast<int>(bench.moves.size()) - 2);
}

// Many a driver says a refusal once and repeats what the arm does: a HOLD, its last move.
TEST(ControllerTest, WhatADriverRepeatsAfterARefusalIsNoNews) {
  for (const bool held_before : {false, true}) {
    Bench bench;
    bench.start();
    bench.give(position_target(0, kNear));
    ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED));
    if (held_before) {
      motion_status_t held = bench.motion;
      held.source = "console";
      held.kind = action_command_t::KIND_HOLD;
      held.state = motion_status_t::STATE_HOLDING;
      bench.say(held);
      ASSERT_EQ(bench.status.control_state, S::CONTROL_HOLDING);
    }
    const motion_status_t doing = bench.motion;
    int num_rejections = 0;
    bench.rejects = [&](const auto&) -> std::string {
      return num_rejections++ < 2 ? "link2 touches link4" : "";
    };
    bench.give(position_target(1, kFar));
    ASSERT_TRUE(bench.run_until([&] { return num_rejections == 1; }));
    bench.say(doing);
    ASSERT_TRUE(bench.run_until([&] { return num_rejections == 2; }));
    bench.say(doing);
    EXPECT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
    EXPECT_FALSE(bench.controller.counters().contains("driver began anew"));
  }
}

TEST(ControllerTest, ADriverThatRejectsEveryWayIsNotAskedForEver) {
  Bench bench;
  bench.start();
  bench.rejects = [](const auto&) { return "link2 touches link4"; };
  bench.give(position_target(0, kNear));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REFUSED));
  EXPECT_LE(bench.moves.size(), 4U);
  EXPECT_GE(bench.moves.size(), 2U);
  EXPECT_TRUE(bench.has_why("link2 touches link4")) << bench.status.why;
  EXPECT_EQ(bench.status.owns_arm, 0);
  EXPECT_EQ(bench.status.num_moves, 0);
}

// To the first way point the arm goes as it likes.
TEST(ControllerTest, OnALineNoOtherWayIsTriedThanTheOneThatIsRejected) {
  for (const int way_point : {1, 2}) {
    Bench bench;
    bench.start();
    bench.rejects = [](const auto&) { return "link2 touches link4"; };
    Target step = position_target(0, kNear);
    step.way_point = way_point;
    step.num_way_points = 3;
    bench.give(step);
    ASSERT_TRUE(bench.run_until_state(S::CONTROL_REFUSED));
    EXPECT_EQ(bench.moves.size() == 1, way_point > 1);
    EXPECT_TRUE(bench.has_why("link2 touches link4")) << bench.status.why;
  }
}

TEST(ControllerTest, AnExpiredActionIsGivenAgainWithAnotherIdAFewTimes) {
  Bench bench;
  bench.start();
  bench.driver_serves = false;
  bench.give(position_target(0, kNear));
  ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
  bench.answer_last_move(motion_status_t::STATE_EXPIRED, "expired 5 us ago");
  ASSERT_EQ(bench.moves.size(), 2U);
  bench.answer_last_move(motion_status_t::STATE_EXPIRED, "expired 5 us ago");
  ASSERT_EQ(bench.moves.size(), 3U);
  bench.answer_last_move(motion_status_t::STATE_EXPIRED, "expired 5 us ago");
  EXPECT_EQ(bench.moves.size(), 3U);
  EXPECT_EQ(bench.status.control_state, S::CONTROL_REFUSED);
  EXPECT_TRUE(bench.has_why("expire")) << bench.status.why;
}

TEST(ControllerTest, AnActionWithoutAnAnswerIsSentAgainWithTheSameId) {
  Bench bench;
  bench.start();
  bench.driver_serves = false;
  bench.give(position_target(0, kNear));
  ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
  bench.run(10);  // the driver goes on repeating its status
  EXPECT_EQ(bench.moves.size(), 1U);
  EXPECT_EQ(bench.num_repeats, 9);
  bench.driver_serves = true;
  EXPECT_TRUE(bench.run_until_state(S::CONTROL_REACHED));
}

}  // namespace
}  // namespace bodyschema::test
