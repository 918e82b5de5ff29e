#include "processes/controller/controller.h"

#include <gtest/gtest.h>
#include <unistd.h>

#include <fstream>
#include <functional>
#include <limits>
#include <optional>
#include <random>
#include <set>

#include "common/bus/convert.h"
#include "common/config/yaml.h"
#include "common/geometry/angle.h"
#include "tests/processes/controller/controller_bench.h"

namespace bodyschema::test {
namespace {

// ---- a target's life

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

/// Where the arm's last link is at an action, as a target.
Target pose_target(std::int64_t id, const Eigen::Vector3d& action) {
  const Pose X_RB = planar().predict(1, 4, action)->X_AB;
  Target target = position_target(id, X_RB.translation());
  target.target_kind = Target::KIND_POSE;
  const Eigen::Quaterniond q(X_RB.linear());
  const double wxyz[] = {q.w(), q.x(), q.y(), q.z()};
  std::copy(std::begin(wxyz), std::end(wxyz), target.orientation_wxyz);
  return target;
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

// ---- a tag as target

TEST(ControllerTest, ATagIsReachedWhereItIsSeen) {
  Bench bench = bench_with_tag(kFar);
  bench.give(tag_target(0));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_LT((bench.part_position() - kFar).norm(), 1e-4);
  EXPECT_LT((Eigen::Vector3d(bench.status.target_position_m) - kFar).norm(), 1e-9);
  EXPECT_EQ(bench.num_holds, 0);
  // It is not followed, but given again.
  const std::size_t num_moves = bench.moves.size();
  bench.put_tag(40, kNear);
  bench.run(5);
  EXPECT_EQ(bench.status.control_state, S::CONTROL_REACHED);
  EXPECT_EQ(bench.moves.size(), num_moves);
  bench.give(tag_target(1));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_LT((bench.part_position() - kNear).norm(), 1e-4);
}

TEST(ControllerTest, TheMeanOfTheFramesIsTheTagsPlace) {
  Bench bench(test_config());
  bench.num_frames = TagTrack::kFrames;
  bench.p_RM_of_tag[40] = kFar;
  bench.tag_jitter_m = 0.002;
  bench.start();
  bench.give(tag_target(0));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_LT((bench.part_position() - kFar - Eigen::Vector3d(0.001, 0, 0)).norm(), 1e-4);
}

TEST(ControllerTest, ATagIsSeenFromWhereTheCameraIsNow) {
  Bench bench(test_config());
  bench.num_frames = TagTrack::kFrames;
  bench.p_RM_of_tag[40] = kFar;
  bench.X_CC_moved.translation() = Eigen::Vector3d(0.05, 0, 0);
  bench.start();
  bench.settle("motor_babbler", 1, 0, bench.arm);
  bench.give(tag_target(0));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_LT((bench.part_position() - kFar).norm(), 1e-4);
}

TEST(ControllerTest, ATagThatIsNoTargetIsRefused) {
  Bench bench = bench_with_tag(kFar);
  bench.give(tag_target(0, 7));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REFUSED));
  EXPECT_TRUE(bench.has_why("tag 7 is not in target_tags of markers.yaml: 40, 41"))
      << bench.status.why;
  ControllerConfig config = test_config();
  config.target_tags.clear();
  Bench without = bench_with_tag(kFar, config);
  without.give(tag_target(0));
  ASSERT_TRUE(without.run_until_state(S::CONTROL_REFUSED));
  EXPECT_TRUE(without.has_why("which has none")) << without.status.why;
}

TEST(ControllerTest, ATagThatIsNotSeenMovesNothingAndIsGivenUpInTheEnd) {
  Bench bench = bench_with_tag(kFar);
  bench.give(tag_target(0, 41));
  bench.run(10);
  EXPECT_EQ(bench.status.control_state, S::CONTROL_WAITING);
  EXPECT_TRUE(bench.has_why("target tag 41 is not seen: the arm holds until 2 frames"))
      << bench.status.why;
  EXPECT_TRUE(bench.run_until_state(S::CONTROL_REFUSED));
  EXPECT_TRUE(bench.has_why("given up after 20 s: target tag 41 is not seen")) << bench.status.why;
  EXPECT_TRUE(bench.moves.empty());
}

TEST(ControllerTest, ATagThatIsSeenInOneFrameAloneIsNotATarget) {
  Bench bench(test_config());
  bench.num_frames = 1;
  bench.p_RM_of_tag[40] = kFar;
  bench.start();
  bench.give(tag_target(0));
  bench.run(5);
  EXPECT_TRUE(bench.moves.empty());
  EXPECT_TRUE(bench.has_why("is seen in 1 frame")) << bench.status.why;
  bench.put_tag(40, kFar);  // another rest, another mean
  bench.run(5);
  EXPECT_TRUE(bench.moves.empty());
}

TEST(ControllerTest, ATagThatIsLostOnTheWayMakesItHoldUntilItIsSeenAgain) {
  Bench bench = bench_with_tag(kFar);
  bench.give(tag_target(0));
  ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
  bench.p_RM_of_tag.clear();
  bench.run(5);
  EXPECT_EQ(bench.moves.size(), 1U);
  EXPECT_EQ(bench.num_holds, 1);
  EXPECT_EQ(bench.status.control_state, S::CONTROL_WAITING);
  EXPECT_EQ(bench.status.owns_arm, 1);
  EXPECT_TRUE(bench.has_why("target tag 40 is not seen: the arm holds")) << bench.status.why;
  bench.put_tag(40, kNear);
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_LT((bench.part_position() - kNear).norm(), 1e-4);
  EXPECT_EQ(bench.num_holds, 1);
}

TEST(ControllerTest, AnArmThatWasGivenBackIsNotHeldAnyMoreForATagThatWasLost) {
  Bench bench = bench_with_tag(kFar);
  bench.give(tag_target(0));
  ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
  bench.p_RM_of_tag.clear();
  ASSERT_TRUE(bench.run_until([&] { return bench.num_holds == 1; }));
  bench.driver_serves = false;  // its HOLD is never answered
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REFUSED)) << bench.status.why;
  bench.run(5);
  EXPECT_EQ(bench.num_holds, 1);
}

TEST(ControllerTest, ATagThatJumpsOnTheWayMakesItHoldAndIsServedAnewAtItsNewPlace) {
  Bench bench = bench_with_tag(kFar);
  bench.give(tag_target(0));
  ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
  bench.num_frames = 1;  // so that it waits for another rest
  bench.p_RM_of_tag[40] = kNear;
  bench.run(5);
  EXPECT_EQ(bench.moves.size(), 1U);
  EXPECT_EQ(bench.num_holds, 1);
  EXPECT_TRUE(bench.has_why("target tag 40 moved by ")) << bench.status.why;
  bench.num_frames = TagTrack::kFrames;
  bench.put_tag(40, kNear);
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_LT((bench.part_position() - kNear).norm(), 1e-4);
}

TEST(ControllerTest, ATagThatJumpsWhileItsMoveIsUnderWayHoldsToo) {
  Bench bench = bench_with_tag(kFar);
  bench.give(tag_target(0));
  ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
  bench.p_RM_of_tag[40] = kNear;  // both frames of the next rest show it there
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_EQ(bench.num_holds, 1);
  EXPECT_LT((bench.part_position() - kNear).norm(), 1e-4);
}

TEST(ControllerTest, APartThatHasComeToItsTagMayCoverIt) {
  Bench bench = bench_with_tag(kFar);
  bench.covers_tags = true;
  bench.give(tag_target(0));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  EXPECT_LT((bench.part_position() - kFar).norm(), 1e-4);
  bench.put_tag(40, std::nullopt);
  bench.run(5);
  EXPECT_EQ(bench.status.control_state, S::CONTROL_REACHED);
  EXPECT_EQ(bench.num_holds, 0);
}

TEST(ControllerTest, ATagsTargetExpiresAndFallsSilentAsAnyOther) {
  Bench bench = bench_with_tag(kFar);
  Target target = tag_target(0, 41);
  target.expiry_s = 4;
  bench.give(target);
  bench.run(3);
  EXPECT_EQ(bench.status.control_state, S::CONTROL_WAITING);
  bench.run(2);
  EXPECT_EQ(bench.status.control_state, S::CONTROL_HOLDING);
  EXPECT_TRUE(bench.has_why("not reached within 4 s; target tag 41 is not seen"))
      << bench.status.why;
  EXPECT_TRUE(bench.moves.empty());
  bench.give(tag_target(1));
  bench.driver_speaks = false;
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_HOLDING));
  EXPECT_TRUE(bench.has_why("no MOTION_STATUS")) << bench.status.why;
}

TEST(ControllerTest, ATagOutOfReachIsRefused) {
  Bench bench = bench_with_tag(kBeyond);
  bench.give(tag_target(0));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REFUSED));
  EXPECT_TRUE(bench.has_why("out of reach")) << bench.status.why;
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
  for (const bool is_walled : {false, true}) {
    if (is_walled)
      config.workspace.keep_out = {{Eigen::Vector3d(2, -0.3, -1), Eigen::Vector3d(3, 0.3, 1)}};
    Bench bench(config);
    bench.schema.signals = config.signals;
    bench.arm = {-30, 0, 0};
    set_array(bench.motion.num_signals, bench.motion.commanded, bench.arm);
    bench.start();
    bench.give(position_target(0, swing(30)));
    ASSERT_TRUE(bench.run_until_state(is_walled ? S::CONTROL_REFUSED : S::CONTROL_REACHED))
        << bench.status.why;
    if (is_walled) {
      EXPECT_TRUE(bench.has_why("part 4 would leave the workspace")) << bench.status.why;
    }
    // On this side of it the arm may move.
    bench.give(position_target(1, swing(-20)));
    EXPECT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  }
}

TEST(ControllerTest, APartThatIsOutsideTheWorkspaceMayComeBack) {
  ControllerConfig config = test_config();
  config.workspace.within = {Eigen::Vector3d(-3, -0.5, -3), Eigen::Vector3d(3, 3, 3)};
  Bench bench(config);
  bench.start();
  ASSERT_LT(bench.part_position().y(), -0.5);
  bench.give(position_target(0, kNear));
  EXPECT_TRUE(bench.run_until_state(S::CONTROL_REACHED)) << bench.status.why;
  bench.give(position_target(1, kFar));
  EXPECT_TRUE(bench.run_until_state(S::CONTROL_REFUSED)) << bench.status.why;
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

TEST(ControllerTest, AHoldThatTheDriverDoesNotAnswerIsSentAgainWithTheSameId) {
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

// ---- start guard

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
    EXPECT_EQ(bench.controller.counters().count("driver began anew"), 0U);
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

// ---- silence

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

// ---- stop, hold and restarts of others

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

// ---- the schema changes

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

TEST(ControllerTest, APartThatIsLostInTheMiddleEndsTheTarget) {
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
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_REFUSED));
  EXPECT_LE(bench.moves.size(), 2U);
  EXPECT_EQ(bench.status.owns_arm, 0);
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

// ---- restarts of its own

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
  EXPECT_EQ(other.counters().count("POSE_TARGET from a clock ahead"), 0U);
  std::filesystem::remove(state_file());
}

TEST(ControllerTest, AStateFileOfSomethingElseIsRefused) {
  std::ofstream(state_file()) << "epoch: 1\nnext_action_id: -3\n";
  EXPECT_THROW(Controller(test_config()).restore(state_file()), ConfigError);
  std::filesystem::remove(state_file());
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

// Anything in any order: Bench asserts that every message makes sense, that nothing moves an arm
// that is not the controller's or for a target that is over, that ids are new and steps small, and
// that no target is served while the driver or the monitor is silent.
TEST(ControllerTest, WhateverHappensItsCommandsAreLawful) {
  std::mt19937_64 rng(8);
  std::size_t num_moves = 0, num_holds = 0;
  std::set<std::int8_t> states;
  const char* wanted = std::getenv("BODYSCHEMA_SEQUENCES");
  const int num_sequences = wanted ? std::atoi(wanted) : 400;
  for (int run = 0; run < num_sequences && !testing::Test::HasFatalFailure(); ++run) {
    ControllerConfig config = test_config();
    config.max_searches = run % 2 ? 5 : 0;
    Bench bench(config);
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
        case 1:
          bench.give(rng() % 4 == 0 ? pose_target(target_id++, {40, -0.5, 6})
                                    : position_target(target_id++,
                                                      rng() % 3   ? kFar
                                                      : rng() % 2 ? kNear
                                                                  : kBeyond,
                                                      rng() % 2 ? -1 : 1));
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
      states.insert(bench.status.control_state);
    }
    num_moves += bench.moves.size();
    num_holds += bench.num_holds;
  }
  EXPECT_GT(num_moves, 200U);
  EXPECT_GT(num_holds, 300U);
  EXPECT_EQ(states.size(), 8U) << "every state was there";
}

}  // namespace
}  // namespace bodyschema::test
