#include <gtest/gtest.h>

#include <random>
#include <set>

#include "tests/processes/controller/controller_bench.h"

namespace bodyschema::test {
namespace {

class ControllerPropertyTest : public testing::TestWithParam<int> {};

// Anything in any order: Bench asserts that every message makes sense, that nothing moves an arm
// that is not the controller's or for a target that is over, that ids are new, steps small, actions
// within the limits and no part in a keep-out box, and that no target is served while driver, eyes
// or monitor are silent; that on a path the arm is never lent, and that one on which it was held
// does not go on.
TEST_P(ControllerPropertyTest, WhateverHappensItsCommandsAreLawful) {
  std::mt19937_64 rng(static_cast<std::uint64_t>(GetParam()));
  std::size_t num_moves = 0, num_holds = 0;
  std::set<Phase> phases;
  for (int run = 0; run < BODYSCHEMA_SEQUENCES && !testing::Test::HasFatalFailure(); ++run) {
    ControllerConfig config = test_config();
    config.max_searches = run % 2 ? 5 : 0;
    if (run % 8) config.inverse_kinematics.max_starts = 1;  // the time goes into others
    if (run % 3 == 0)
      config.workspace.keep_out = {{Eigen::Vector3d(1, -1, -1), Eigen::Vector3d(1.3, -0.9, 1)}};
    Bench bench(config);
    bench.driver_rounds = run % 4 == 0;
    if (run % 5 == 0) bench.bend_m = Eigen::Vector3d(0.01, -0.005, 0);
    if (run % 7 == 0) bench.arm = {-90.4, 0.2, 10.03};  // rests beyond two limits
    set_array(bench.motion.num_signals, bench.motion.commanded, bench.arm);
    if (rng() % 4) bench.start();
    std::int64_t target_id = 0, babble_id = 0;
    for (int event = 0; event < 60 && !testing::Test::HasFatalFailure(); ++event) {
      switch (rng() % 17) {
        case 16:
          bench.num_frames = static_cast<int>(rng() % 3);
          bench.p_RM_of_tag[40] = rng() % 2 ? kNear : kFar;
          if (rng() % 4 == 0) bench.p_RM_of_tag.clear();
          bench.give(tag_target(target_id++, 40 + static_cast<int>(rng() % 8 == 0)));
          break;
        case 0:
        case 1: {
          Target target = rng() % 4 == 0 ? pose_target(target_id++, {40, -0.5, 6})
                                         : position_target(target_id++,
                                                           rng() % 3   ? kFar
                                                           : rng() % 2 ? kNear
                                                                       : kBeyond,
                                                           rng() % 2 ? -1 : 1);
          if (rng() % 3 == 0) target.expiry_s = static_cast<double>(1 + rng() % 20);
          if (rng() % 3 == 0) target.way_point = target.num_way_points = 3;
          bench.give(target);
          break;
        }
        case 2:
          bench.give(other_target(target_id++, Target::KIND_HOLD));
          break;
        case 3:
          bench.give(other_target(target_id++, Target::KIND_RELEASE));
          break;
        case 4:
          bench.driver_speaks = rng() % 3;
          break;
        case 5:
          bench.driver_serves = rng() % 3;
          break;
        case 6:
          bench.eyes_open = rng() % 3;
          break;
        case 7:
          bench.monitor_speaks = rng() % 3;
          break;
        case 8:
          bench.observer_works = rng() % 3;
          break;
        case 9:
          if (bench.driver_speaks) bench.stop(!bench.motion.stop_latched);
          break;
        case 10:
          if (bench.motion.stop_latched || !bench.driver_speaks) break;
          bench.arm = {bench.arm[1] * 50, -bench.arm[1], 3};
          bench.settle("motor_babbler", 1, babble_id++, bench.arm);
          break;
        case 11:
          bench.schema.version += rng() % 2;
          break;
        case 12:
          bench.health = health_of(bench.schema.version, 2, 3, static_cast<std::int8_t>(rng() % 4));
          bench.health->probe_sample = rng() % 2 ? bench.num_samples : -1;
          if (bench.health->probe_sample >= 0)
            set_array(bench.health->num_probe, bench.health->probe_action, {5.0, 0.1, 1.0});
          break;
        case 13:
          if (rng() % 4 == 0)
            bench.motion.utime = std::max<std::int64_t>(0, bench.motion.utime - kSecond);
          break;
        case 14:
          if (!bench.moves.empty() && !bench.motion.stop_latched)
            bench.answer_last_move(
                rng() % 2 ? motion_status_t::STATE_REJECTED : motion_status_t::STATE_EXPIRED,
                "because");
          break;
        default:
          bench.run(static_cast<double>(rng() % 40) / 10);
      }
      if (rng() % 3) bench.run(0.5);
      phases.insert(bench.controller.phase());
    }
    num_moves += bench.moves.size();
    num_holds += bench.num_holds;
  }
  EXPECT_GT(num_moves, BODYSCHEMA_SEQUENCES * 1U);
  EXPECT_GT(num_holds, BODYSCHEMA_SEQUENCES * 1U);
  EXPECT_EQ(phases.size(), static_cast<std::size_t>(kNumPhases)) << "every phase was there";
}

INSTANTIATE_TEST_SUITE_P(Seeds, ControllerPropertyTest, testing::Range(0, 10));

}  // namespace
}  // namespace bodyschema::test
