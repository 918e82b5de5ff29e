// Class Observer: waiting, restarts, and clocks that are set back.

#include <gtest/gtest.h>

#include "tests/processes/observer/observer_bench.h"

namespace bodyschema::test {
namespace {

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
  EXPECT_FALSE(observer.counters().contains("camera time ran backwards"));
}

}  // namespace
}  // namespace bodyschema::test
