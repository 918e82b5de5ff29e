// Class Controller follows its table: what interrupts it in each of its phases.

#include <gtest/gtest.h>

#include <functional>
#include <map>
#include <string>

#include "processes/controller/controller_states.h"
#include "tests/processes/controller/controller_bench.h"

namespace bodyschema::test {
namespace {

using Act = std::function<void(Bench&)>;

Target expiring(Target target) {
  target.expiry_s = 60;
  return target;
}

void give_and_send(Bench& bench) {
  bench.give(expiring(position_target(0, kFar)));
  bench.run_until([&] { return bench.moves.size() == 1; });
}

void move_by_another(Bench& bench) { bench.settle("motor_babbler", 1, 30, bench.arm); }

void be_moving(Bench& bench) {
  bench.driver_serves = false;
  bench.start();
  give_and_send(bench);
}

void be_observing(Bench& bench) {
  bench.observer_works = false;
  bench.start();
  give_and_send(bench);
  bench.run(0.3);
}

/// How to bring a new controller into each phase.
const std::map<Phase, Act> kWays = {
    {Phase::kIdle, [](Bench& b) { b.start(); }},
    {Phase::kListening,
     [](Bench& b) {
       b.monitor_speaks = false;
       b.start();
       b.give(expiring(position_target(0, kFar)));
     }},
    {Phase::kTaking,
     [](Bench& b) {
       b.start();
       b.give(expiring(position_target(0, kFar)));
     }},
    {Phase::kDeciding,
     [](Bench& b) {
       be_moving(b);
       b.motion.rest_since_utime = -1;
       b.answer_last_move(motion_status_t::STATE_REJECTED, "the arm moves");
     }},
    {Phase::kTagAwaited,
     [](Bench& b) {
       b.num_frames = TagTrack::kFrames;
       b.start();
       b.give(expiring(tag_target(0)));
       b.run(1);
     }},
    {Phase::kMoving, be_moving},
    {Phase::kObserving, be_observing},
    {Phase::kMovingPreempted,
     [](Bench& b) {
       be_moving(b);
       move_by_another(b);
     }},
    {Phase::kObservingPreempted,
     [](Bench& b) {
       be_observing(b);
       move_by_another(b);
     }},
    {Phase::kKeeping,
     [](Bench& b) {
       b.start();
       b.give(expiring(position_target(0, kNear)));
       b.run_until_state(S::CONTROL_REACHED);
     }},
    {Phase::kLent,
     [](Bench& b) {
       b.schema.edges[1].state = EdgeState::kInvalid;
       b.start();
       b.give(expiring(position_target(0, kFar)));
     }},
    {Phase::kRefused,
     [](Bench& b) {
       b.start();
       b.give(expiring(position_target(0, kBeyond)));
       b.run_until_state(S::CONTROL_REFUSED);
     }},
    {Phase::kRefusedHalted,
     [](Bench& b) {
       b.start();
       b.stop();
       b.give(expiring(position_target(0, kFar)));
     }},
    {Phase::kHoldDue,
     [](Bench& b) {
       b.driver_speaks = false;
       b.give(other_target(0, Target::KIND_HOLD));
       b.driver_speaks = true;
     }},
    {Phase::kHoldSent,
     [](Bench& b) {
       b.driver_serves = false;
       b.start();
       b.give(other_target(0, Target::KIND_HOLD));
     }},
    {Phase::kHeld,
     [](Bench& b) {
       b.start();
       b.give(other_target(0, Target::KIND_HOLD));
       b.run(1);
     }},
    {Phase::kReleased,
     [](Bench& b) {
       b.start();
       b.give(other_target(0, Target::KIND_RELEASE));
     }},
};

void hold_by_another(Bench& bench) {
  motion_status_t held = bench.motion;
  held.source = "console";
  held.action_id = 7;
  held.kind = action_command_t::KIND_HOLD;
  held.state = motion_status_t::STATE_HOLDING;
  bench.say(held);
}

void restart_driver(Bench& bench) {
  motion_status_t anew = bench.motion;
  anew.utime = anew.rest_since_utime = kSecond;
  anew.source = "";
  anew.epoch = 0;
  anew.action_id = -1;
  anew.state = motion_status_t::STATE_IDLE;
  anew.stop_latched = 0;
  bench.say(anew);
}

void lose_part(Bench& bench) {
  ++bench.schema.version;
  bench.schema.edges.pop_back();
  UnconnectedPart lost;
  lost.part = 4;
  bench.schema.unconnected.push_back(lost);
  bench.show_schema();
}

void answer(Bench& bench, std::int8_t state) {
  if (!bench.moves.empty()) bench.answer_last_move(state, "because");
}

void show_own_sample(Bench& bench) {
  if (bench.moves.empty()) return;
  bench.motion.source = bench.moves.back().source;
  bench.motion.epoch = bench.moves.back().epoch;
  bench.motion.action_id = bench.moves.back().action_id;
  bench.show_sample();
}

/// What brings each event about, at once.
const std::map<Event, Act> kInterrupts = {
    {Event::kTarget, [](Bench& b) { b.give(position_target(9, kFar)); }},
    {Event::kForeignMove, move_by_another},
    {Event::kSettled, [](Bench& b) { answer(b, motion_status_t::STATE_SETTLED); }},
    {Event::kRejected, [](Bench& b) { answer(b, motion_status_t::STATE_REJECTED); }},
    {Event::kExpired, [](Bench& b) { answer(b, motion_status_t::STATE_EXPIRED); }},
    {Event::kSampleCame, show_own_sample},
    {Event::kHoldAsked, [](Bench& b) { b.give(other_target(9, Target::KIND_HOLD)); }},
    {Event::kReleaseAsked, [](Bench& b) { b.give(other_target(9, Target::KIND_RELEASE)); }},
    {Event::kStopped, [](Bench& b) { b.stop(); }},
    {Event::kForeignHold, hold_by_another},
    {Event::kDriverRestarted, restart_driver},
    {Event::kEnded,
     [](Bench& b) {
       if (!b.moves.empty()) b.answer_last_move(motion_status_t::STATE_HOLDING, "an obstacle");
     }},
    {Event::kUnservable, lose_part},
    {Event::kTargetExpired, [](Bench& b) { b.controller.on_tick(b.now + 100 * kSecond); }},
    {Event::kInputSilent, [](Bench& b) { b.controller.on_tick(b.now + 10 * kSecond); }},
};

/// Where the controller is in the end: what follows from an event at once is the next event.
Phase end_of(Phase phase, Event event, const Bench& bench) {
  const Reaction& wanted = reaction(phase, event);
  const Phase next = wanted.kind == Reaction::Kind::kGoes ? wanted.next : phase;
  switch (next) {
    case Phase::kHoldDue:
      return bench.controller.status().utime > 0 ? Phase::kHoldSent : next;
    case Phase::kRefusedHalted:
      return bench.motion.stop_latched ? next : Phase::kRefused;
    case Phase::kListening:
      if (!bench.monitor_speaks || bench.controller.status().utime == 0) return next;
      return bench.schema.edges[1].state == EdgeState::kInvalid ? Phase::kLent : Phase::kTaking;
    case Phase::kDeciding:
      return bench.motion.rest_since_utime < 0 ? next : Phase::kMoving;
    default:
      return next;
  }
}

Sends sent_by(const Bench& bench, std::size_t num_moves, int num_holds, int num_repeats) {
  return bench.moves.size() > num_moves    ? Sends::kMove
         : bench.num_holds > num_holds     ? Sends::kHold
         : bench.num_repeats > num_repeats ? Sends::kAgain
                                           : Sends::kNothing;
}

TEST(ControllerInterruptsTest, EachPhaseIsLeftAsTheTableSays) {
  int num_left = 0;
  for (const auto& [phase, bring] : kWays) {
    for (const auto& [event, act] : kInterrupts) {
      Bench bench;
      bring(bench);
      bench.controller.on_tick(bench.now);
      const std::string name =
          std::string(info(event).name) + " in " + std::string(info(phase).name);
      ASSERT_EQ(info(bench.controller.phase()).name, info(phase).name);
      const Reaction& wanted = reaction(phase, event);
      const bool goes = wanted.kind == Reaction::Kind::kGoes;
      const bool is_of_clock = event == Event::kTargetExpired || event == Event::kInputSilent;
      if (!goes && is_of_clock) continue;  // the clock may bring about something else
      num_left += goes;
      const std::size_t num_moves = bench.moves.size();
      const int num_holds = bench.num_holds, num_repeats = bench.num_repeats;
      // With STOP latched a target is another event.
      const bool is_halted = event == Event::kTarget && bench.motion.stop_latched;
      act(bench);
      const Event told = is_halted ? Event::kTargetWhileHalted : event;
      const Phase next = end_of(phase, told, bench);
      EXPECT_EQ(info(bench.controller.phase()).name, info(next).name) << name;
      if (is_of_clock) continue;  // its answer was not taken
      const Reaction& reacted = reaction(phase, told);
      const bool was_due = phase == Phase::kHoldDue || reacted.next == Phase::kHoldDue;
      const Sends sends = was_due && next == Phase::kHoldSent ? Sends::kHold
                          : reacted.next == Phase::kDeciding && next == Phase::kMoving
                              ? Sends::kMove
                              : reacted.sends;
      EXPECT_EQ(sent_by(bench, num_moves, num_holds, num_repeats), sends) << name;
    }
  }
  EXPECT_EQ(kWays.size(), static_cast<std::size_t>(kNumPhases));
  EXPECT_GT(num_left, 100);
}

TEST(ControllerInterruptsTest, WhileHaltedATargetIsRefusedAndWhatIsHeldStaysHeld) {
  for (const auto& [phase, bring] : kWays) {
    if (phase == Phase::kHoldDue) continue;  // the driver was not heard
    Bench bench;
    bring(bench);
    bench.stop();
    const Phase stopped = bench.controller.phase();
    bench.give(position_target(9, kNear));
    EXPECT_EQ(bench.controller.phase(), end_of(stopped, Event::kTargetWhileHalted, bench))
        << info(phase).name;
    EXPECT_TRUE(bench.has_why("the arm is halted")) << bench.status.why;
    const int was_owned = bench.status.owns_arm;
    EXPECT_EQ(was_owned, owns_arm(stopped));
    const std::size_t num_moves = bench.moves.size();
    bench.stop(false);
    bench.run(20);
    EXPECT_EQ(bench.status.owns_arm, was_owned) << info(phase).name;
    EXPECT_EQ(bench.moves.size(), num_moves) << info(phase).name;
    EXPECT_FALSE(bench.has_why("is halted")) << bench.status.why;
  }
}

TEST(ControllerInterruptsTest, WhatWasSeenAtAnotherRestIsNotSeenHere) {
  Bench bench;
  bench.start();
  bench.give(position_target(0, kNear));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED));
  EXPECT_GE(bench.status.observed_error_m, 0);
  bench.give(other_target(1, Target::KIND_RELEASE));
  bench.observer_works = false;
  bench.arm = {10, 0.1, 2};
  move_by_another(bench);
  bench.observer_works = true;
  bench.hidden = {4};
  bench.give(position_target(2, bench.part_position()));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_EQ(bench.status.num_moves, 1);  // none, but that it is looked at
  EXPECT_LT(bench.status.observed_error_m, 0);
  EXPECT_TRUE(bench.has_why("the part is not seen there")) << bench.status.why;
}

TEST(ControllerInterruptsTest, ATargetThatSomebodyMovedTheArmAwayFromIsNotGoneBackToUnasked) {
  Bench bench;
  kWays.at(Phase::kKeeping)(bench);
  const std::size_t num_moves = bench.moves.size();
  bench.arm = {10, 0.1, 2};
  bench.observer_works = false;
  move_by_another(bench);
  EXPECT_EQ(bench.status.control_state, S::CONTROL_HOLDING);
  EXPECT_TRUE(bench.has_why("away from the target")) << bench.status.why;
  bench.run(20);
  EXPECT_EQ(bench.moves.size(), num_moves);
  // The next target waits for what that move shows.
  bench.give(position_target(1, kFar));
  bench.run(2);
  EXPECT_EQ(bench.controller.phase(), Phase::kTaking);
  bench.observer_works = true;
  bench.show_sample();
  EXPECT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
}

// What a rejection is about was settled when the MOVE was sent.
TEST(ControllerInterruptsTest, ARejectionOfAnOlderTargetsMoveDoesNotDropAProbe) {
  Bench bench;
  bench.driver_serves = false;
  bench.start();
  give_and_send(bench);
  bench.health = health_of(1, 2, 3, schema_edge_t::EDGE_PROVISIONAL);
  bench.health->probe_sample = 7;
  set_array(bench.health->num_probe, bench.health->probe_action, {5.0, 0.1, 1.0});
  bench.repeat();
  bench.give(expiring(position_target(1, kFar)));
  bench.answer_last_move(motion_status_t::STATE_REJECTED, "no");
  bench.driver_serves = true;
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_EQ(bench.status.num_probes, 1);
}

TEST(ControllerInterruptsTest, AMoveRejectedAfterSomebodyElseMovedTheArmIsDecidedAnewFromThere) {
  Bench bench;
  kWays.at(Phase::kMovingPreempted)(bench);
  bench.answer_last_move(motion_status_t::STATE_REJECTED, "no");
  EXPECT_EQ(bench.controller.phase(), Phase::kTaking);
  bench.driver_serves = true;
  EXPECT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
}

TEST(ControllerInterruptsTest, AMoveThatNobodyAnsweredIsNotSentAgainAfterSomebodyElseMovedTheArm) {
  Bench bench;
  kWays.at(Phase::kMovingPreempted)(bench);
  const std::int64_t id = bench.moves.back().action_id;
  const int num_repeats = bench.num_repeats;
  bench.driver_serves = true;
  EXPECT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_EQ(bench.num_repeats, num_repeats);
  EXPECT_GT(bench.moves.back().action_id, id);
}

TEST(ControllerInterruptsTest, AfterItsSampleAnArmThatSomebodyElseMovedIsTakenAnew) {
  Bench bench;
  kWays.at(Phase::kObservingPreempted)(bench);
  show_own_sample(bench);
  EXPECT_EQ(bench.controller.phase(), Phase::kTaking);
}

// A console that slept meanwhile does not know of it.
TEST(ControllerTest, APathOnWhichTheArmWasHeldDoesNotGoOn) {
  for (const bool is_stop : {true, false}) {
    Bench bench;
    bench.start();
    Target step = position_target(0, kNear);
    step.way_point = 1;
    step.num_way_points = 3;
    bench.give(step);
    ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED));
    if (is_stop) {
      bench.stop(true);
      bench.run(1);
      bench.stop(false);
    } else {
      bench.give(other_target(1, Target::KIND_HOLD));
    }
    bench.run(2);
    const std::size_t num_moves = bench.moves.size();
    step.target_id = 2;
    step.way_point = 2;
    std::copy(kFar.begin(), kFar.end(), step.position_m);
    bench.give(step);
    bench.run(5);
    EXPECT_EQ(bench.moves.size(), num_moves);
    EXPECT_EQ(bench.status.control_state, S::CONTROL_HOLDING);
    EXPECT_EQ(bench.status.target_id, 2);
    step.epoch += 1;
    step.target_id = 3;
    bench.give(step);
    EXPECT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << "a path of its own";
  }
}

}  // namespace
}  // namespace bodyschema::test
