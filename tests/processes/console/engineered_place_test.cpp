#include "processes/console/engineered_place.h"

#include <gtest/gtest.h>

#include <stdexcept>

#include "tests/support/random_arm.h"

namespace bodyschema {
namespace {

using test::Rng;

/// An arm, its exact model without a place, and a recording of it: every tenth pose of its hand is
/// anywhere.
class PlaceInCameraTest : public testing::Test {
 protected:
  PlaceInCameraTest() {
    model_.X_CR = Pose::Identity();
    model_.X_CR_covariance.setZero();
    model_.parts = {1, 8};
    model_.edges = {robot_.true_edge(1, 8)};
    recording_.samples = test::babble(robot_, 60, {}, rng_);
    for (std::size_t n = 0; n < recording_.samples.size(); ++n) {
      ActionPoseSample& sample = recording_.samples[n];
      sample.calibration_id = 5;
      if (n % 10 == 3) sample.parts.back().X_CB = test::random_pose(rng_, 1, 3);
    }
  }
  void see_hand_alone() {
    for (ActionPoseSample& sample : recording_.samples)
      std::erase_if(sample.parts, [](const auto& seen) { return seen.part != 8; });
  }
  double error() const { return log(model_.X_CR.inverse() * robot_.X_CR).norm(); }

  Rng rng_{5};
  const test::SyntheticRobot robot_ = test::random_arm({.num_joints = 7}, rng_);
  BodySchema model_ = test::true_schema(robot_);
  Recording recording_;
};

TEST_F(PlaceInCameraTest, TakesThePosesOfTheRootWhereTheyAreSeen) {
  place_in_camera(recording_, &model_);
  EXPECT_LT(error(), 1e-9);
  EXPECT_FALSE(model_.X_CR_covariance.isZero(0));
  EXPECT_EQ(model_.calibration_id, 5);
  EXPECT_TRUE(model_.position_parts.empty());
}

TEST_F(PlaceInCameraTest, FitsTheOtherPartsWhereTheRootIsNeverSeen) {
  see_hand_alone();
  place_in_camera(recording_, &model_);
  EXPECT_LT(error(), 1e-6);
  EXPECT_TRUE(model_.X_CR_covariance.isZero(0));
}

TEST_F(PlaceInCameraTest, FitsPositionsAlone) {
  see_hand_alone();
  recording_.samples = test::with_positions_alone(recording_.samples, {8});
  place_in_camera(recording_, &model_);
  EXPECT_LT(error(), 1e-6);
  EXPECT_EQ(model_.position_parts, std::vector<int>{8});
}

TEST_F(PlaceInCameraTest, RefusesWhatDoesNotTellHowTheCameraStands) {
  see_hand_alone();
  Recording few = recording_;
  few.samples.resize(2);
  few.samples = test::with_positions_alone(few.samples, {8});
  EXPECT_THROW(place_in_camera(few, &model_), std::runtime_error);
  for (ActionPoseSample& sample : recording_.samples) sample.parts.clear();
  EXPECT_THROW(place_in_camera(recording_, &model_), std::runtime_error);
}

}  // namespace
}  // namespace bodyschema
