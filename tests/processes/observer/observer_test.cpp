#include "processes/observer/observer.h"

#include <gtest/gtest.h>

#include <random>

#include "bodyschema/action_command_t.hpp"
#include "common/bus/check.h"
#include "common/bus/convert.h"
#include "common/geometry/angle.h"
#include "processes/marker_estimator/tag_pose.h"

namespace bodyschema {
namespace {

constexpr std::int64_t kRest_us = 2'000'000;

camera_info_t camera() {
  camera_info_t info{};
  info.camera_name = "test";
  info.image_width = 1280;
  info.image_height = 960;
  info.fx = info.fy = 1159;
  info.cx = 640;
  info.cy = 480;
  return info;
}

ObserverConfig config() {
  ObserverConfig config;
  config.frames_per_sample = 2;
  config.max_buffered_frames = 8;
  config.max_motion_px = 1;
  config.part_pose.max_tag_error_px = 1.5;
  config.part_pose.min_other_rotation_rad = 2 * kDegree;
  config.part_pose.max_error_ratio = 10;
  return config;
}

/// Part 1 carries tags 1 and 2 at a right angle and 3 beside 1; part 2 one tag of unknown
/// placement.
Markers markers() {
  Markers markers;
  markers.family = "tag36h11";
  Pose X_BM2 = Pose::Identity();
  X_BM2.linear() = exp_so3(Eigen::Vector3d(0, -M_PI / 2, 0));
  X_BM2.translation() = Eigen::Vector3d(0.05, 0, 0.05);
  Pose X_BM3 = Pose::Identity();
  X_BM3.translation() = Eigen::Vector3d(-0.1, 0, 0);
  markers.tags = {{1, 0.08, 1, Pose::Identity()},
                  {2, 0.08, 1, X_BM2},
                  {3, 0.08, 1, X_BM3},
                  {5, 0.08, 2, std::nullopt}};
  return markers;
}

/// Part 1 so that tags 1, 2 and 3 are seen at less than 60°.
Pose X_CB1() {
  Pose X = Pose::Identity();
  X.linear() = exp_so3(Eigen::Vector3d(0.3, 0, 0)) * exp_so3(Eigen::Vector3d(0, 0.75, 0));
  X.translation() = Eigen::Vector3d(0.05, -0.03, 0.9);
  return X;
}

Pose X_CB2() {
  Pose X = Pose::Identity();
  X.linear() = exp_so3(Eigen::Vector3d(0, 0.6, 0.2));
  X.translation() = Eigen::Vector3d(-0.2, 0.1, 1.1);
  return X;
}

marker_pose_t sight_of(int id, const Pose& X_CM, double noise_px, std::mt19937& random) {
  const Lens lens(camera());
  std::normal_distribution<double> noise(0, 1);
  marker_pose_t marker{};
  marker.marker_id = id;
  marker.size_m = 0.08;
  std::vector<ImagePoint> points;
  const auto corners = tag_corners(0.08);
  for (int c = 0; c < 4; ++c) {
    const Eigen::Vector3d p_C = X_CM * corners[c];
    const Eigen::Vector2d p_px = lens.project(p_C.head<2>() / p_C.z()) +
                                 noise_px * Eigen::Vector2d(noise(random), noise(random));
    marker.corner_px[c][0] = p_px.x();
    marker.corner_px[c][1] = p_px.y();
    points.push_back(*lens.straighten(p_px));
  }
  to_message(Matrix8d(0.1 * 0.1 * Matrix8d::Identity()), marker.corner_covariance);
  const auto minima = solve_tag_pose(0.08, points);
  marker.num_hypotheses = static_cast<std::int8_t>(minima.size());
  for (int h = 0; h < 2; ++h) {
    const PoseFit& fit = minima.at(std::min<std::size_t>(h, minima.size() - 1));
    marker.X_CM[h] = to_message(fit.X_CB);
    marker.reprojection_error_px[h] = fit.rms_sigma;
  }
  return marker;
}

struct Scene {
  std::vector<int> tags = {1, 2, 3, 5};
  double noise_px = 0;
  Pose X_CB1_true = X_CB1();
  std::mt19937 random{1};

  marker_poses_t frame(std::int64_t utime) {
    std::vector<marker_pose_t> seen;
    const Markers all = markers();
    for (const int id : tags) {
      const TagPlacement& tag = *all.find(id);
      const Pose X_CB = tag.part == 1 ? X_CB1_true : X_CB2();
      seen.push_back(sight_of(id, X_CB * tag.X_BM.value_or(Pose::Identity()), noise_px, random));
    }
    marker_poses_t poses{};
    poses.utime = utime;
    poses.image_seq = utime / 1000;
    set_array(poses.num_markers, poses.markers, std::move(seen));
    return poses;
  }
};

motion_status_t status(std::int64_t action_id, std::int8_t state, std::int64_t utime,
                       std::int64_t rest_since) {
  motion_status_t status{};
  status.utime = utime;
  status.source = "motor_babbler";
  status.epoch = 77;
  status.action_id = action_id;
  status.kind = action_command_t::KIND_MOVE;
  status.purpose = action_command_t::PURPOSE_TEST;
  status.state = state;
  status.rest_since_utime = rest_since;
  set_array(status.num_signals, status.commanded, std::vector<double>{0.1, 0.2});
  return status;
}

motion_status_t settled(std::int64_t action_id, std::int64_t rest_since = kRest_us) {
  return status(action_id, motion_status_t::STATE_SETTLED, rest_since + 50'000, rest_since);
}
motion_status_t moving(std::int64_t action_id, std::int64_t utime) {
  return status(action_id, motion_status_t::STATE_MOVING, utime, -1);
}

Observer calibrated(const ObserverConfig& c = config()) {
  Observer observer(c, markers(), 99);
  observer.on_camera_info(camera());
  return observer;
}

double position_error(const sample_t& sample, std::size_t part, const Pose& truth) {
  return (from_message(sample.parts.at(part).X_CB).translation() - truth.translation()).norm();
}

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

TEST(Observer, SaysWhatItWaitsForAndWarnsOnce) {
  Observer observer = calibrated();
  EXPECT_EQ(observer.activity(), "waits for a settled action");
  Scene scene;
  observer.on_motion_status(settled(9));
  observer.on_marker_poses(scene.frame(kRest_us));
  EXPECT_EQ(
      observer.activity(),
      "waits for 1 of 2 frames of action 9 of motor_babbler; newest MARKER_POSES 0 ms after it "
      "came to rest");
  EXPECT_FALSE(observer.on_tick(1'000'000));
  EXPECT_FALSE(observer.on_tick(5'000'000));
  EXPECT_TRUE(observer.on_tick(6'000'000));
  EXPECT_FALSE(observer.on_tick(7'000'000));
}

// Between an action's rest and its frames it waits all the time: people hear of it after 5 s.
TEST(Observer, SaysThatItWaitsOnlyOnceItTakesLong) {
  Observer observer = calibrated();
  Scene scene;
  EXPECT_TRUE(observer.is_waiting());
  observer.on_motion_status(settled(9));
  observer.on_marker_poses(scene.frame(kRest_us));
  ASSERT_TRUE(observer.on_marker_poses(scene.frame(kRest_us + 33'333)));
  observer.on_motion_status(settled(10, kRest_us + 1'000'000));
  observer.on_tick(1'000'000);
  EXPECT_FALSE(observer.is_waiting());
  observer.on_tick(7'000'000);
  EXPECT_TRUE(observer.is_waiting());
  observer.on_marker_poses(scene.frame(kRest_us + 1'000'000));
  ASSERT_TRUE(observer.on_marker_poses(scene.frame(kRest_us + 1'033'333)));
  EXPECT_FALSE(observer.is_waiting());
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

TEST(Observer, ContinuesTheIndicesAfterARestartAndRepeatsNoAction) {
  Scene scene;
  Observer first = calibrated();
  first.on_motion_status(settled(0));
  first.on_marker_poses(scene.frame(kRest_us));
  const auto sample = first.on_marker_poses(scene.frame(kRest_us + 33'333)).value();

  Observer second = calibrated();
  second.restore(sample);
  second.on_marker_poses(scene.frame(kRest_us));
  second.on_marker_poses(scene.frame(kRest_us + 33'333));
  EXPECT_FALSE(second.on_motion_status(settled(0)));
  second.on_motion_status(settled(1, kRest_us + 1'000'000));
  second.on_marker_poses(scene.frame(kRest_us + 1'000'000));
  const auto next = second.on_marker_poses(scene.frame(kRest_us + 1'033'333));
  ASSERT_TRUE(next);
  EXPECT_EQ(next->sample_index, 1);
}

TEST(Observer, ForgetsTheFramesOfADriverWhoseTimeBeganAnew) {
  Scene scene;
  Observer observer = calibrated();
  observer.on_motion_status(settled(0, 2 * kRest_us));
  observer.on_marker_poses(scene.frame(kRest_us));
  observer.on_marker_poses(scene.frame(kRest_us + 33'333));
  motion_status_t anew = settled(0);
  anew.epoch = 78;
  EXPECT_FALSE(observer.on_motion_status(anew));
  EXPECT_FALSE(observer.on_marker_poses(scene.frame(kRest_us)));
  EXPECT_TRUE(observer.on_marker_poses(scene.frame(kRest_us + 33'333)));
}

TEST(Observer, GoesOnWhenTheCamerasClockIsSetBack) {
  constexpr std::int64_t kLate_us = 28'000'000, kSetBack_us = 14'000'000;
  Scene scene;
  scene.tags = {1};
  Observer observer = calibrated();
  // A full buffer, in which each frame that comes now would be the oldest.
  for (int n = 0; n < 8; ++n) observer.on_marker_poses(scene.frame(kLate_us + n * 33'333));
  observer.on_marker_poses(scene.frame(kSetBack_us));
  observer.on_marker_poses(scene.frame(kSetBack_us + 33'333));
  EXPECT_EQ(observer.counters().at("camera time ran backwards"), 1);
  const auto sample = observer.on_motion_status(settled(0, kSetBack_us));
  ASSERT_TRUE(sample);
  EXPECT_EQ(sample->utime, kSetBack_us + 33'333);
}

TEST(Observer, DropsFramesFarAheadOfTheDriver) {
  Scene scene;
  scene.tags = {1};
  Observer observer = calibrated();
  for (int n = 0; n < 8; ++n) observer.on_marker_poses(scene.frame(3'600'000'000 + n * 33'333));
  EXPECT_FALSE(observer.on_motion_status(settled(0))) << "of frames that were not taken at rest";
  EXPECT_FALSE(observer.on_marker_poses(scene.frame(3'600'000'000)));
  EXPECT_EQ(observer.counters().at("frame far ahead of the driver"), 9);
  EXPECT_FALSE(observer.on_marker_poses(scene.frame(kRest_us)));
  EXPECT_TRUE(observer.on_marker_poses(scene.frame(kRest_us + 33'333)));
  EXPECT_EQ(observer.counters().count("camera time ran backwards"), 0U);
}

TEST(ObserverConfig, OfEveryShippedRigIsReadable) {
  for (const char* rig : {"arm2", "arm4", "arm6_ends", "arm7"}) {
    EXPECT_NO_THROW(
        ObserverConfig::load(std::filesystem::path(BODYSCHEMA_CONFIG) / rig / "observer.yaml"));
  }
}

}  // namespace
}  // namespace bodyschema
