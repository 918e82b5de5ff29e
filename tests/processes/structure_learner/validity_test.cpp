#include "processes/structure_learner/validity.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <vector>

#include "common/geometry/angle.h"
#include "processes/structure_learner/screen.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Regime;
using test::Rng;

Validity rigid_validity(const std::vector<ActionPoseSample>& samples, const Noise& noise,
                        const Noise& systematic = {}) {
  const NormalizedActions actions(samples, static_cast<int>(samples[0].action.size()));
  const PairData pair =
      make_pair_data(samples, 1, 2, {.noise = noise, .systematic = systematic}, 2000);
  const Fit fit = fit_local_model(screen_rigid(pair, actions).model, pair, actions, 40);
  return check_validity(fit, leave_one_out(fit, pair, actions), pair, actions, {});
}

// Two parts with one joint of ±range_rad.
test::SyntheticRobot hinge(double range_rad, Rng& rng) {
  test::SyntheticRobot robot;
  robot.signals = {{"q1", -1, 1}, {"q2", -1, 1}};
  robot.links.push_back({.part = 1});
  test::TrueLink link;
  link.part = 2;
  link.parent = 1;
  link.signal = 0;
  link.turn = range_rad;
  link.X_before = test::random_pose(rng, 0.06, 0.16);
  link.X_after = test::random_pose(rng, 0.06, 0.16);
  robot.links.push_back(link);
  robot.X_CR.translation().z() = 2;
  return robot;
}

TEST(Validity, ATrueRigidConnectionIsValid) {
  int valid = 0;
  for (int seed = 1; seed <= 50; ++seed) {
    Rng rng(seed);
    const auto samples = test::babble(hinge(0, rng), 40, {Regime::kChapter}, rng);
    valid +=
        rigid_validity(samples, test::nominal_noise(Regime::kChapter)).verdict == Verdict::kValid;
  }
  EXPECT_GE(valid, 48);
}

TEST(Validity, AJointOfTwoDegreesIsFoundInTagNoise) {
  int refuted = 0;
  for (int seed = 1; seed <= 50; ++seed) {
    Rng rng(seed);
    const auto samples = test::babble(hinge(2 * kDegree, rng), 40, {Regime::kTagIso}, rng);
    const Validity v = rigid_validity(samples, {0.001, 0.6 * kDegree});
    refuted += v.verdict == Verdict::kRefuted;
  }
  EXPECT_GE(refuted, 40);
}

TEST(Validity, WhatTheModelErrorMayBeIsNoJoint) {
  int refuted = 0, refuted_as_bias = 0;
  for (int seed = 1; seed <= 10; ++seed) {
    Rng rng(seed);
    auto samples = test::babble(hinge(0, rng), 1500, {Regime::kTagIso}, rng);
    for (ActionPoseSample& sample : samples)
      for (PartObservation& o : sample.parts)
        if (o.part == 2) o.X_CB = o.X_CB * Eigen::Translation3d(0.003 * sample.action(0), 0, 0);
    const Noise noise = test::nominal_noise(Regime::kTagIso);
    refuted += rigid_validity(samples, noise).verdict == Verdict::kRefuted;
    refuted_as_bias +=
        rigid_validity(samples, noise, {0.003, 0.2 * kDegree}).verdict == Verdict::kRefuted;
  }
  EXPECT_GE(refuted, 9);
  EXPECT_EQ(refuted_as_bias, 0);
}

TEST(Validity, AHingeOfNinetyDegreesIsNotRigid) {
  for (int seed = 1; seed <= 50; ++seed) {
    Rng rng(seed);
    const auto samples = test::babble(hinge(M_PI / 2, rng), 20, {Regime::kChapter}, rng);
    EXPECT_EQ(rigid_validity(samples, test::nominal_noise(Regime::kChapter)).verdict,
              Verdict::kRefuted);
  }
}

TEST(Validity, TwoSamplesAreNotEnough) {
  Rng rng(1);
  const auto samples = test::babble(hinge(0, rng), 2, {Regime::kFree}, rng);
  EXPECT_EQ(rigid_validity(samples, {1e-4, 3e-4}).verdict, Verdict::kNotEnoughData);
}

// Errors of √12 standard deviations each: no outlier, and along with no signal.
TEST(Validity, AModelThatIsOffEverywhereIsRefutedThoughNothingIsAnOutlier) {
  const Noise noise = test::nominal_noise(Regime::kTagIso);
  for (const auto& [squared_distance, expected] :
       {std::pair{5.0, Verdict::kValid}, {12.0, Verdict::kRefuted}}) {
    Rng rng(1);
    auto samples = test::babble(hinge(0, rng), 60, {Regime::kTagIso}, rng);
    const Pose z = test::random_pose(rng, 0.1, 0.2);
    for (ActionPoseSample& sample : samples) {
      const Vector6d direction = std::sqrt(squared_distance) * test::gaussian6(rng).normalized();
      const Matrix6d C = relative_covariance(z, isotropic(noise), isotropic(noise));
      sample.parts[1].X_CB =
          sample.parts[0].X_CB * z * exp(Vector6d(C.llt().matrixL() * direction));
    }
    const Validity v = rigid_validity(samples, noise);
    EXPECT_EQ(v.num_outliers, 0);
    EXPECT_EQ(v.verdict, expected) << squared_distance;
  }
}

// A screw has more parameters than a few resting poses decide: that it fits them says nothing.
// A joint that slips at one end of its command: no more outliers than wild readings make.
TEST(Validity, AHingeThatSlipsAtOneEndIsRefuted) {
  for (const bool slips : {false, true}) {
    Rng rng(11);
    const test::SyntheticRobot robot = hinge(1.5, rng);
    std::vector<ActionPoseSample> samples;
    for (int t = 0; t < 120; ++t) {
      const Eigen::Vector2d command(test::uniform(rng, -1, 1), test::uniform(rng, -1, 1));
      const bool is_off = slips ? command(0) < -0.8 : t % 10 == 0;
      Eigen::Vector2d reached = command;
      if (is_off) reached(0) = slips ? command(0) + 0.5 : command(1);
      samples.push_back(test::observe(robot, reached, {Regime::kTagIso}, t, rng));
      samples.back().action = command;
    }
    const NormalizedActions actions(samples, 2);
    const PairData pair =
        make_pair_data(samples, 1, 2, {.noise = test::nominal_noise(Regime::kTagIso)}, 2000);
    const Edge truth = robot.true_edge(1, 2);
    LocalModel model;
    model.first = truth.left;
    model.joints.push_back({.signal = 0, .turn = 1.5, .X_after = truth.joints[0].X_after});
    const Fit fit = fit_local_model(model, pair, actions, 40);
    const Validity validity =
        check_validity(fit, leave_one_out(fit, pair, actions), pair, actions, {});
    EXPECT_EQ(validity.verdict, slips ? Verdict::kRefuted : Verdict::kValid);
    EXPECT_GE(validity.num_outliers, 5);
  }
}

TEST(Validity, AJointThatFitsFewReadingsOfNoMotionIsNotYetTold) {
  for (int seed = 1; seed <= 10; ++seed) {
    Rng rng(seed);
    const auto samples = test::babble(hinge(0, rng), 5, {Regime::kTagIso}, rng);
    const NormalizedActions actions(samples, 2);
    const PairData pair =
        make_pair_data(samples, 1, 2, {.noise = test::nominal_noise(Regime::kTagIso)}, 2000);
    LocalModel screw;
    screw.joints = {{.turn = 0.02}};
    screw.first = screen_rigid(pair, actions).model.first;
    const Fit fit = fit_local_model(screw, pair, actions, 40);
    EXPECT_NE(check_validity(fit, leave_one_out(fit, pair, actions), pair, actions, {}).verdict,
              Verdict::kValid)
        << seed;
  }
}

}  // namespace
}  // namespace bodyschema
