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
    {Phase::kMovingOvertaken,
     [](Bench& b) {
       be_moving(b);
       move_by_another(b);
     }},
    {Phase::kObservingOvertaken,
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

/// What brings each event about, at once.
const std::map<Event, Act> kInterrupts = {
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
      act(bench);
      Phase next = goes ? wanted.next : phase;
      // HOLD is sent at once, if the driver was heard.
      const bool is_heard = bench.controller.status().utime > 0;
      if (next == Phase::kHoldDue && is_heard) next = Phase::kHoldSent;
      // After a restart of the driver no STOP is latched any more.
      if (phase == Phase::kRefusedHalted && bench.motion.stop_latched == 0 &&
          next == Phase::kRefusedHalted)
        next = Phase::kRefused;
      EXPECT_EQ(info(bench.controller.phase()).name, info(next).name) << name;
    }
  }
  EXPECT_EQ(kWays.size(), static_cast<std::size_t>(kNumPhases));
  EXPECT_GT(num_left, 80);
}

TEST(ControllerInterruptsTest, AMoveRejectedAfterSomebodyElseMovedTheArmIsDecidedAnewFromThere) {
  Bench bench;
  kWays.at(Phase::kMovingOvertaken)(bench);
  bench.answer_last_move(motion_status_t::STATE_REJECTED, "no");
  EXPECT_EQ(bench.controller.phase(), Phase::kTaking);
  bench.driver_serves = true;
  EXPECT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
}

TEST(ControllerInterruptsTest, AMoveThatNobodyAnsweredIsNotSentAgainAfterSomebodyElseMovedTheArm) {
  Bench bench;
  kWays.at(Phase::kMovingOvertaken)(bench);
  const std::int64_t id = bench.moves.back().action_id;
  const int num_repeats = bench.num_repeats;
  bench.driver_serves = true;
  EXPECT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_EQ(bench.num_repeats, num_repeats);
  EXPECT_GT(bench.moves.back().action_id, id);
}

TEST(ControllerInterruptsTest, AfterItsSampleAnArmThatSomebodyElseMovedIsTakenAnew) {
  Bench bench;
  kWays.at(Phase::kObservingOvertaken)(bench);
  bench.motion.source = bench.moves.back().source;
  bench.motion.epoch = bench.moves.back().epoch;
  bench.motion.action_id = bench.moves.back().action_id;
  bench.show_sample();
  EXPECT_EQ(bench.controller.phase(), Phase::kTaking);
}

}  // namespace
}  // namespace bodyschema::test
