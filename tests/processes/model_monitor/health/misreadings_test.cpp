#include "processes/model_monitor/health/misreadings.h"

#include <gtest/gtest.h>

#include "common/geometry/angle.h"
#include "processes/model_monitor/adaptation.h"
#include "processes/structure_learner/learn.h"
#include "tests/support/imperfect_robot.h"

namespace bodyschema {
namespace {

using test::ImperfectRobot;
using Kind = AdaptationEvent::Kind;

constexpr Noise kNoise{0.003, 1 * kDegree};

Pose turned(double degrees) {
  Pose X = Pose::Identity();
  X.linear() = exp_so3(degrees * kDegree * Eigen::Vector3d::UnitX());
  return X;
}

class MisreadingsTest : public testing::Test {
 protected:
  MisreadingsTest() {
    measurement_.noise = kNoise;
    schema_.parts = {1};
    schema_.root = 1;
    schema_.X_CR.translation().z() = 1;
  }
  bool read(const Pose& X_RM) {
    ActionPoseSample sample;
    sample.action.resize(0);
    PartObservation& o = sample.parts.emplace_back();
    o.part = 1;
    o.X_CB = schema_.X_CR * X_RM;
    return misreadings_.look(sample, schema_, measurement_);
  }

  BodySchema schema_;
  MeasurementModel measurement_;
  Misreadings misreadings_;
};

TEST_F(MisreadingsTest, APlaceIsKnownOnceItsMarkerCameBackFromThereTwice) {
  const Pose home = Pose::Identity(), flip = turned(40);
  EXPECT_FALSE(read(home));
  EXPECT_FALSE(read(flip));
  EXPECT_FALSE(read(flip));  // in a row: once
  EXPECT_FALSE(read(home));
  EXPECT_FALSE(read(turned(-40)));
  EXPECT_FALSE(read(home));
  EXPECT_FALSE(read(flip));
  EXPECT_TRUE(misreadings_.places().empty() || misreadings_.places().at(1).empty());
  EXPECT_TRUE(read(home));
  ASSERT_EQ(misreadings_.places().at(1).size(), 1U);
  EXPECT_TRUE(misreadings_.places().at(1)[0].isApprox(flip, 1e-9));
  EXPECT_FALSE(read(flip));
  EXPECT_FALSE(read(home));
}

TEST_F(MisreadingsTest, WhatMovedForGoodIsNone) {
  for (int n = 0; n < 2; ++n) {
    read(turned(40));
    misreadings_.forget_open();
    EXPECT_FALSE(read(Pose::Identity()));
  }
  for (int n = 0; n < 50; ++n) EXPECT_FALSE(read(turned(70)));
}

// A tag that rests flips to the same reading each time, and nothing says that there are two.
class RestingRootFlips : public testing::Test {
 protected:
  RestingRootFlips() : robot_(4, true, {.name = "flips", .flip_share = 0.2}, 501) {
    LearnOptions learning;
    learning.root = 1;
    learning.measurement.noise = kNoise;
    AdaptationOptions options;
    options.measurement.noise = kNoise;
    adaptation_.emplace(learn(robot_.signals(), robot_.babble(100), learning).schema, options);
  }
  // Events that say that something moved.
  int watch(int num_samples, const Pose& root_moved = Pose::Identity()) {
    int moves = 0;
    for (int n = 0; n < num_samples; ++n) {
      ActionPoseSample sample = robot_.go(robot_.random_action());
      for (PartObservation& o : sample.parts)
        if (o.part == 1) o.X_CB = o.X_CB * root_moved;
      for (const AdaptationEvent& event : adaptation_->on_sample(sample))
        moves += event.kind == Kind::kCandidate || event.kind == Kind::kRestored;
    }
    return moves;
  }

  ImperfectRobot robot_;
  std::optional<Adaptation> adaptation_;
};

TEST_F(RestingRootFlips, AreNoMoves) { EXPECT_LE(watch(600), 1); }

TEST_F(RestingRootFlips, DoNotHideAMove) {
  watch(200);
  Pose moved = turned(25);
  moved.translation().x() = 0.03;
  EXPECT_GE(watch(12, moved), 1);
  EXPECT_TRUE(adaptation_->is_settled() || adaptation_->marker_state(1) == EdgeState::kProvisional);
}

}  // namespace
}  // namespace bodyschema
