#include "processes/console/target_follower.h"

#include <gtest/gtest.h>

#include <nlohmann/json.hpp>

#include "common/bus/check.h"

namespace bodyschema {
namespace {

using S = control_status_t;
using End = TargetFollower::End;

constexpr std::int64_t kSecond = 1'000'000;

pose_target_t target(std::int8_t kind = pose_target_t::KIND_POSITION) {
  pose_target_t target{};
  target.sender = "console";
  target.epoch = 50;
  target.target_id = 0;
  target.target_kind = kind;
  target.target_part = kind == pose_target_t::KIND_POSITION ? 4 : -1;
  target.keep_s = -1;
  return target;
}

control_status_t status(std::int8_t state, std::int64_t epoch = 50, std::int64_t id = 0) {
  control_status_t status{};
  status.sender = "console";
  status.target_epoch = epoch;
  status.target_id = id;
  status.control_state = state;
  status.why = "because";
  status.predicted_error_m = 0.001;
  status.observed_error_m = -1;
  status.predicted_error_rad = status.observed_error_rad = -1;
  return status;
}

process_info_t info(const std::string& name) {
  process_info_t info{};
  info.process_name = name;
  return info;
}

TEST(OperateTest, ATargetIsRepeatedUntilItIsAcknowledged) {
  TargetFollower follower(target(), 60 * kSecond);
  ASSERT_TRUE(follower.on_tick(0));
  EXPECT_EQ(check(*TargetFollower(target(), 1).on_tick(0)), "");
  EXPECT_FALSE(follower.on_tick(kSecond / 2));
  EXPECT_TRUE(follower.on_tick(kSecond));
  follower.on_control_status(status(S::CONTROL_IDLE, 0, -1));
  EXPECT_TRUE(follower.on_tick(2 * kSecond));
  follower.on_control_status(status(S::CONTROL_WAITING));
  EXPECT_TRUE(follower.is_acknowledged());
  EXPECT_FALSE(follower.on_tick(4 * kSecond));
  // The controller was killed and knows nothing of it any more.
  follower.on_control_status(status(S::CONTROL_IDLE, 0, -1));
  EXPECT_TRUE(follower.on_tick(6 * kSecond));
  EXPECT_EQ(follower.end(), End::kOpen);
}

TEST(OperateTest, DistancesThatAreNotKnownAreNotTold) {
  control_status_t told = status(S::CONTROL_REACHED);
  told.num_moves = 1;
  EXPECT_EQ(course_text(told), "1 move, by the schema 1.0 mm away");
  told.observed_error_m = 0.0024;
  EXPECT_EQ(course_text(told), "1 move, by the schema 1.0 mm away, as seen 2.4 mm");
  told.predicted_error_m = told.observed_error_m = -1;
  EXPECT_EQ(course_text(told), "1 move");
  told.num_probes = 1;
  told.predicted_error_m = 0.0002;
  told.predicted_error_rad = 0.1 * kDegree;
  EXPECT_EQ(course_text(told), "1 move, 1 probe among them, by the schema 0.2 mm and 0.10° away");
}

TEST(OperateTest, APartThatIsSeenTurnedAwayIsMissed) {
  for (const bool is_turned : {false, true}) {
    TargetFollower follower(target(), 60 * kSecond, {.m = 0.02, .rad = 5 * kDegree});
    follower.on_tick(0);
    control_status_t reached = status(S::CONTROL_REACHED);
    reached.observed_error_m = 0.001;
    reached.observed_error_rad = (is_turned ? 5.1 : 4.9) * kDegree;
    follower.on_control_status(reached);
    EXPECT_EQ(follower.end(), is_turned ? End::kMissed : End::kAsked);
  }
}

TEST(OperateTest, ATargetThatIsSeenElsewhereIsMissed) {
  for (const bool is_far : {false, true}) {
    TargetFollower follower(target(), 60 * kSecond, {.m = 0.02});
    follower.on_tick(0);
    control_status_t reached = status(S::CONTROL_REACHED);
    reached.observed_error_m = is_far ? 0.021 : 0.019;
    follower.on_control_status(reached);
    EXPECT_EQ(follower.end(), is_far ? End::kMissed : End::kAsked);
  }
}

TEST(OperateTest, WhatATargetEndsWith) {
  const struct {
    std::int8_t kind, state;
    End end;
  } cases[] = {{pose_target_t::KIND_POSITION, S::CONTROL_WAITING, End::kOpen},
               {pose_target_t::KIND_POSITION, S::CONTROL_MOVING, End::kOpen},
               {pose_target_t::KIND_POSITION, S::CONTROL_LENT, End::kOpen},
               {pose_target_t::KIND_POSITION, S::CONTROL_REACHED, End::kAsked},
               {pose_target_t::KIND_POSITION, S::CONTROL_RELEASED, End::kAsked},
               {pose_target_t::KIND_POSITION, S::CONTROL_REFUSED, End::kRefused},
               {pose_target_t::KIND_POSITION, S::CONTROL_HOLDING, End::kRefused},
               {pose_target_t::KIND_HOLD, S::CONTROL_HOLDING, End::kAsked},
               {pose_target_t::KIND_RELEASE, S::CONTROL_RELEASED, End::kAsked}};
  for (const auto& c : cases) {
    TargetFollower follower(target(c.kind), 60 * kSecond);
    follower.on_tick(0);
    follower.on_control_status(status(c.state));
    EXPECT_EQ(follower.end(), c.end) << int{c.kind} << " " << int{c.state};
    EXPECT_EQ(follower.status().why, "because");
  }
}

TEST(OperateTest, ANewerTargetEndsIt) {
  TargetFollower follower(target(), 60 * kSecond);
  follower.on_tick(0);
  follower.on_control_status(status(S::CONTROL_REACHED, 50, 1));
  EXPECT_EQ(follower.end(), End::kRefused);
  EXPECT_NE(follower.status().why.find("another target"), std::string::npos);
}

TEST(OperateTest, AfterATimeoutItSaysWhoIsSilent) {
  TargetFollower follower(target(), 5 * kSecond);
  follower.on_tick(0);
  follower.on_tick(4 * kSecond);
  for (const char* name : {"camera", "marker_estimator", "observer", "model_monitor"})
    follower.on_process_info(info(name));
  follower.on_motion_status(motion_status_t{});
  EXPECT_FALSE(follower.on_tick(5 * kSecond));
  EXPECT_EQ(follower.end(), End::kTimedOut);
  EXPECT_EQ(follower.diagnosis(), "silent: controller");
  follower.on_process_info(info("controller"));
  EXPECT_EQ(follower.diagnosis(), "the controller does not acknowledge the target");
}

TEST(OperateTest, ATimeoutWithinWhichNobodyNeedsToSpeakBlamesNobody) {
  TargetFollower follower(target(), kSecond / 2);
  follower.on_tick(0);
  follower.on_tick(kSecond / 2);
  EXPECT_EQ(follower.end(), End::kTimedOut);
  EXPECT_EQ(follower.diagnosis(), "too soon to tell who is silent");
}

TEST(OperateTest, ATargetThatNobodyFollowsIsWithdrawn) {
  // Never acknowledged: it may wait in the controller's queue.
  TargetFollower follower(target(), 5 * kSecond);
  follower.on_tick(0);
  const auto expect = [&](std::int8_t kind) {
    const pose_target_t withdrawal = follower.withdrawal();
    EXPECT_EQ(check(withdrawal), "");
    EXPECT_EQ(withdrawal.target_kind, kind);
    EXPECT_EQ(withdrawal.sender, "console");
    // Newer than its own target, older than whatever another sender gives.
    EXPECT_EQ(withdrawal.epoch, 50);
    EXPECT_EQ(withdrawal.target_id, 1);
  };
  expect(pose_target_t::KIND_HOLD);
  control_status_t moving = status(S::CONTROL_MOVING);
  moving.owns_arm = 1;
  follower.on_control_status(moving);
  follower.on_tick(5 * kSecond);
  EXPECT_EQ(follower.end(), End::kTimedOut);
  expect(pose_target_t::KIND_HOLD);
  // An arm that was the babbler's stays its own, one that was lent to it does not.
  TargetFollower lent(target(), 5 * kSecond);
  lent.on_tick(0);
  lent.on_control_status(status(S::CONTROL_LENT));
  EXPECT_EQ(lent.withdrawal().target_kind, pose_target_t::KIND_RELEASE);
  TargetFollower taken(target(), 5 * kSecond);
  taken.on_tick(0);
  taken.on_control_status(moving);
  taken.on_control_status(status(S::CONTROL_LENT));
  EXPECT_EQ(taken.withdrawal().target_kind, pose_target_t::KIND_HOLD);
}

TEST(OperateTest, AnInterruptEndsWhatIsOpenOnly) {
  TargetFollower follower(target(), 5 * kSecond);
  follower.on_tick(0);
  follower.interrupt();
  EXPECT_EQ(follower.end(), End::kInterrupted);
  EXPECT_FALSE(follower.on_tick(kSecond));
  EXPECT_EQ(target_json(status(S::CONTROL_MOVING), End::kInterrupted)["state"], "interrupted");
  TargetFollower reached(target(), 5 * kSecond);
  reached.on_tick(0);
  reached.on_control_status(status(S::CONTROL_REACHED));
  reached.interrupt();
  EXPECT_EQ(reached.end(), End::kAsked);
}

TEST(OperateTest, TheResultAsJsonHasNullForWhatIsUnknown) {
  const auto json = target_json(status(S::CONTROL_REACHED), End::kAsked);
  EXPECT_EQ(json["reached"], true);
  EXPECT_EQ(json["state"], "reached");
  EXPECT_EQ(json["predicted_error_m"], 0.001);
  EXPECT_TRUE(json["observed_error_m"].is_null());
  EXPECT_EQ(target_json(status(S::CONTROL_MOVING), End::kTimedOut)["state"], "timed out");
}

TEST(OperateTest, HaltAndResumeAreRepeatedUntilTheDriverSaysSo) {
  for (const bool halt : {true, false}) {
    LatchFollower follower(halt ? action_command_t::KIND_STOP : action_command_t::KIND_RESUME, 50);
    const auto command = follower.on_tick(0);
    ASSERT_TRUE(command);  // at once, whatever was heard
    EXPECT_EQ(check(*command), "");
    motion_status_t motion{};
    motion.stop_latched = halt ? 0 : 1;
    follower.on_motion_status(motion);
    EXPECT_FALSE(follower.is_done());
    EXPECT_FALSE(follower.on_tick(kSecond / 10));
    const auto again = follower.on_tick(kSecond / 2);
    ASSERT_TRUE(again);
    EXPECT_EQ(again->action_id, command->action_id);  // the driver serves it once
    motion.stop_latched = halt ? 1 : 0;
    follower.on_motion_status(motion);
    EXPECT_TRUE(follower.is_done());
    EXPECT_FALSE(follower.on_tick(kSecond));
  }
}

}  // namespace
}  // namespace bodyschema
