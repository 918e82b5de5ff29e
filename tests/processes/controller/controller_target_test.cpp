// Class Controller: what a target's life is.

#include <gtest/gtest.h>

#include <limits>
#include <string>

#include "common/config/yaml.h"
#include "common/geometry/angle.h"
#include "tests/processes/controller/controller_bench.h"

namespace bodyschema::test {
namespace {

TEST(ControllerTest, ATargetIsReachedInSmallStepsEachSeenAndKept) {
  Bench bench;
  bench.start();
  EXPECT_EQ(bench.status.control_state, S::CONTROL_IDLE);
  EXPECT_EQ(bench.status.owns_arm, 0);
  EXPECT_EQ(bench.status.target_id, -1);
  bench.give(position_target(3, kFar));
  EXPECT_EQ(bench.status.target_epoch, 77);  // acknowledged at once
  EXPECT_EQ(bench.status.target_id, 3);
  EXPECT_EQ(bench.status.owns_arm, 1);
  EXPECT_TRUE(bench.moves.empty());
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_GT(bench.moves.size(), 1U);
  EXPECT_EQ(bench.status.num_moves, static_cast<int>(bench.moves.size()));
  EXPECT_EQ(bench.num_samples, static_cast<int>(bench.moves.size()));
  EXPECT_LT((bench.part_position() - kFar).norm(), 1e-4);
  EXPECT_LT(bench.status.predicted_error_m, 1e-4);
  EXPECT_NEAR(bench.status.observed_error_m, bench.status.predicted_error_m, 1e-6);
  EXPECT_EQ(bench.status.target_part, 4);
  EXPECT_EQ(bench.status.schema_version, 1);
  EXPECT_EQ(bench.moves.front().epoch, 5 * kSecond);
  EXPECT_EQ(bench.moves.front().action_id, 0);
  const std::size_t num_moves = bench.moves.size();
  bench.run(100);
  EXPECT_EQ(bench.status.control_state, S::CONTROL_REACHED);
  EXPECT_EQ(bench.status.owns_arm, 1);
  EXPECT_EQ(bench.moves.size(), num_moves);
}

TEST(ControllerTest, ATargetIsKeptSoLongAndTheArmGivenBack) {
  Bench bench;
  bench.start();
  bench.give(position_target(0, kNear, 7));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED));
  bench.run(6.5);
  EXPECT_EQ(bench.status.owns_arm, 1);
  bench.run(1);
  EXPECT_EQ(bench.status.control_state, S::CONTROL_RELEASED);
  EXPECT_EQ(bench.status.owns_arm, 0);
  EXPECT_EQ(bench.num_holds, 0);
}

TEST(ControllerTest, APoseIsReachedInPositionAndOrientation) {
  Bench bench;
  bench.start();
  bench.give(pose_target(0, {40, -0.5, 6}));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  // Three joints in a plane reach a pose in two ways, elbow up and down.
  EXPECT_LT(bench.status.predicted_error_m, 1e-4);
  EXPECT_NEAR(bench.status.predicted_error_rad, 0, 1e-3);
  EXPECT_NEAR(bench.status.observed_error_rad, 0, 1e-3);
  bench.give(position_target(1, kNear));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_EQ(bench.status.predicted_error_rad, -1);
  EXPECT_EQ(bench.status.observed_error_rad, -1);
}

TEST(ControllerTest, AnOrientationOutOfReachIsRefusedUnlessTheTargetToleratesIt) {
  Bench bench;
  bench.start();
  Target target = pose_target(0, {40, -0.5, 6});
  const Eigen::Quaterniond tilted =
      Eigen::Quaterniond(target.orientation_wxyz[0], target.orientation_wxyz[1],
                         target.orientation_wxyz[2], target.orientation_wxyz[3]) *
      Eigen::AngleAxisd(0.1, Eigen::Vector3d::UnitX());
  const double wxyz[] = {tilted.w(), tilted.x(), tilted.y(), tilted.z()};
  std::copy(std::begin(wxyz), std::end(wxyz), target.orientation_wxyz);
  bench.give(target);
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REFUSED)) << bench.status.why;
  EXPECT_TRUE(bench.has_why("5.7°")) << bench.status.why;
  EXPECT_TRUE(bench.moves.empty());
  target.target_id = 1;
  target.tolerance_rad = 0.11;
  bench.give(target);
  EXPECT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_NEAR(bench.status.predicted_error_rad, 0.1, 0.01);
}

// Of an orientation that hardly matters the position is not traded for it.
TEST(ControllerTest, TheNearestApproachIsTheOneByWhatIsTolerated) {
  Bench bench;
  bench.start();
  Target target = pose_target(0, Eigen::Vector3d(20, -0.4, 6));
  const Eigen::Quaterniond sideways(Eigen::AngleAxisd(1.5, Eigen::Vector3d::UnitX()));
  const double wxyz[] = {sideways.w(), sideways.x(), sideways.y(), sideways.z()};
  std::copy(std::begin(wxyz), std::end(wxyz), target.orientation_wxyz);
  target.position_m[0] = 2.0;
  target.position_m[1] = 0.4;
  target.tolerance_m = 0.01;
  target.tolerance_rad = M_PI;
  bench.give(target);
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_LT(bench.status.predicted_error_m, 0.01);
}

// What changed at rest is seen by a SAMPLE alone.
TEST(ControllerTest, AnArmThatIsThereAlreadyIsLookedAt) {
  Bench bench;
  bench.start();
  bench.give(position_target(0, kNear));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED));
  const std::vector<double> before = bench.arm;
  bench.bend_m = Eigen::Vector3d(0.1, 0, 0);
  bench.put_tag(40, std::nullopt);  // another rest, of which there is no SAMPLE
  bench.give(position_target(1, kNear));
  ASSERT_TRUE(
      bench.run_until([&] { return bench.status.target_id == 1 && bench.status.num_moves == 1; }));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_EQ(bench.status.num_moves, 1);
  for (std::size_t i = 0; i < before.size(); ++i) EXPECT_NEAR(bench.arm[i], before[i], 1e-3);
  EXPECT_NEAR(bench.status.observed_error_m, 0.1, 0.01);
}

TEST(ControllerTest, AToleranceLetsANearestApproachCount) {
  Bench bench;
  bench.start();
  Target target = position_target(0, Eigen::Vector3d(2.15, 0, 0));  // 2.1 m is its reach
  bench.give(target);
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REFUSED)) << bench.status.why;
  target.target_id = 1;
  target.tolerance_m = 0.06;
  bench.give(target);
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_NEAR(bench.status.predicted_error_m, 0.05, 0.01);
}

TEST(ControllerTest, NoPartLeavesTheWorkspaceOnTheWay) {
  // A wall in the middle of the way of the last part, which its first joint swings across.
  const auto swing = [](double degrees) {
    return planar().predict(1, 4, Eigen::Vector3d(degrees, 0, 0))->X_AB.translation().eval();
  };
  ControllerConfig config = test_config();
  config.signals[1] = {"b", 0, 0};
  config.signals[2] = {"c", 0, 0};
  for (const double half_m : {0.0, 0.3, 0.003}) {
    const bool is_walled = half_m > 0;
    if (is_walled)
      config.workspace.keep_out = {
          {Eigen::Vector3d(2, -half_m, -1), Eigen::Vector3d(3, half_m, 1)}};
    Bench bench(config);
    bench.schema.signals = config.signals;
    bench.arm = {-30, 0, 0};
    set_array(bench.motion.num_signals, bench.motion.commanded, bench.arm);
    bench.start();
    bench.give(position_target(0, swing(30)));
    ASSERT_TRUE(bench.run_until_state(is_walled ? S::CONTROL_REFUSED : S::CONTROL_REACHED))
        << bench.status.why;
    if (is_walled) {
      EXPECT_TRUE(bench.has_why("part 4 would be in keep_out box 1")) << bench.status.why;
      EXPECT_TRUE(bench.moves.empty());
    }
    // On this side of it the arm may move.
    bench.give(position_target(1, swing(-20)));
    EXPECT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  }
}

TEST(ControllerTest, ADriverThatRoundsIsThereWhereItWasSent) {
  Bench bench;
  bench.driver_rounds = true;
  bench.start();
  bench.give(position_target(0, kNear));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_LT(bench.moves.size(), 12U);
}

// The bench asserts that every MOVE is within the limits.
TEST(ControllerTest, AnArmThatRestsBeyondALimitIsBroughtBackInside) {
  Bench bench;
  bench.arm = {-90.9, 1.01, 0};
  set_array(bench.motion.num_signals, bench.motion.commanded, bench.arm);
  bench.start();
  bench.give(pose_target(0, {-90, 1, 9}));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_GT(bench.moves.size(), 3U);
}

TEST(ControllerTest, AHoldThatIsRefusedIsGivenAgain) {
  Bench bench;
  bench.num_holds_refused = 1;
  bench.start();
  bench.give(position_target(0, kFar));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_MOVING));
  bench.give(other_target(1, Target::KIND_HOLD));
  bench.run(5);
  EXPECT_EQ(bench.num_holds, 2);
  EXPECT_EQ(bench.controller.phase(), Phase::kHeld);
}

TEST(ControllerTest, APartThatIsOutsideTheWorkspaceMayComeBack) {
  ControllerConfig config = test_config();
  config.workspace.within = {Eigen::Vector3d(-3, -0.5, -3), Eigen::Vector3d(3, 3, 3)};
  Bench bench(config);
  bench.start();
  ASSERT_LT(bench.part_position().y(), -0.5);
  bench.give(position_target(0, kNear));
  EXPECT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  const std::size_t num_moves = bench.moves.size();
  bench.give(position_target(1, kFar));
  EXPECT_TRUE(bench.run_until_state(S::CONTROL_HOLDING)) << bench.status.why;
  EXPECT_TRUE(bench.has_why("the target is outside the workspace")) << bench.status.why;
  EXPECT_EQ(bench.moves.size(), num_moves);
}

TEST(WorkspaceTest, APartThatIsInABoxGoesNoDeeperAndIntoNoOther) {
  const BodySchema schema = planar();
  const auto at = [&](double degrees) { return Eigen::Vector3d(degrees, 0, 0); };
  const auto box_at = [&](double from, double to) {  // of part 4's way about the root
    Eigen::AlignedBox3d box;
    for (const double degrees : {from, to})
      box.extend(schema.predict(1, 4, at(degrees))->X_AB.translation());
    box.min().z() = -1;
    box.max().z() = 1;
    return box;
  };
  Workspace workspace;
  workspace.keep_out = {box_at(-10, 10), box_at(30, 50)};
  workspace.keep_out[0].extend(Eigen::Vector3d(2.2, 0, 0));
  EXPECT_EQ(workspace.objection(schema, at(20), at(25)), "");
  EXPECT_EQ(workspace.objection(schema, at(5), at(20)), "");
  EXPECT_NE(workspace.objection(schema, at(8), at(0)), "");
  EXPECT_NE(workspace.objection(schema, at(5), at(40)), "");
  EXPECT_NE(workspace.objection(schema, at(20), at(5)), "");
  EXPECT_NE(workspace.objection(schema.predict(1, 4, at(5))->X_AB.translation()), "");
  EXPECT_EQ(workspace.objection(schema.predict(1, 4, at(20))->X_AB.translation()), "");
}

// Nobody gets an arm unasked: a slip of the tongue does not set the babbler free.
TEST(ControllerTest, AnArmThatWasHeldStaysSoWhereATargetIsRefused) {
  for (const bool is_kept : {false, true}) {
    Bench bench;
    bench.start();
    bench.give(is_kept ? position_target(0, kNear) : other_target(0, Target::KIND_HOLD));
    ASSERT_TRUE(bench.run_until_state(is_kept ? S::CONTROL_REACHED : S::CONTROL_HOLDING));
    const std::size_t num_moves = bench.moves.size();
    Target wrong = position_target(1, kBeyond);
    for (const int part : {4, 7, 5, 1}) {
      wrong.target_id = 10 + part;
      wrong.target_part = part;
      bench.give(wrong);
      ASSERT_TRUE(bench.run_until_state(S::CONTROL_HOLDING)) << bench.status.why;
      EXPECT_TRUE(bench.has_why("the arm stays here")) << bench.status.why;
      EXPECT_EQ(bench.status.owns_arm, 1);
    }
    EXPECT_EQ(bench.moves.size(), num_moves);
  }
}

TEST(ControllerTest, TheWorkspaceIsRead) {
  const Workspace workspace = Workspace::load(Yaml::parse(
      "{lowest: [-1, -2, -3], highest: [1, 2, 3], keep_out: [{lowest: [0, 0, 0], highest: [1, 1, "
      "1]}]}"));
  EXPECT_EQ(workspace.within.min(), Eigen::Vector3d(-1, -2, -3));
  ASSERT_EQ(workspace.keep_out.size(), 1U);
  EXPECT_EQ(workspace.keep_out[0].max(), Eigen::Vector3d(1, 1, 1));
  EXPECT_THROW(Workspace::load(Yaml::parse("{lowest: [0, 0, 0], highest: [1, -1, 1]}")),
               ConfigError);
}

TEST(ControllerTest, ATargetThatIsNotReachedInTimeIsDroppedAndTheArmHeld) {
  for (const bool is_lent : {false, true}) {
    Bench bench;
    bench.observer_works = is_lent;  // else no SAMPLE comes
    if (is_lent) bench.schema.edges[1].state = EdgeState::kInvalid;
    bench.start();
    Target target = position_target(0, kFar);
    target.expiry_s = 4;
    bench.give(target);
    bench.run(3.5);
    EXPECT_EQ(bench.status.control_state, is_lent ? S::CONTROL_LENT : S::CONTROL_MOVING);
    bench.run(1);
    EXPECT_EQ(bench.status.control_state, is_lent ? S::CONTROL_REFUSED : S::CONTROL_HOLDING);
    EXPECT_TRUE(bench.has_why("not reached within 4 s")) << bench.status.why;
    EXPECT_EQ(bench.num_holds, is_lent ? 0 : 1);
  }
}

TEST(ControllerTest, ATargetThatWasReachedDoesNotExpire) {
  Bench bench;
  bench.start();
  Target target = position_target(0, kNear);
  target.expiry_s = 10;
  bench.give(target);
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  bench.run(20);
  EXPECT_EQ(bench.status.control_state, S::CONTROL_REACHED);
}

TEST(ControllerTest, ARepeatedTargetDoesNothingAndAnOlderOneIsIgnored) {
  Bench bench;
  bench.start();
  bench.give(position_target(5, kNear, 0));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_RELEASED));
  const std::size_t num_moves = bench.moves.size();
  Target older = position_target(9, kFar);
  older.epoch = 76;
  for (const Target& target : {position_target(5, kNear), position_target(4, kFar), older,
                               other_target(4, Target::KIND_HOLD)}) {
    bench.give(target);
    bench.run(2);
    EXPECT_EQ(bench.status.target_id, 5);
    EXPECT_EQ(bench.status.control_state, S::CONTROL_RELEASED);
    EXPECT_EQ(bench.moves.size(), num_moves);
  }
  EXPECT_EQ(bench.num_holds, 0);
  EXPECT_EQ(bench.controller.counters().at("older POSE_TARGET"), 3);
}

// One message, forged or from a machine whose clock is ahead, would else be the newest for ever.
TEST(ControllerTest, ATargetFromAClockAheadIsRefusedAndBlocksNoOther) {
  const std::int64_t kNow = 1'700'000'000 * kSecond;
  Bench bench;
  bench.start();
  for (const std::int64_t epoch :
       {std::numeric_limits<std::int64_t>::max(), kNow + 3'600 * kSecond, kNow + 4 * kSecond}) {
    Target ahead = position_target(0, kFar);
    ahead.epoch = epoch;
    bench.controller.on_pose_target(ahead, kNow);
  }
  EXPECT_EQ(bench.controller.status().control_state, S::CONTROL_IDLE);
  EXPECT_EQ(bench.controller.status().target_id, -1);
  EXPECT_EQ(bench.controller.counters().at("POSE_TARGET from a clock ahead"), 3);
  Target target = position_target(0, kNear);
  target.epoch = kNow - kSecond;
  bench.controller.on_pose_target(target, kNow);
  EXPECT_EQ(bench.controller.status().target_epoch, target.epoch);
  // Clocks need not agree better than the rest of the group asks.
  target.epoch = kNow + 2 * kSecond;
  bench.controller.on_pose_target(target, kNow);
  EXPECT_EQ(bench.controller.status().target_epoch, target.epoch);
}

TEST(ControllerTest, ANewerTargetTakesOverInTheMiddle) {
  Bench bench;
  bench.start();
  bench.give(position_target(0, kFar));
  ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
  Target newer = position_target(0, kNear);
  newer.epoch = 78;  // another sender, started later
  newer.sender = "planner";
  bench.give(newer);
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED));
  EXPECT_EQ(bench.status.sender, "planner");
  EXPECT_LT((bench.part_position() - kNear).norm(), 1e-4);
}

TEST(ControllerTest, ATargetThatComesWhileAnActionIsUnansweredWaitsForTheAnswer) {
  Bench bench;
  bench.start();
  bench.driver_serves = false;
  bench.give(position_target(0, kFar));
  ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
  bench.give(position_target(1, kNear));
  bench.run(0.5);
  EXPECT_EQ(bench.moves.size(), 1U);
  bench.driver_serves = true;
  bench.answer_last_move(motion_status_t::STATE_REJECTED, "no");
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_EQ(bench.status.target_id, 1);
  EXPECT_LT((bench.part_position() - kNear).norm(), 1e-4);
}

TEST(ControllerTest, HoldStaysUntilAnotherTarget) {
  Bench bench;
  bench.start();
  bench.give(other_target(0, Target::KIND_HOLD));
  EXPECT_EQ(bench.num_holds, 1);
  EXPECT_EQ(bench.status.control_state, S::CONTROL_HOLDING);
  EXPECT_EQ(bench.status.owns_arm, 1);
  EXPECT_TRUE(bench.has_why("operator"));
  bench.run(100);
  EXPECT_EQ(bench.num_holds, 1);  // it was answered
  EXPECT_EQ(bench.status.control_state, S::CONTROL_HOLDING);
  bench.give(position_target(1, kNear, 0));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_RELEASED)) << bench.status.why;
  bench.give(other_target(2, Target::KIND_HOLD));
  bench.give(other_target(3, Target::KIND_RELEASE));
  EXPECT_EQ(bench.status.control_state, S::CONTROL_RELEASED);
  EXPECT_EQ(bench.status.owns_arm, 0);
}

// As the console does when nobody follows the target any longer: of the same sender and epoch.
TEST(ControllerTest, AWithdrawnTargetMovesTheArmNoFartherButNotAnothersTarget) {
  Bench bench;
  bench.start();
  bench.give(position_target(0, kFar));
  ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
  bench.give(other_target(1, Target::KIND_HOLD));
  EXPECT_EQ(bench.status.control_state, S::CONTROL_HOLDING);
  bench.run(60);
  EXPECT_EQ(bench.moves.size(), 1U);
  EXPECT_EQ(bench.num_holds, 1);
  EXPECT_EQ(bench.status.control_state, S::CONTROL_HOLDING);
  Target planners = position_target(0, kNear);
  planners.epoch = 78;
  planners.sender = "planner";
  bench.give(planners);
  bench.give(other_target(2, Target::KIND_HOLD));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED));
  EXPECT_EQ(bench.status.sender, "planner");
}

TEST(ControllerTest, AHoldThatTheDriverDoesNotAnswerIsSentAgain) {
  Bench bench;
  bench.start();
  bench.driver_serves = false;
  bench.give(other_target(0, Target::KIND_HOLD));
  bench.run(5.05);
  EXPECT_EQ(bench.num_holds, 6);
  bench.driver_serves = true;
  bench.run(10);
  EXPECT_EQ(bench.num_holds, 6);
}

TEST(ControllerTest, ReleaseInTheMiddleGivesTheArmBack) {
  Bench bench;
  bench.start();
  bench.driver_serves = false;
  bench.give(position_target(0, kFar));
  ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
  bench.give(other_target(1, Target::KIND_RELEASE));
  bench.driver_serves = true;
  bench.run(10);
  EXPECT_EQ(bench.moves.size(), 1U);
  EXPECT_EQ(bench.status.owns_arm, 0);
  EXPECT_EQ(bench.status.control_state, S::CONTROL_RELEASED);
}

TEST(ControllerTest, ItsStatusIsToldOnChangeAndOnceASecond) {
  Controller controller(test_config());
  int num_told = 0;
  for (int i = 0; i < 100; ++i) num_told += controller.on_tick(i * kTick).status.has_value();
  EXPECT_EQ(num_told, 10);
}

TEST(ControllerTest, TheConfigurationIsReadInSiUnits) {
  const ControllerConfig config =
      ControllerConfig::load(std::string(BODYSCHEMA_CONFIG) + "/arm7/controller.yaml");
  EXPECT_EQ(config.signals.size(), 7U);
  EXPECT_EQ(config.resend_us, 1 * kSecond);
  EXPECT_EQ(config.max_marker_poses_silence_us, 2 * kSecond);
  EXPECT_LT(config.slow_step, config.max_step);
  EXPECT_NEAR(config.measurement.systematic.rotation_rad, 0.3 * kDegree, 1e-12);
}

}  // namespace
}  // namespace bodyschema::test
