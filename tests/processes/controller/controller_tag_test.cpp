// Class Controller: a tag as target.

#include <gtest/gtest.h>

#include "tests/processes/controller/controller_bench.h"

namespace bodyschema::test {
namespace {

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

TEST(ControllerTest, ATagThatStaysLostEndsTheTargetAndTheArmStaysHeld) {
  Bench bench = bench_with_tag(kFar);
  bench.give(tag_target(0));
  ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
  bench.p_RM_of_tag.clear();
  ASSERT_TRUE(bench.run_until([&] { return bench.num_holds == 1; }));
  ASSERT_TRUE(bench.run_until_state(S::CONTROL_HOLDING)) << bench.status.why;
  bench.run(5);
  EXPECT_EQ(bench.num_holds, 2);
  EXPECT_EQ(bench.status.owns_arm, 1);
  EXPECT_TRUE(bench.has_why("given up")) << bench.status.why;
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

TEST(ControllerTest, APartThatIsNearEnoughGoesNoFartherWhereItsTagIsLost) {
  Bench bench = bench_with_tag(kFar);
  Target target = tag_target(0);
  target.tolerance_m = 1.5;
  bench.give(target);
  ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
  bench.p_RM_of_tag.clear();
  bench.run(5);
  EXPECT_EQ(bench.moves.size(), 1U);
  EXPECT_EQ(bench.status.control_state, S::CONTROL_REACHED) << bench.status.why;
}

TEST(ControllerTest, ByAnInvalidEdgeNoPartIsNearATagThatIsLost) {
  ControllerConfig config = test_config();
  config.max_searches = 3;
  Bench bench = bench_with_tag(kFar, config);
  Target target = tag_target(0);
  target.tolerance_m = 1.5;
  bench.give(target);
  ASSERT_TRUE(bench.run_until([&] { return bench.moves.size() == 1; }));
  bench.p_RM_of_tag.clear();
  bench.health = health_of(1, 2, 3, schema_edge_t::EDGE_INVALID);
  bench.repeat();
  bench.run(5);
  EXPECT_EQ(bench.moves.size(), 1U);
  EXPECT_EQ(bench.num_holds, 1);
  EXPECT_EQ(bench.status.control_state, S::CONTROL_WAITING) << bench.status.why;
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

}  // namespace
}  // namespace bodyschema::test
