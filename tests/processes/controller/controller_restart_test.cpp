// Class Controller: STOP, HOLD and restarts, of others and of its own.

#include <gtest/gtest.h>
#include <unistd.h>

#include <filesystem>
#include <fstream>
#include <functional>
#include <limits>
#include <memory>

#include "common/config/yaml.h"
#include "tests/processes/controller/controller_bench.h"

namespace bodyschema::test {
namespace {

TEST(ControllerTest, StopDropsTheTargetInEveryStateAndResumeDoesNotTakeItUp) {
  for (const std::int8_t state :
       {S::CONTROL_WAITING, S::CONTROL_MOVING, S::CONTROL_REACHED, S::CONTROL_LENT}) {
    Bench bench;
    bench.start();
    if (state == S::CONTROL_MOVING) bench.driver_serves = false;
    if (state == S::CONTROL_LENT) {
      bench.health = health_of(1, 2, 3, schema_edge_t::EDGE_INVALID);
      bench.repeat();
    }
    bench.give(position_target(0, kFar));
    ASSERT_TRUE(bench.run_until_state(state));
    const std::size_t num_moves = bench.moves.size();
    bench.stop();
    EXPECT_EQ(bench.status.control_state, S::CONTROL_HOLDING) << int{state};
    EXPECT_EQ(bench.status.owns_arm, 1);
    EXPECT_TRUE(bench.has_why("STOP by operator")) << bench.status.why;
    bench.run(5);
    bench.driver_serves = true;
    bench.health.reset();
    bench.stop(false);
    bench.run(20);
    EXPECT_EQ(bench.moves.size(), num_moves) << int{state};
    EXPECT_EQ(bench.status.control_state, S::CONTROL_HOLDING);
  }
}

TEST(ControllerTest, WhileStoppedATargetIsRefused) {
  Bench bench;
  bench.start();
  bench.stop();
  EXPECT_EQ(bench.status.control_state, S::CONTROL_IDLE);  // none of its business
  bench.give(position_target(0, kNear));
  EXPECT_EQ(bench.status.control_state, S::CONTROL_REFUSED);
  EXPECT_TRUE(bench.has_why("first: ./run resume")) << bench.status.why;
  bench.stop(false);
  EXPECT_EQ(bench.status.control_state, S::CONTROL_REFUSED);
  EXPECT_TRUE(bench.has_why("give the target again")) << bench.status.why;
  bench.run(10);
  EXPECT_TRUE(bench.moves.empty());
}

TEST(ControllerTest, WhoTellsTheDriverToHoldIsObeyed) {
  Bench bench;
  bench.start();
  bench.give(position_target(0, kFar));
  ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
  motion_status_t held = bench.motion;
  held.source = "console";
  held.kind = action_command_t::KIND_HOLD;
  held.state = motion_status_t::STATE_HOLDING;
  bench.say(held);
  const std::size_t num_moves = bench.moves.size();
  EXPECT_EQ(bench.status.control_state, S::CONTROL_HOLDING);
  EXPECT_TRUE(bench.has_why("console")) << bench.status.why;
  bench.run(10);
  EXPECT_EQ(bench.moves.size(), num_moves);
  // The driver goes on repeating that answer; it does not stand in a new target's way.
  bench.give(position_target(1, kFar));
  EXPECT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
}

TEST(ControllerTest, ADriverThatBeginsAnewInTheMiddleIsHeld) {
  const struct {
    const char* what;
    std::function<void(motion_status_t&)> go_back;
  } cases[] = {{"its time goes back",
                [](motion_status_t& m) {
                  m.utime = m.rest_since_utime = kSecond;
                  m.source = "";
                  m.epoch = 0;
                  m.action_id = -1;
                  m.state = motion_status_t::STATE_IDLE;
                }},
               {"its answers go back", [](motion_status_t& m) { --m.action_id; }}};
  for (const auto& c : cases) {
    Bench bench;
    bench.start();
    bench.give(position_target(0, kFar));
    ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 2; }));
    bench.driver_serves = false;
    bench.run(0.5);
    motion_status_t back = bench.motion;
    c.go_back(back);
    bench.say(back);
    EXPECT_EQ(bench.status.control_state, S::CONTROL_HOLDING) << c.what;
    EXPECT_EQ(bench.num_holds, 1) << c.what;
    EXPECT_TRUE(bench.has_why("began anew")) << bench.status.why;
    const std::size_t num_moves = bench.moves.size();
    bench.run(20);
    EXPECT_EQ(bench.moves.size(), num_moves) << c.what;
  }
}

/// The world goes on, the controller is killed and started again.
Bench restarted(const Bench& before, const std::filesystem::path& file) {
  std::ofstream(file) << before.controller.state_text();
  Bench after;
  after.motion = before.motion;
  after.arm = before.arm;
  after.moves = before.moves;
  after.num_samples = before.num_samples;
  after.controller.restore(file);
  std::filesystem::remove(file);
  return after;
}

std::filesystem::path state_file() {
  return std::filesystem::path(testing::TempDir()) /
         ("controller_state_" + std::to_string(getpid()) + ".yaml");
}

TEST(ControllerTest, AHoldSurvivesARestart) {
  const auto in_hold = [](Bench& b) { b.give(other_target(4, Target::KIND_HOLD)); };
  const auto in_fault = [](Bench& b) {
    b.give(position_target(4, kFar));
    b.run_until([&] { return b.moves.size() == 1; });
    b.observer_works = false;
    b.run_until_state(S::CONTROL_HOLDING);
  };
  const auto kept = [](Bench& b) {
    b.give(position_target(4, kNear, -1));
    b.run_until_state(S::CONTROL_REACHED);
  };
  for (const std::function<void(Bench&)>& bring :
       {std::function<void(Bench&)>(in_hold), std::function<void(Bench&)>(in_fault),
        std::function<void(Bench&)>(kept)}) {
    Bench before;
    before.start();
    bring(before);
    Bench after = restarted(before, state_file());
    EXPECT_EQ(after.controller.status().control_state, S::CONTROL_HOLDING);
    EXPECT_EQ(after.controller.status().owns_arm, 1);
    EXPECT_EQ(after.controller.status().target_id, 4);  // still acknowledged
    after.start();
    EXPECT_EQ(after.num_holds, 1);
    after.give(position_target(4, kNear));
    after.run(10);
    EXPECT_EQ(after.moves.size(), before.moves.size());
    EXPECT_EQ(after.status.control_state, S::CONTROL_HOLDING);
    after.show_sample();  // where the arm is; the bench insists on steps from there
    if (before.motion.commanded.size() != 3) continue;
    after.give(position_target(5, kFar));
    EXPECT_TRUE(after.run_until_state(S::CONTROL_REACHED)) << after.status.why;
  }
}

TEST(ControllerTest, ARestartInTheMiddleOfATargetHoldsAndTheSameTargetDoesNotResumeIt) {
  for (const bool is_kept : {false, true}) {
    Bench before;
    before.start();
    before.give(position_target(4, kFar, 100));
    ASSERT_TRUE(before.run_until([&] {
      return is_kept ? before.status.control_state == S::CONTROL_REACHED : before.moves.size() == 1;
    }));
    Bench after = restarted(before, state_file());
    EXPECT_EQ(after.controller.status().control_state, S::CONTROL_HOLDING);
    EXPECT_EQ(after.controller.status().owns_arm, 1);
    EXPECT_EQ(after.controller.status().target_epoch, 77);
    EXPECT_EQ(after.controller.status().target_id, 4);  // acknowledged: its sender is told
    after.start();
    EXPECT_EQ(after.num_holds, 1);
    EXPECT_TRUE(after.has_why("restarted in the middle of target 4 of operator"))
        << after.status.why;
    for (const int id : {3, 4}) {
      after.give(position_target(id, kFar));
      after.run(5);
      EXPECT_EQ(after.status.control_state, S::CONTROL_HOLDING);
    }
    EXPECT_EQ(after.moves.size(), before.moves.size());
    // Killed again it says the same.
    Bench again = restarted(after, state_file());
    EXPECT_EQ(again.controller.status().why, "held as before the restart: " + after.status.why);
    set_array(again.motion.num_signals, again.motion.commanded, again.arm);
    again.start();
    again.give(position_target(5, kNear, 0));
    EXPECT_TRUE(again.run_until_state(S::CONTROL_RELEASED)) << again.status.why;
    // The bench insists on ids that were never used before.

    after.give(other_target(5, Target::KIND_RELEASE));
    EXPECT_EQ(after.status.owns_arm, 0);
  }
}

TEST(ControllerTest, ATargetThatWasNotBegunIsGivenAgainAfterARestart) {
  Bench before;
  before.monitor_speaks = false;
  before.start();
  before.give(position_target(4, kFar));
  before.run(1);
  ASSERT_EQ(before.status.control_state, S::CONTROL_WAITING);
  ASSERT_EQ(before.status.owns_arm, 0);
  Bench after = restarted(before, state_file());
  after.start();
  after.run(10);
  EXPECT_TRUE(after.moves.empty());
  EXPECT_EQ(after.num_holds, 0);
  EXPECT_EQ(after.status.control_state, S::CONTROL_IDLE);
  EXPECT_EQ(after.status.owns_arm, 0);
  EXPECT_EQ(after.status.target_id, -1);  // so its sender repeats it
  EXPECT_TRUE(after.has_why("target 4 of operator")) << after.status.why;
  after.give(position_target(3, kNear));  // older
  after.run(2);
  EXPECT_EQ(after.status.control_state, S::CONTROL_IDLE);
  after.give(position_target(4, kFar));
  EXPECT_TRUE(after.run_until_state(S::CONTROL_REACHED)) << after.status.why;
}

TEST(ControllerTest, AKeptTargetFromAClockAheadIsForgottenAndTheArmStaysHeld) {
  const std::int64_t kNow = 1'700'000'000 * kSecond;
  Target hold = other_target(7, Target::KIND_HOLD);
  hold.epoch = std::numeric_limits<std::int64_t>::max();
  Bench before;
  before.start();
  before.give(hold);
  ASSERT_EQ(before.status.control_state, S::CONTROL_HOLDING);
  std::ofstream(state_file()) << before.controller.state_text();
  Controller after(test_config());
  after.restore(state_file(), kNow);
  EXPECT_EQ(after.status().control_state, S::CONTROL_HOLDING);
  EXPECT_EQ(after.status().owns_arm, 1);
  // A console that compares with its own must not believe that there is a newer one.
  EXPECT_EQ(after.status().target_epoch, 0);
  EXPECT_EQ(after.status().target_id, -1);
  Target release = other_target(0, Target::KIND_RELEASE);
  release.epoch = kNow;
  after.on_pose_target(release, kNow);
  EXPECT_EQ(after.status().control_state, S::CONTROL_RELEASED);
  Controller other(test_config());
  std::ofstream(state_file()) << after.state_text();
  other.restore(state_file(), kNow + kSecond);
  EXPECT_FALSE(other.counters().contains("POSE_TARGET from a clock ahead"));
  std::filesystem::remove(state_file());
}

/// A controller that begins anew with what another kept.
std::unique_ptr<Controller> restarted(const Controller& before, std::int64_t wall_clock_us = -1) {
  std::ofstream(state_file()) << before.state_text();
  auto after = std::make_unique<Controller>(test_config());
  after->restore(state_file(), wall_clock_us);
  std::filesystem::remove(state_file());
  return after;
}

TEST(ControllerTest, RestartsAsOftenAsOneLikes) {
  auto without_target = std::make_unique<Controller>(test_config());
  Bench listening;
  Target target = position_target(4, kFar);
  target.epoch = 1'700'000'000 * kSecond;  // the clock is set back afterwards
  listening.give(target);
  ASSERT_EQ(listening.controller.phase(), Phase::kListening);
  auto ahead = restarted(listening.controller, 1'600'000'000 * kSecond);
  for (int n = 0; n < 3; ++n) {
    without_target = restarted(*without_target);
    ahead = restarted(*ahead);
  }
}

TEST(ControllerTest, ATargetOfBeforeDoesNotCountAgainAfterTwoRestarts) {
  Bench before;
  before.start();
  before.give(position_target(4, kNear));
  ASSERT_TRUE(before.run_until_state(S::CONTROL_REACHED));
  before.give(other_target(5, Target::KIND_RELEASE));
  const auto after = restarted(*restarted(before.controller));
  for (const std::int64_t id : {4, 5}) {
    after->on_pose_target(position_target(id, kNear));
    EXPECT_EQ(after->phase(), Phase::kIdle) << id;
  }
  after->on_pose_target(position_target(6, kNear));
  EXPECT_EQ(after->phase(), Phase::kListening);
}

TEST(ControllerTest, AStateFileOfSomethingElseIsRefused) {
  std::ofstream(state_file()) << "epoch: 1\nnext_action_id: -3\n";
  EXPECT_THROW(Controller(test_config()).restore(state_file()), ConfigError);
  std::filesystem::remove(state_file());
}

}  // namespace
}  // namespace bodyschema::test
