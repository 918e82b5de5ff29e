// Class Observer: of which frames and actions it makes a sample, and what a sample holds.

#include <gtest/gtest.h>

#include <random>

#include "common/bus/check.h"
#include "tests/processes/observer/observer_bench.h"

namespace bodyschema::test {
namespace {

TEST(Observer, MakesOneSampleOfASettledActionAndItsFrames) {
  Observer observer = calibrated();
  Scene scene;
  EXPECT_FALSE(observer.on_motion_status(settled(4)));
  EXPECT_FALSE(observer.on_marker_poses(scene.frame(kRest_us + 10'000)));
  const auto sample = observer.on_marker_poses(scene.frame(kRest_us + 43'333));
  ASSERT_TRUE(sample);
  EXPECT_EQ(check(*sample), "");
  EXPECT_EQ(sample->utime, kRest_us + 43'333);
  EXPECT_EQ(sample->sample_index, 0);
  EXPECT_EQ(sample->calibration_id, 99);
  EXPECT_EQ(sample->source, "motor_babbler");
  EXPECT_EQ(sample->epoch, 77);
  EXPECT_EQ(sample->action_id, 4);
  EXPECT_EQ(sample->purpose, action_command_t::PURPOSE_TEST);
  EXPECT_EQ(sample->rest_begin_utime, kRest_us);
  EXPECT_EQ(sample->action, (std::vector<double>{0.1, 0.2}));
  ASSERT_EQ(sample->num_parts, 2);
  EXPECT_EQ(sample->parts[0].part_id, 1);
  EXPECT_EQ(sample->parts[0].num_tags, 3);
  EXPECT_EQ(sample->parts[0].num_frames, 2);
  EXPECT_EQ(sample->parts[0].has_rotation, 1);
  EXPECT_LT(position_error(*sample, 0, X_CB1()), 1e-6);
  EXPECT_EQ(sample->parts[1].part_id, 2);
  EXPECT_LT(position_error(*sample, 1, X_CB2()), 1e-6);
}

TEST(Observer, TheCornersCovarianceIsTheFramesMeanNotThatOfTheirMean) {
  Observer observer = calibrated();
  Scene scene;
  observer.on_motion_status(settled(4));
  marker_poses_t first = scene.frame(kRest_us + 10'000), second = scene.frame(kRest_us + 43'333);
  Matrix8d a = 0.01 * Matrix8d::Identity(), b = 0.03 * Matrix8d::Identity();
  a(0, 1) = a(1, 0) = 0.004;
  to_message(a, first.markers[0].corner_covariance);
  to_message(b, second.markers[0].corner_covariance);
  observer.on_marker_poses(first);
  const auto sample = observer.on_marker_poses(second);
  ASSERT_TRUE(sample);
  const tag_corners_t& tag = sample->parts[0].tags[0];
  ASSERT_EQ(tag.tag_id, first.markers[0].marker_id);
  EXPECT_TRUE(from_message(tag.corner_covariance).isApprox(0.5 * (a + b), 1e-6));
  EXPECT_EQ(check(*sample), "");
}

TEST(Observer, DoesNotCareWhichMessageArrivesFirst) {
  const auto bytes = [](const std::optional<sample_t>& sample) {
    std::vector<std::uint8_t> data(static_cast<std::size_t>(sample.value().getEncodedSize()));
    sample->encode(data.data(), 0, static_cast<int>(data.size()));
    return data;
  };
  Scene scene;
  scene.noise_px = 0.1;
  const marker_poses_t first = scene.frame(kRest_us), second = scene.frame(kRest_us + 33'333);
  Observer a = calibrated();
  a.on_motion_status(settled(0));
  a.on_marker_poses(first);
  const auto expected = bytes(a.on_marker_poses(second));
  Observer b = calibrated();
  b.on_marker_poses(second);
  b.on_marker_poses(first);
  EXPECT_EQ(bytes(b.on_motion_status(settled(0))), expected);
  Observer c(config(), markers(), 99);
  c.on_marker_poses(first);
  c.on_motion_status(settled(0));
  c.on_marker_poses(second);
  EXPECT_EQ(c.activity(), "waits for CAMERA_INFO");
  EXPECT_EQ(bytes(c.on_camera_info(camera())), expected);
}

TEST(Observer, IgnoresFramesAndStatusesThatAreRepeated) {
  Observer observer = calibrated();
  Scene scene;
  observer.on_motion_status(settled(0));
  EXPECT_FALSE(observer.on_marker_poses(scene.frame(kRest_us)));
  EXPECT_FALSE(observer.on_marker_poses(scene.frame(kRest_us)));
  EXPECT_TRUE(observer.on_marker_poses(scene.frame(kRest_us + 33'333)));
  EXPECT_FALSE(observer.on_motion_status(settled(0)));
  EXPECT_FALSE(observer.on_marker_poses(scene.frame(kRest_us)));
  EXPECT_FALSE(observer.on_marker_poses(scene.frame(kRest_us + 66'666)));
  EXPECT_EQ(observer.counters().at("frame seen before"), 2);
}

TEST(Observer, UsesNoFrameFromBeforeTheRestOrItsSettleMargin) {
  ObserverConfig c = config();
  c.settle_margin_us = 100'000;
  Observer observer = calibrated(c);
  Scene scene;
  observer.on_motion_status(settled(0));
  for (const std::int64_t t : {-1'000, 0, 99'999, 100'000}) {
    EXPECT_FALSE(observer.on_marker_poses(scene.frame(kRest_us + t)));
  }
  EXPECT_TRUE(observer.on_marker_poses(scene.frame(kRest_us + 133'333)));
}

TEST(Observer, UsesNoFrameFromAfterTheNextMotionBegan) {
  Observer observer = calibrated();
  Scene scene;
  observer.on_motion_status(settled(0));
  observer.on_marker_poses(scene.frame(kRest_us));
  EXPECT_FALSE(observer.on_motion_status(moving(1, kRest_us + 30'000 + 50'000)));
  EXPECT_FALSE(observer.on_marker_poses(scene.frame(kRest_us + 90'000)));
  // A frame from before it may still come.
  EXPECT_TRUE(observer.on_marker_poses(scene.frame(kRest_us + 33'333)));
}

TEST(Observer, MixesNoFramesOfTwoRestsOfOneAction) {
  // The driver reports a new rest when the arm was disturbed, the simulator after a fault.
  Observer observer = calibrated();
  Scene scene;
  observer.on_motion_status(settled(0));
  observer.on_marker_poses(scene.frame(kRest_us + 50'000));
  const std::int64_t anew = kRest_us + 1'000'000;
  EXPECT_FALSE(observer.on_motion_status(settled(0, anew)));
  EXPECT_FALSE(observer.on_marker_poses(scene.frame(kRest_us + 83'333)));
  EXPECT_FALSE(observer.on_marker_poses(scene.frame(anew + 50'000)));
  const auto sample = observer.on_marker_poses(scene.frame(anew + 83'333));
  ASSERT_TRUE(sample);
  EXPECT_EQ(sample->action_id, 0);
  EXPECT_EQ(sample->rest_begin_utime, anew);
  EXPECT_EQ(sample->parts.at(0).num_frames, 2);
  // Once an action has its sample, a later rest of it makes no second one.
  observer.on_motion_status(settled(0, anew + 1'000'000));
  observer.on_marker_poses(scene.frame(anew + 1'050'000));
  EXPECT_FALSE(observer.on_marker_poses(scene.frame(anew + 1'083'333)));
}

TEST(Observer, UsesNoFrameOfAMotionThatNoStatusTold) {
  Observer observer = calibrated();
  Scene scene;
  observer.on_motion_status(settled(0));  // at rest until 50 ms later, as far as is known
  observer.on_marker_poses(scene.frame(kRest_us + 10'000));
  EXPECT_FALSE(observer.on_motion_status(settled(1, kRest_us + 1'000'000)));
  EXPECT_FALSE(observer.on_marker_poses(scene.frame(kRest_us + 500'000)));
  const auto sample = observer.on_marker_poses(scene.frame(kRest_us + 40'000));
  ASSERT_TRUE(sample);
  EXPECT_EQ(sample->action_id, 0);
}

TEST(Observer, GivesUpAnActionWhoseFramesNeverCameWhenALaterOneIsSeen) {
  Observer observer = calibrated();
  Scene scene;
  observer.on_motion_status(settled(0));
  observer.on_motion_status(moving(1, kRest_us + 60'000));
  observer.on_motion_status(settled(1, kRest_us + 1'000'000));
  observer.on_marker_poses(scene.frame(kRest_us + 1'000'000));
  const auto sample = observer.on_marker_poses(scene.frame(kRest_us + 1'033'333));
  ASSERT_TRUE(sample);
  EXPECT_EQ(sample->action_id, 1);
  EXPECT_EQ(sample->sample_index, 0);
  EXPECT_EQ(observer.counters().at("action never seen"), 1);
}

TEST(Observer, MakesNoSampleOfWhatIsNotASettledMove) {
  Observer observer = calibrated();
  Scene scene;
  observer.on_marker_poses(scene.frame(kRest_us));
  observer.on_marker_poses(scene.frame(kRest_us + 33'333));
  motion_status_t hold = settled(0);
  hold.kind = action_command_t::KIND_HOLD;
  EXPECT_FALSE(observer.on_motion_status(hold));
  for (const std::int8_t state : {motion_status_t::STATE_IDLE, motion_status_t::STATE_ACCEPTED,
                                  motion_status_t::STATE_REJECTED, motion_status_t::STATE_STOPPED,
                                  motion_status_t::STATE_EXPIRED}) {
    EXPECT_FALSE(observer.on_motion_status(status(1, state, kRest_us + 50'000, kRest_us)));
  }
}

TEST(Observer, StaysWithAnActionWhileARejectedOneDoesNotMoveTheArm) {
  Observer observer = calibrated();
  Scene scene;
  observer.on_motion_status(settled(0));
  observer.on_motion_status(
      status(1, motion_status_t::STATE_REJECTED, kRest_us + 60'000, kRest_us));
  observer.on_marker_poses(scene.frame(kRest_us));
  const auto sample = observer.on_marker_poses(scene.frame(kRest_us + 33'333));
  ASSERT_TRUE(sample);
  EXPECT_EQ(sample->action_id, 0);
}

TEST(Observer, MakesASampleWithoutPartsWhereNothingIsSeen) {
  Observer observer = calibrated();
  Scene scene;
  scene.tags = {};
  observer.on_motion_status(settled(0));
  observer.on_marker_poses(scene.frame(kRest_us));
  const auto sample = observer.on_marker_poses(scene.frame(kRest_us + 33'333));
  ASSERT_TRUE(sample);
  EXPECT_EQ(sample->num_parts, 0);
}

TEST(Observer, TargetTagsAreNothingToIt) {
  Markers with_target = markers();
  with_target.target_tags = {{40, 0.08}};
  Observer without = calibrated(), with(config(), with_target, 99);
  with.on_camera_info(camera());
  std::optional<sample_t> samples[2];
  int n = 0;
  for (Observer* observer : {&without, &with}) {
    Scene scene;
    observer->on_motion_status(settled(0));
    for (const std::int64_t utime : {kRest_us, kRest_us + 33'333}) {
      marker_poses_t frame = scene.frame(utime);
      if (observer == &with) {
        std::vector<marker_pose_t> seen = frame.markers;
        Pose X_CM = X_CB2();
        X_CM.translation().x() += utime == kRest_us ? 0.2 : 0.3;  // it may move
        std::mt19937 random(1);
        seen.push_back(sight_of(40, X_CM, 0, random));
        set_array(frame.num_markers, frame.markers, std::move(seen));
      }
      samples[n] = observer->on_marker_poses(frame);
    }
    ++n;
  }
  ASSERT_TRUE(samples[0] && samples[1]);
  const auto bytes = [](const sample_t& sample) {
    std::vector<std::uint8_t> result(sample.getEncodedSize());
    sample.encode(result.data(), 0, static_cast<int>(result.size()));
    return result;
  };
  EXPECT_EQ(bytes(*samples[0]), bytes(*samples[1]));
  EXPECT_EQ(without.counters(), with.counters());
}

TEST(Observer, LeavesOutATagThatMovedBetweenTheFrames) {
  Observer observer = calibrated();
  Scene scene;
  observer.on_motion_status(settled(0));
  observer.on_marker_poses(scene.frame(kRest_us));
  scene.X_CB1_true.translation().x() += 0.002;  // 2.6 px
  const auto sample = observer.on_marker_poses(scene.frame(kRest_us + 33'333));
  ASSERT_TRUE(sample);
  ASSERT_EQ(sample->num_parts, 1);
  EXPECT_EQ(sample->parts[0].part_id, 2);
  EXPECT_EQ(observer.counters().at("tag moved between frames"), 3);
}

TEST(Observer, CountsTheFramesInWhichAPartWasSeenAndNeverSharpensItsCovarianceByThem) {
  Scene both, once;
  Observer a = calibrated(), b = calibrated();
  for (Observer* observer : {&a, &b}) observer->on_motion_status(settled(0));
  a.on_marker_poses(both.frame(kRest_us));
  const auto twice = a.on_marker_poses(both.frame(kRest_us + 33'333)).value();
  b.on_marker_poses(once.frame(kRest_us));
  once.tags = {};
  const auto single = b.on_marker_poses(once.frame(kRest_us + 33'333)).value();
  ASSERT_EQ(single.num_parts, 2);
  EXPECT_EQ(single.parts[0].num_frames, 1);
  EXPECT_EQ(twice.parts[0].num_frames, 2);
  const auto variances = [](const sample_t& sample) -> Vector6d {
    return from_message(sample.parts[0].covariance).diagonal();
  };
  const Vector6d ratios = variances(single).cwiseQuotient(variances(twice));
  EXPECT_TRUE(ratios.isApprox(Vector6d::Ones(), 1e-6)) << ratios.transpose();
}

TEST(ObserverConfig, OfEveryShippedRigIsReadable) {
  for (const char* rig : {"arm2", "arm4", "arm6_ends", "arm7"}) {
    EXPECT_NO_THROW(
        ObserverConfig::load(std::filesystem::path(BODYSCHEMA_CONFIG) / rig / "observer.yaml"));
  }
}

}  // namespace
}  // namespace bodyschema::test
