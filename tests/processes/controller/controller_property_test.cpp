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

ControllerConfig config_of(int run) {
  ControllerConfig config = test_config();
  config.max_searches = run % 2 ? 5 : 0;
  if (run % 8) config.inverse_kinematics.max_starts = 1;  // the time goes into others
  if (run % 3 == 0)
    config.workspace.keep_out = {{Eigen::Vector3d(1, -1, -1), Eigen::Vector3d(1.3, -0.9, 1)}};
  if (run % 3 == 1)
    config.workspace.within = {Eigen::Vector3d(-0.5, -1.1, -1), Eigen::Vector3d(2.2, 1.5, 1)};
  return config;
}

/// Events at random around a controller.
class Sequence {
 public:
  Sequence(int run, const std::filesystem::path& kept, std::mt19937_64* rng)
      : bench(config_of(run)), kept_(kept), rng_(*rng) {
    bench.note_events();
    bench.driver_rounds = run % 4 == 0;
    if (run % 5 == 0) bench.bend_m = Eigen::Vector3d(0.01, -0.005, 0);
    if (run % 7 == 0) bench.arm = {-90.4, 0.2, 10.03};  // rests beyond two limits
    set_array(bench.motion.num_signals, bench.motion.commanded, bench.arm);
    if (rng_() % 4) bench.start();
  }

  void go_on() {
    const std::uint64_t event = rng_() % 28;
    operator_acts(event);
    driver_acts(event);
    others_act(event);
    if (rng_() % 3) bench.run(0.5);
  }

  Bench bench;

 private:
  bool is_free() const { return bench.driver_speaks && !bench.motion.stop_latched; }

  void give(Target target) {
    if (rng_() % 2) target.expiry_s = static_cast<double>(1 + rng_() % 8);
    bench.give(target);
  }

  void operator_acts(std::uint64_t event) {
    switch (event) {
      case 0:
      case 1:
      case 25:
      case 26:
        return give_place();
      case 2:
        return bench.give(other_target(target_id_++, Target::KIND_HOLD));
      case 3:
        return bench.give(other_target(target_id_++, Target::KIND_RELEASE));
      case 16:
        return give_tag();
      case 22:
        return let_all_but_the_arm_be_patient();
      case 23:
        return interrupt_a_move();
    }
  }
  void give_place() {
    Target target = rng_() % 4 == 0 ? pose_target(target_id_++, {40, -0.5, 6})
                                    : position_target(target_id_++,
                                                      rng_() % 3   ? kFar
                                                      : rng_() % 2 ? kNear
                                                                   : kBeyond,
                                                      rng_() % 2 ? -1 : 1);
    if (rng_() % 2) target.expiry_s = static_cast<double>(1 + rng_() % 8);
    if (rng_() % 3 == 0) target.way_point = target.num_way_points = 3;
    bench.give(target);
  }
  void give_tag() {
    bench.num_frames = rng_() % 2 ? TagTrack::kFrames : static_cast<int>(rng_() % 3);
    bench.p_RM_of_tag[40] = rng_() % 2 ? kNear : kFar;
    if (rng_() % 4 == 0) bench.p_RM_of_tag.clear();
    give(tag_target(target_id_++, 40 + static_cast<int>(rng_() % 8 == 0)));
  }
  void interrupt_a_move() {
    if (!is_free()) return;
    bench.driver_serves = rng_() % 2;
    bench.observer_works = rng_() % 2;
    give(position_target(target_id_++, rng_() % 2 ? kFar : kNear));
    if (rng_() % 2) bench.run(0.5);
    if (rng_() % 4 == 0 && !bench.moves.empty()) {
      bench.eyes_open = bench.monitor_speaks = true;
      bench.push(true);
      bench.answer_last_move(motion_status_t::STATE_REJECTED, "because");
      bench.show_frame();
      bench.run(21);
      return;
    }
    bench.settle("motor_babbler", 1, babble_id_++, bench.arm);
  }
  void let_all_but_the_arm_be_patient() {
    if (rng_() % 2) return;
    bench.driver_speaks = bench.eyes_open = bench.monitor_speaks = true;
    bench.driver_serves = bench.observer_works = rng_() % 2;
    if (rng_() % 2) bench.give(position_target(target_id_++, kNear));
    const std::int64_t time_before = bench.motion.utime;
    if (rng_() % 3) bench.push(true);
    if (!bench.moves.empty() && !bench.motion.stop_latched && rng_() % 2)
      bench.answer_last_move(
          rng_() % 2 ? motion_status_t::STATE_MOVING : motion_status_t::STATE_REJECTED, "because");
    if (rng_() % 2) bench.push(false);
    if (bench.motion.utime > time_before) bench.show_frame();
    bench.run(rng_() % 4 ? 21 : 52);
  }

  void driver_acts(std::uint64_t event) {
    switch (event) {
      case 4:
        bench.driver_speaks = rng_() % 3;
        return;
      case 5:
        bench.driver_serves = rng_() % 3;
        return;
      case 9:
        if (bench.driver_speaks) bench.stop(!bench.motion.stop_latched);
        return;
      case 10:
        if (!is_free()) return;
        bench.arm = {bench.arm[1] * 50, -bench.arm[1], 3};
        return bench.settle("motor_babbler", 1, babble_id_++, bench.arm);
      case 13:
        if (bench.driver_speaks && rng_() % 2) bench.set_back();
        return;
      case 14:
        if (!bench.moves.empty() && !bench.motion.stop_latched)
          bench.answer_last_move(
              rng_() % 2 ? motion_status_t::STATE_REJECTED : motion_status_t::STATE_EXPIRED,
              "because");
        return;
      case 18:
        if (is_free()) bench.hold(babble_id_++);
        return;
      case 19:
        if (!bench.moves.empty() && is_free())
          bench.answer_last_move(rng_() % 2   ? motion_status_t::STATE_STOPPED
                                 : rng_() % 2 ? motion_status_t::STATE_HOLDING
                                              : motion_status_t::STATE_MOVING,
                                 "because");
        return;
      case 20:
        if (bench.driver_speaks) bench.push(rng_() % 3 == 0);
        return;
    }
  }

  void others_act(std::uint64_t event) {
    switch (event) {
      case 6:
        bench.eyes_open = rng_() % 3;
        return;
      case 7:
        bench.monitor_speaks = rng_() % 3;
        return;
      case 8:
        bench.observer_works = rng_() % 3;
        return;
      case 11:
        bench.schema.version += rng_() % 2;
        return;
      case 12:
        bench.health = health_of(bench.schema.version, 2, 3, static_cast<std::int8_t>(rng_() % 4));
        bench.health->probe_sample = rng_() % 2 ? bench.num_samples : -1;
        if (bench.health->probe_sample >= 0)
          set_array(bench.health->num_probe, bench.health->probe_action, {5.0, 0.1, 1.0});
        return;
      case 15:
      case 27:
        return bench.run(static_cast<double>(rng_() % 40) / 10);
      case 17:
        if (rng_() % 3 == 0) bench.restart(kept_);
        return;
      case 21:
        bench.schema = planar(bench.schema.version + 1);
        if (rng_() % 3 == 0) bench.schema.edges.pop_back();
        return;
      case 24:
        if (bench.driver_speaks && bench.eyes_open)
          bench.put_tag(40, rng_() % 3 ? std::optional<Eigen::Vector3d>(kNear) : std::nullopt);
        return;
    }
  }

  const std::filesystem::path kept_;
  std::mt19937_64& rng_;
  std::int64_t target_id_ = 0, babble_id_ = 0;
};

void expect_all_were_met(const std::set<std::pair<Phase, Event>>& met) {
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
    Sequence sequence(run, kept, &rng);
    for (int event = 0; event < 40 && !testing::Test::HasFatalFailure(); ++event) sequence.go_on();
    met.merge(sequence.bench.met);
    num_moves += sequence.bench.moves.size();
    num_holds += sequence.bench.num_holds;
  }
  EXPECT_GT(num_moves, BODYSCHEMA_SEQUENCES * 1U);
  EXPECT_GT(num_holds, BODYSCHEMA_SEQUENCES * 1U);
  std::filesystem::remove(kept);
  expect_all_were_met(met);
}

INSTANTIATE_TEST_SUITE_P(Seeds, ControllerPropertyTest, testing::Range(0, 10));

}  // namespace
}  // namespace bodyschema::test
