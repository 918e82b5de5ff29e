#include <gtest/gtest.h>
#include <unistd.h>

#include <filesystem>
#include <random>
#include <set>
#include <string>
#include <utility>

#include "tests/processes/controller/controller_bench.h"

namespace bodyschema::test {
namespace {

class ControllerPropertyTest : public testing::TestWithParam<int> {};

// Anything in any order: Bench asserts that every message makes sense, that nothing moves an arm
// that is not the controller's, is not seen at rest or has no SAMPLE yet, or for a target that is
// over; that ids are new, steps small, and smaller in doubt, actions within the limits, parts in
// the workspace and in no keep-out box; that no target is served while driver, eyes or monitor are
// silent, and that of a tag while it is not seen; that on a path the arm is never lent, and that
// one on which it was held does not go on.
TEST_P(ControllerPropertyTest, WhateverHappensItsCommandsAreLawful) {
  std::mt19937_64 rng(static_cast<std::uint64_t>(GetParam()));
  std::size_t num_moves = 0, num_holds = 0;
  std::set<std::pair<Phase, Event>> met;
  const auto kept = std::filesystem::path(testing::TempDir()) /
                    ("controller_property_" + std::to_string(getpid()) + ".yaml");
  for (int run = 0; run < BODYSCHEMA_SEQUENCES && !testing::Test::HasFatalFailure(); ++run) {
    ControllerConfig config = test_config();
    config.max_searches = run % 2 ? 5 : 0;
    if (run % 8) config.inverse_kinematics.max_starts = 1;  // the time goes into others
    if (run % 3 == 0)
      config.workspace.keep_out = {{Eigen::Vector3d(1, -1, -1), Eigen::Vector3d(1.3, -0.9, 1)}};
    if (run % 3 == 1)
      config.workspace.within = {Eigen::Vector3d(-0.5, -1.1, -1), Eigen::Vector3d(2.2, 1.5, 1)};
    Bench bench(config);
    bench.note_events();
    bench.driver_rounds = run % 4 == 0;
    if (run % 5 == 0) bench.bend_m = Eigen::Vector3d(0.01, -0.005, 0);
    if (run % 7 == 0) bench.arm = {-90.4, 0.2, 10.03};  // rests beyond two limits
    set_array(bench.motion.num_signals, bench.motion.commanded, bench.arm);
    if (rng() % 4) bench.start();
    std::int64_t target_id = 0, babble_id = 0;
    for (int event = 0; event < 40 && !testing::Test::HasFatalFailure(); ++event) {
      Target target{};
      std::int64_t time_before = 0;
      switch (rng() % 28) {
        case 24:
          if (bench.driver_speaks && bench.eyes_open)
            bench.put_tag(40, rng() % 3 ? std::optional<Eigen::Vector3d>(kNear) : std::nullopt);
          break;
        case 23:  // in the middle of a move
          if (bench.motion.stop_latched || !bench.driver_speaks) break;
          bench.driver_serves = rng() % 2;
          bench.observer_works = rng() % 2;
          target = position_target(target_id++, rng() % 2 ? kFar : kNear);
          if (rng() % 2) target.expiry_s = static_cast<double>(1 + rng() % 8);
          bench.give(target);
          if (rng() % 2) bench.run(0.5);
          if (rng() % 4 == 0 && !bench.moves.empty()) {
            bench.eyes_open = bench.monitor_speaks = true;
            bench.push(true);
            bench.answer_last_move(motion_status_t::STATE_REJECTED, "because");
            bench.show_frame();
            bench.run(21);
            break;
          }
          bench.settle("motor_babbler", 1, babble_id++, bench.arm);
          break;
        case 17:
          if (rng() % 3 == 0) bench.restart(kept);
          break;
        case 18:
          if (bench.driver_speaks && !bench.motion.stop_latched) bench.hold(babble_id++);
          break;
        case 19:
          if (!bench.moves.empty() && bench.driver_speaks && !bench.motion.stop_latched)
            bench.answer_last_move(rng() % 2   ? motion_status_t::STATE_STOPPED
                                   : rng() % 2 ? motion_status_t::STATE_HOLDING
                                               : motion_status_t::STATE_MOVING,
                                   "because");
          break;
        case 20:
          if (bench.driver_speaks) bench.push(rng() % 3 == 0);
          break;
        case 21:
          bench.schema = planar(bench.schema.version + 1);
          if (rng() % 3 == 0) bench.schema.edges.pop_back();
          break;
        case 16:
          bench.num_frames = rng() % 2 ? TagTrack::kFrames : static_cast<int>(rng() % 3);
          bench.p_RM_of_tag[40] = rng() % 2 ? kNear : kFar;
          if (rng() % 4 == 0) bench.p_RM_of_tag.clear();
          target = tag_target(target_id++, 40 + static_cast<int>(rng() % 8 == 0));
          if (rng() % 2) target.expiry_s = static_cast<double>(1 + rng() % 8);
          bench.give(target);
          break;
        case 0:
        case 1:
        case 25:
        case 26:
          target = rng() % 4 == 0 ? pose_target(target_id++, {40, -0.5, 6})
                                  : position_target(target_id++,
                                                    rng() % 3   ? kFar
                                                    : rng() % 2 ? kNear
                                                                : kBeyond,
                                                    rng() % 2 ? -1 : 1);
          if (rng() % 2) target.expiry_s = static_cast<double>(1 + rng() % 8);
          if (rng() % 3 == 0) target.way_point = target.num_way_points = 3;
          bench.give(target);
          break;
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
          if (bench.driver_speaks && rng() % 2) bench.set_back();
          break;
        case 14:
          if (!bench.moves.empty() && !bench.motion.stop_latched)
            bench.answer_last_move(
                rng() % 2 ? motion_status_t::STATE_REJECTED : motion_status_t::STATE_EXPIRED,
                "because");
          break;
        case 22:  // all but the arm are patient
          if (rng() % 2) break;
          bench.driver_speaks = bench.eyes_open = bench.monitor_speaks = true;
          bench.driver_serves = bench.observer_works = rng() % 2;
          if (rng() % 2) bench.give(position_target(target_id++, kNear));
          time_before = bench.motion.utime;
          if (rng() % 3) bench.push(true);
          if (!bench.moves.empty() && !bench.motion.stop_latched && rng() % 2)
            bench.answer_last_move(
                rng() % 2 ? motion_status_t::STATE_MOVING : motion_status_t::STATE_REJECTED,
                "because");
          if (rng() % 2) bench.push(false);
          if (bench.motion.utime > time_before) bench.show_frame();
          bench.run(rng() % 4 ? 21 : 52);
          break;
        default:
          bench.run(static_cast<double>(rng() % 40) / 10);
      }
      if (rng() % 3) bench.run(0.5);
    }
    met.merge(bench.met);
    num_moves += bench.moves.size();
    num_holds += bench.num_holds;
  }
  EXPECT_GT(num_moves, BODYSCHEMA_SEQUENCES * 1U);
  EXPECT_GT(num_holds, BODYSCHEMA_SEQUENCES * 1U);
  std::filesystem::remove(kept);
  std::set<Phase> phases;
  for (const auto& [phase, event] : met) phases.insert(phase);
  EXPECT_EQ(phases.size(), static_cast<std::size_t>(kNumPhases)) << "every phase was there";
  if (BODYSCHEMA_SEQUENCES < 10'000) return;
  for (int p = 0; p < kNumPhases; ++p) {
    for (int e = 0; e < kNumEvents; ++e) {
      const auto phase = static_cast<Phase>(p);
      const auto event = static_cast<Event>(e);
      const Reaction::Kind kind = reaction(phase, event).kind;
      const bool matters = kind == Reaction::Kind::kGoes || kind == Reaction::Kind::kStays;
      EXPECT_TRUE(!matters || met.contains({phase, event}))
          << info(event).name << " in " << info(phase).name << " was not tried";
    }
  }
}

INSTANTIATE_TEST_SUITE_P(Seeds, ControllerPropertyTest, testing::Range(0, 10));

}  // namespace
}  // namespace bodyschema::test
