// Class Controller: inputs that fall silent while it moves the arm.

#include <gtest/gtest.h>

#include <functional>

#include "tests/processes/controller/controller_bench.h"

namespace bodyschema::test {
namespace {

struct Silence {
  const char* input;
  std::function<void(Bench&, bool speaks)> set;
};

const Silence kSilences[] = {
    {"MOTION_STATUS", [](Bench& b, bool speaks) { b.driver_speaks = speaks; }},
    {"BODY_SCHEMA", [](Bench& b, bool speaks) { b.monitor_speaks = speaks; }},
    {"MARKER_POSES", [](Bench& b, bool speaks) { b.eyes_open = speaks; }},
    {"SAMPLE", [](Bench& b, bool speaks) { b.observer_works = speaks; }}};

TEST(ControllerTest, WhenAnInputFallsSilentTheArmIsHeldAndStaysSo) {
  for (const Silence& silence : kSilences) {
    Bench bench;
    bench.start();
    bench.give(position_target(0, kFar));
    ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
    // Without an answer or a sample of the next step it cannot go on anyway; for the schema the
    // arm must be kept busy.
    silence.set(bench, false);
    const bool is_schema = std::string(silence.input) == "BODY_SCHEMA";
    if (is_schema) bench.driver_serves = false;
    const std::int64_t silent_since = bench.now;
    ASSERT_TRUE(bench.run_until([&] { return bench.num_holds > 0; })) << silence.input;
    const double waited_s = static_cast<double>(bench.now - silent_since) / kSecond;
    EXPECT_GE(waited_s, 1.9) << silence.input;  // it was heard up to a second before
    EXPECT_LE(waited_s, std::string(silence.input) == "SAMPLE" ? 5.3 : 3.3) << silence.input;
    EXPECT_EQ(bench.status.control_state, S::CONTROL_HOLDING);
    EXPECT_EQ(bench.status.owns_arm, 1);
    EXPECT_TRUE(bench.has_why(silence.input)) << bench.status.why;
    // No automatic resume.
    const std::size_t num_moves = bench.moves.size();
    silence.set(bench, true);
    bench.driver_serves = true;
    bench.repeat();
    bench.show_frame();
    bench.run(20);
    EXPECT_EQ(bench.moves.size(), num_moves) << silence.input;
    EXPECT_EQ(bench.status.control_state, S::CONTROL_HOLDING);
    // The same target repeated does not resume it either; a new one does.
    bench.give(position_target(0, kFar));
    bench.run(5);
    EXPECT_EQ(bench.moves.size(), num_moves) << silence.input;
    bench.arm = bench.motion.commanded.size() == 3 ? bench.motion.commanded : bench.arm;
    bench.give(position_target(1, kFar));
    EXPECT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << silence.input << bench.status.why;
  }
}

TEST(ControllerTest, SilenceWhileNothingIsServedDoesNothing) {
  for (const Silence& silence : kSilences) {
    Bench bench;
    bench.start();
    silence.set(bench, false);
    bench.run(60);
    EXPECT_EQ(bench.status.control_state, S::CONTROL_IDLE);
    EXPECT_EQ(bench.num_holds, 0);
    silence.set(bench, true);
    bench.repeat();
    bench.run(1);
    bench.give(position_target(0, kFar));
    EXPECT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << silence.input << bench.status.why;
  }
}

TEST(ControllerTest, WhatFellSilentBeforeTheTargetCameIsNotMovedBy) {
  for (const int which : {0, 1}) {
    Bench bench;
    bench.start();
    bench.give(position_target(0, kNear));
    ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED));
    const std::size_t num_moves = bench.moves.size();
    kSilences[which].set(bench, false);
    bench.run(5);
    bench.give(position_target(1, kFar));
    bench.run(5);
    EXPECT_EQ(bench.moves.size(), num_moves);
    EXPECT_EQ(bench.status.control_state, S::CONTROL_HOLDING);
    EXPECT_TRUE(bench.has_why(kSilences[which].input)) << bench.status.why;
  }
}

// A live driver's time runs on at rest; frames must keep up with it.
TEST(ControllerTest, InLiveTimeEyesThatLagOrCloseAreSeenByTheDriversTime) {
  for (const bool lag : {false, true}) {
    Bench bench;
    bench.start();
    bench.observer_works = false;  // keeps the target open: its sample does not come
    bench.arm = {0, 0, 0};
    bench.settle("motor_babbler", 1, 5, bench.arm);
    bench.give(position_target(0, kFar));
    const std::int64_t closed = bench.now;
    std::int64_t num_frames = 0;
    while (bench.num_holds == 0 && bench.now < closed + 10 * kSecond) {
      bench.motion.utime += kTick;
      bench.say(bench.motion);
      if (lag) {
        marker_poses_t poses{};
        poses.utime = bench.motion.utime - 4 * kSecond;
        poses.image_seq = num_frames++;
        bench.controller.on_marker_poses(poses);
      }
      bench.run(0.1);
    }
    EXPECT_EQ(bench.num_holds, 1) << lag;
    EXPECT_TRUE(bench.has_why("MARKER_POSES")) << bench.status.why;
    EXPECT_LE(bench.now - closed, 35 * kTick);
  }
}

TEST(ControllerTest, AFrameFromFarAheadDoesNotOpenTheEyes) {
  Bench bench;
  bench.start();
  marker_poses_t poses{};
  poses.utime = std::int64_t{1} << 60;
  bench.controller.on_marker_poses(poses);
  bench.give(position_target(0, kFar));
  ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
  bench.eyes_open = false;
  EXPECT_TRUE(bench.run_until_state(S::CONTROL_HOLDING));
  EXPECT_TRUE(bench.has_why("MARKER_POSES")) << bench.status.why;
}

TEST(ControllerTest, WhileTheMarkerOfThePartOrTheCameraMovedTheArmIsLentAndOthersDoNotMatter) {
  for (const int part : {1, 2, 4}) {
    Bench bench;
    bench.start();
    model_health_t health = health_of(bench.schema.version, 2, 3, schema_edge_t::EDGE_OK);
    part_health_t moved{};
    moved.health_part = part;
    moved.part_state = schema_edge_t::EDGE_INVALID;
    moved.position_median_m = moved.rotation_median_rad = -1;
    set_array(health.num_parts, health.part_health, {moved});
    bench.health = health;
    bench.repeat();
    bench.give(position_target(0, kFar));
    const bool concerns = part != 2;
    EXPECT_EQ(bench.run_until_state(S::CONTROL_LENT), concerns) << part;
    if (!concerns) continue;
    EXPECT_EQ(bench.status.owns_arm, 0);
    EXPECT_TRUE(bench.has_why("the marker of part " + std::to_string(part) + " is invalid"))
        << bench.status.why;
  }
}

}  // namespace
}  // namespace bodyschema::test
