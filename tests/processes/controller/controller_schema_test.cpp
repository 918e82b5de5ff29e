// Class Controller: the schema changes on the way, and what is seen corrects it.

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "common/geometry/angle.h"
#include "tests/processes/controller/controller_bench.h"

namespace bodyschema::test {
namespace {

TEST(ControllerTest, WithAnInvalidEdgeOnTheWayTheArmIsLentAndTakenBack) {
  for (const bool by_monitor : {false, true}) {
    Bench bench;
    bench.start();
    bench.give(position_target(0, kFar));
    ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
    if (by_monitor) {
      bench.health = health_of(1, 2, 3, schema_edge_t::EDGE_INVALID);
    } else {
      bench.schema.version = 2;
      bench.schema.edges[1].state = EdgeState::kInvalid;
    }
    bench.repeat();
    ASSERT_TRUE(bench.run_until_state(S::CONTROL_LENT));  // the action under way is finished
    const std::size_t num_moves = bench.moves.size();
    EXPECT_LE(num_moves, 2U);
    EXPECT_EQ(bench.status.owns_arm, 0);
    EXPECT_TRUE(bench.has_why("2–3")) << bench.status.why;
    // The babbler probes.
    for (int i = 0; i < 3; ++i) {
      bench.arm = {10.0 * i, 0.1 * i, 1.0 * i};
      bench.settle("motor_babbler", 1, 20 + i, bench.arm);
      bench.run(1);
    }
    EXPECT_EQ(bench.moves.size(), num_moves);
    EXPECT_EQ(bench.num_holds, 0);
    bench.health.reset();
    bench.schema = planar(3);
    bench.repeat();
    EXPECT_EQ(bench.status.owns_arm, 1);
    EXPECT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
    EXPECT_EQ(bench.status.target_id, 0);
  }
}

TEST(ControllerTest, AProbeIsMadeInSmallStepsBeforeTheNextStepOrDoneWithout) {
  for (const bool is_refused : {false, true}) {
    Bench bench;
    bench.start();
    bench.give(position_target(0, kFar));
    ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
    bench.health = health_of(1, 2, 3, schema_edge_t::EDGE_PROVISIONAL);
    bench.health->probe_sample = bench.num_samples;
    const std::vector<double> wanted{5.0, 0.9, 1.0};
    set_array(bench.health->num_probe, bench.health->probe_action, wanted);
    bench.rejects = [&](const action_command_t& command) {
      return is_refused && command.purpose == action_command_t::PURPOSE_PROBE ? "a wall" : "";
    };
    std::vector<double> before = bench.moves[0].action;
    bench.repeat();
    ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
    EXPECT_EQ(bench.status.num_probes, is_refused ? 0 : 1);
    int num_probes = 0;
    for (std::size_t n = 1; n < bench.moves.size(); ++n) {
      const action_command_t& move = bench.moves[n];
      for (std::size_t i = 0; i < 3; ++i) {
        const Signal& signal = bench.config_.signals[i];
        EXPECT_LE(std::abs(move.action[i] - before[i]), 0.0501 * (signal.upper - signal.lower));
      }
      const bool is_probe = move.purpose == action_command_t::PURPOSE_PROBE;
      num_probes += is_probe;
      if (is_probe) {
        EXPECT_EQ(move.action, wanted);
      }
      if (!is_probe || !is_refused) before = move.action;
    }
    EXPECT_EQ(num_probes, 1);
  }
}

// The way back from a probe is none along the line; a probe that was refused left none.
TEST(ControllerTest, OnAPathAnotherWayBackFromAProbeIsTakenIfOneIsRefused) {
  enum class Probe { kNotWanted, kRefused, kMade };
  for (const Probe probe : {Probe::kNotWanted, Probe::kRefused, Probe::kMade}) {
    Bench bench;
    bench.start();
    pose_target_t step = position_target(0, kFar);
    step.way_point = step.num_way_points = 2;
    bench.give(step);
    ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
    bench.health = health_of(1, 2, 3, schema_edge_t::EDGE_PROVISIONAL);
    bench.health->probe_sample = probe == Probe::kNotWanted ? -1 : bench.num_samples;
    std::vector<double> wanted = bench.moves.back().action;
    wanted[1] += wanted[1] > 0 ? -0.05 : 0.05;  // in one step from there, within the limits
    set_array(bench.health->num_probe, bench.health->probe_action, wanted);
    bool is_probed = probe == Probe::kNotWanted, is_refused = false;
    bench.rejects = [&](const action_command_t& command) {
      if (command.purpose == action_command_t::PURPOSE_PROBE) {
        is_probed = true;
        return probe == Probe::kRefused ? "a wall" : "";
      }
      const bool is_first = is_probed && !is_refused;
      is_refused |= is_first;
      return is_first ? "a wall" : "";
    };
    bench.repeat();
    ASSERT_TRUE(bench.run_until([&] {
      return is_refused && bench.status.control_state != S::CONTROL_MOVING;
    })) << bench.status.why;
    bench.run(30);
    EXPECT_EQ(bench.status.num_probes, probe == Probe::kMade);
    EXPECT_EQ(bench.status.control_state == S::CONTROL_REACHED, probe == Probe::kMade)
        << bench.status.why;
    EXPECT_EQ(bench.has_why("along the line is refused"), probe != Probe::kMade);
  }
}

TEST(ControllerTest, AProbeBeyondTheLimitsIsNotMade) {
  Bench bench;
  bench.start();
  bench.health = health_of(1, 2, 3, schema_edge_t::EDGE_PROVISIONAL);
  bench.health->probe_sample = 1;
  set_array(bench.health->num_probe, bench.health->probe_action, {95.0, 0.1, 1.0});
  bench.repeat();
  bench.give(position_target(0, kFar));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_EQ(bench.status.num_probes, 0);
}

// What was to be told apart may be told by a newer schema.
TEST(ControllerTest, AProbeThatWasWantedOfAnotherSchemaIsNotMade) {
  for (const bool is_of_another : {false, true}) {
    Bench bench;
    bench.start();
    bench.schema.edges[1].state = EdgeState::kProvisional;
    bench.health = health_of(bench.schema.version, 2, 3, schema_edge_t::EDGE_PROVISIONAL);
    bench.health->probe_sample = 1;
    set_array(bench.health->num_probe, bench.health->probe_action, {5.0, 0.9, 1.0});
    bench.schema.version += is_of_another;
    bench.repeat();
    bench.give(position_target(0, kFar));
    ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
    EXPECT_EQ(bench.status.num_probes, is_of_another ? 0 : 1);
  }
}

TEST(ControllerTest, WithAnInvalidEdgeItMovesALittleAndLendsTheArmOnlyWhereThatDoesNotMendIt) {
  for (const bool is_mended : {true, false}) {
    ControllerConfig config = test_config();
    config.max_searches = 6;
    Bench bench(config);
    bench.start();
    bench.give(position_target(0, kFar));
    ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
    bench.health = health_of(1, 2, 3, schema_edge_t::EDGE_INVALID);
    bench.repeat();
    ASSERT_TRUE(bench.run_until([&] { return bench.status.num_probes >= 1; }));
    const std::vector<double> centre = bench.moves[0].action;
    ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 5; }));
    if (is_mended) bench.health = health_of(1, 2, 3, schema_edge_t::EDGE_OK);
    bench.repeat();
    ASSERT_TRUE(bench.run_until_state(is_mended ? S::CONTROL_REACHED : S::CONTROL_LENT))
        << bench.status.why;
    EXPECT_LE(bench.status.num_probes, 6);
    EXPECT_GE(bench.status.num_probes, is_mended ? 4 : 6);
    for (std::size_t n = 1; n < 5; ++n) {
      EXPECT_EQ(bench.moves[n].purpose, action_command_t::PURPOSE_PROBE);
      for (std::size_t i = 0; i < 3; ++i) {
        const Signal& signal = config.signals[i];
        EXPECT_LE(std::abs(bench.moves[n].action[i] - centre[i]),
                  0.1001 * (signal.upper - signal.lower));
      }
    }
    EXPECT_NE(bench.moves[1].action, bench.moves[2].action);
  }
}

TEST(ControllerTest, OnAPathAnArmWithAnInvalidEdgeIsNotLentButHeld) {
  ControllerConfig config = test_config();
  config.max_searches = 3;
  Bench bench(config);
  bench.start();
  pose_target_t step = position_target(0, kFar);
  step.way_point = 1;
  step.num_way_points = 2;
  bench.give(step);
  ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
  bench.health = health_of(1, 2, 3, schema_edge_t::EDGE_INVALID);
  bench.repeat();
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_HOLDING)) << bench.status.why;
  EXPECT_EQ(bench.status.num_probes, 3);
  EXPECT_EQ(bench.status.owns_arm, 1);
  EXPECT_NE(bench.status.why.find("release the arm"), std::string::npos) << bench.status.why;
}

TEST(ControllerTest, AnArmThatIsLentInVainEndsTheTarget) {
  Bench bench;
  bench.schema.edges[1].state = EdgeState::kInvalid;
  bench.start();
  bench.give(position_target(0, kFar));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_LENT));
  // As long as there are new samples it may still be mended.
  for (int i = 0; i < 3; ++i) {
    bench.run(40);
    bench.settle("motor_babbler", 1, i, {10.0 * i, 0.1 * i, 1.0 * i});
  }
  bench.run(25);
  const std::int64_t newest = bench.num_samples - 1;
  bench.num_samples = newest;
  bench.show_sample();  // the same again
  bench.run(24);
  EXPECT_EQ(bench.status.control_state, S::CONTROL_LENT);
  bench.run(2);
  EXPECT_EQ(bench.status.control_state, S::CONTROL_REFUSED);
  EXPECT_TRUE(bench.has_why("edge 2–3 is invalid")) << bench.status.why;
  EXPECT_TRUE(bench.has_why("does the babbler run")) << bench.status.why;
  EXPECT_TRUE(bench.moves.empty());
}

TEST(ControllerTest, AnInvalidEdgeBesideTheWayDoesNotMatter) {
  Bench bench;
  bench.schema.edges[2].state = EdgeState::kInvalid;
  bench.start();
  Target target = position_target(
      0, {0.7 * std::cos(0.4) + 1 * std::cos(0.1), 0.7 * std::sin(0.4) + 1 * std::sin(0.1), 0});
  target.target_part = 3;
  bench.give(target);
  EXPECT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
}

TEST(ControllerTest, WithADoubtfulEdgeItGoesInSmallSteps) {
  for (const auto state : {EdgeState::kSuspect, EdgeState::kProvisional}) {
    Bench bench;
    bench.schema.edges[0].state = state;
    bench.start();
    bench.give(position_target(0, kFar));
    std::vector<double> before = bench.arm;
    ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED));
    for (const action_command_t& move : bench.moves) {
      for (std::size_t i = 0; i < 3; ++i) {
        const Signal& signal = bench.config_.signals[i];
        EXPECT_LE(std::abs(move.action[i] - before[i]), 0.0501 * (signal.upper - signal.lower));
      }
      before = move.action;
    }
  }
}

TEST(ControllerTest, ANewSchemaInTheMiddleIsPlannedWithAnew) {
  Bench bench;
  bench.start();
  bench.give(position_target(0, kFar));
  ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
  bench.schema.version = 2;
  bench.schema.edges[2].right.translation().x() = 0.5;  // a longer tool
  bench.hidden = {4};
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED));
  EXPECT_EQ(bench.status.schema_version, 2);
  const auto X_RB = bench.schema.predict(1, 4, Eigen::Vector3d(bench.arm.data()));
  EXPECT_LT((X_RB->X_AB.translation() - kFar).norm(), 1e-4);
  EXPECT_EQ(bench.status.observed_error_m, -1);
  EXPECT_TRUE(bench.has_why("not seen")) << bench.status.why;
}

TEST(ControllerTest, APartThatIsLostInTheMiddleEndsTheTargetAndTheArmStaysHeld) {
  Bench bench;
  bench.start();
  bench.give(position_target(0, kFar));
  ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
  bench.schema.version = 2;
  bench.schema.edges.pop_back();
  UnconnectedPart lost;
  lost.part = 4;
  bench.schema.unconnected.push_back(lost);
  bench.repeat();
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_HOLDING));
  EXPECT_LE(bench.moves.size(), 2U);
  EXPECT_EQ(bench.status.owns_arm, 1);
  EXPECT_TRUE(bench.has_why("not connected")) << bench.status.why;
}

TEST(ControllerTest, AnOlderSchemaCountsOnlyAfterTheNewerFellSilent) {
  Bench bench;
  bench.schema = planar(7);
  bench.start();
  bench.schema = planar(2);
  bench.run(2);
  EXPECT_EQ(bench.controller.status().schema_version, 7);
  bench.run(5);
  EXPECT_EQ(bench.controller.status().schema_version, 2);
}

TEST(ControllerTest, AnOlderSchemaCountsThenAlsoWhereTheArmIsItsOwn) {
  Bench bench;
  bench.schema = planar(7);
  bench.start();
  bench.give(position_target(0, kNear));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED));
  bench.schema = planar(2);
  bench.run(7);
  EXPECT_EQ(bench.status.owns_arm, 1);
  bench.give(position_target(1, kFar));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_EQ(bench.status.schema_version, 2);
}

// ---- what is seen at the end

TEST(ControllerTest, WhatIsSeenAtTheEndCorrectsOnce) {
  Bench bench;
  bench.bend_m = Eigen::Vector3d(0.01, -0.005, 0);
  bench.start();
  bench.give(position_target(0, kNear));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED));
  EXPECT_LT(bench.status.observed_error_m, 0.001);
  EXPECT_NEAR(bench.status.predicted_error_m, bench.bend_m.norm(), 0.001);
  EXPECT_TRUE(bench.has_why("seen there")) << bench.status.why;
}

// Also where another posture would have served it, and the arm is on the way to that already.
TEST(ControllerTest, WhereACorrectionIsRefusedItIsTakenBackAndTheArmStaysThereOrComesBack) {
  for (const bool is_on_path : {false, true}) {
    for (const int num_steps_allowed : {0, 1}) {
      ControllerConfig config = test_config();
      config.max_step = 0.05;  // other postures are farther
      Bench bench(config);
      bench.bend_m = Eigen::Vector3d(0.01, -0.005, 0);
      bench.start();
      pose_target_t target = position_target(0, kNear);
      target.way_point = target.num_way_points = is_on_path ? 2 : 0;
      bool has_arrived = false;
      int num_refused = 0, num_allowed = 0;
      bench.rejects = [&](const auto&) {
        has_arrived |= (bench.part_position() - kNear).norm() < 0.001;
        if (!has_arrived || num_refused == bench.config_.max_solutions) return "";
        if (num_refused > 0 && num_allowed++ < num_steps_allowed) return "";
        ++num_refused;
        return "a wall";
      };
      bench.give(target);
      ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
      EXPECT_EQ(num_refused, is_on_path ? 1 : bench.config_.max_solutions);
      EXPECT_EQ(num_allowed > num_steps_allowed, !is_on_path);
      EXPECT_LT(bench.status.predicted_error_m, 0.001);
      EXPECT_GT(bench.status.observed_error_m, 0.005);
    }
  }
}

TEST(ControllerTest, ACorrectionIsForgottenWithTheSchemaThatNeededIt) {
  Bench bench;
  bench.bend_m = Eigen::Vector3d(0.01, -0.005, 0);
  bench.start();
  bench.give(position_target(0, kNear));
  ASSERT_TRUE(bench.run_until([&] {
    return bench.status.observed_error_m > 0.005 && bench.status.control_state == S::CONTROL_MOVING;
  }));
  bench.bend_m.setZero();  // and version 2 knows it
  bench.schema.version = 2;
  bench.show_schema();
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_LT(bench.status.observed_error_m, 1e-4);
  EXPECT_LT(bench.status.predicted_error_m, 1e-4);
}

TEST(ControllerTest, AnOrientationThatIsSeenOffIsTold) {
  Bench bench;
  bench.turn_rad = 20 * kDegree;
  bench.start();
  bench.give(pose_target(0, {40, -0.5, 6}));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_TRUE(bench.has_why("20.0° away")) << bench.status.why;
}

// Half a degree of the root's pose is 17 mm at the end of an arm of two metres.
TEST(ControllerTest, WhatThePoseOfTheRootExplainsCorrectsNothing) {
  for (const double sd_rad : {1e-4, 0.5 * kDegree}) {
    Bench bench;
    bench.schema.X_CR_covariance.bottomRightCorner<3, 3>() =
        Eigen::Matrix3d::Identity() * sd_rad * sd_rad;
    bench.bend_m = Eigen::Vector3d(0, 0.01, 0);
    bench.start();
    bench.give(position_target(0, kNear));
    ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED));
    EXPECT_EQ(bench.status.predicted_error_m<1e-4, sd_rad> 1e-3);
  }
}

TEST(ControllerTest, WhatIsSeenUnsurelyCorrectsNothing) {
  for (const bool is_ambiguous : {false, true}) {
    Bench bench;
    bench.bend_m = Eigen::Vector3d(0.01, -0.005, 0);
    bench.is_ambiguous = is_ambiguous;
    if (!is_ambiguous) bench.observation_sd_m = 0.01;
    bench.start();
    bench.give(position_target(0, kNear));
    ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED));
    EXPECT_NEAR(bench.status.observed_error_m, bench.bend_m.norm(), 1e-3);
    EXPECT_LT(bench.status.predicted_error_m, 1e-4);
  }
}

TEST(ControllerTest, ASystematicErrorNeitherMovesTheCameraNorCorrects) {
  ControllerConfig config = test_config();
  config.measurement.systematic = {0.02, 2 * kDegree};
  Bench bench(config);
  bench.X_CC_moved.translation() = Eigen::Vector3d(0.02, 0, 0);
  bench.bend_m = Eigen::Vector3d(0.01, -0.005, 0);
  bench.start();
  bench.give(position_target(0, kNear));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED));
  const Eigen::Vector3d seen_off = bench.X_CC_moved.translation() + bench.bend_m;
  EXPECT_NEAR(bench.status.observed_error_m, seen_off.norm(), 1e-3);
  EXPECT_LT(bench.status.predicted_error_m, 1e-4);
}

TEST(ControllerTest, ACameraThatWasMovedIsSeenByTheRoot) {
  Bench bench;
  bench.X_CC_moved.translation() = Eigen::Vector3d(0.2, 0, 0.1);
  bench.start();
  bench.give(position_target(0, kNear));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED));
  EXPECT_LT(bench.status.observed_error_m, 1e-4);
}

TEST(ControllerTest, ATagThatMovedOnItsPartNeitherJudgesNorCorrects) {
  constexpr int kTag = 41;
  for (const bool has_moved : {false, true}) {
    Bench bench;
    bench.bend_m = Eigen::Vector3d(0.01, -0.005, 0);
    bench.tag = kTag;
    if (has_moved) bench.schema.moved_tags = {{.tag = kTag, .found = 0, .since = 0, .until = -1}};
    bench.start();
    bench.give(position_target(0, kNear));
    ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED));
    EXPECT_EQ(bench.status.observed_error_m < 0, has_moved);
    EXPECT_EQ(bench.status.predicted_error_m < 1e-4, has_moved);
    EXPECT_EQ(bench.has_why("not seen there"), has_moved) << bench.status.why;
  }
}

TEST(ControllerTest, WhatIsSeenTooFarOffIsToldButNotBelieved) {
  Bench bench;
  bench.bend_m = Eigen::Vector3d(0.3, 0, 0);
  bench.start();
  bench.give(position_target(0, kNear));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED));
  EXPECT_NEAR(bench.status.observed_error_m, 0.3, 1e-4);
  EXPECT_LT(bench.status.predicted_error_m, 1e-4);
  EXPECT_TRUE(bench.has_why("300.0 mm away")) << bench.status.why;
}

}  // namespace
}  // namespace bodyschema::test
