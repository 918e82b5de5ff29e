#include "processes/console/evaluation.h"

#include <gtest/gtest.h>

#include <cmath>

#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

/// The true kinematics of a robot as a schema: what an errorless learner would find.
BodySchema truth_as_schema(const test::SyntheticRobot& robot) {
  BodySchema schema;
  schema.complete = true;
  schema.root = 1;
  schema.signals = robot.signals;
  schema.X_CR = robot.X_CR;
  for (const test::TrueLink& link : robot.links) {
    schema.parts.push_back(link.part);
    if (link.parent < 0) continue;
    Edge edge;
    edge.from = link.parent;
    edge.to = link.part;
    edge.left = link.X_before;
    if (link.signal >= 0) {
      ScrewJoint joint;
      joint.signal = link.signal;
      joint.offset = -link.zero;
      joint.slide = link.slide;
      joint.turn = link.turn;
      edge.joints = {joint};
    }
    edge.right = link.X_after;
    schema.edges.push_back(edge);
  }
  return schema;
}

TEST(EvaluationTest, TheTrueSchemaHasNoErrorOnExactData) {
  test::Rng rng(51);
  for (int run = 0; run < 20; ++run) {
    const auto robot = test::random_tree({.num_hidden = 0}, rng);
    const auto errors = evaluate(truth_as_schema(robot), test::babble(robot, 10, {}, rng));
    ASSERT_EQ(errors.size(), 8U);
    for (std::size_t i = 0; i < errors.size(); ++i) {
      EXPECT_EQ(errors[i].part, static_cast<int>(i) + 2);
      EXPECT_EQ(errors[i].count, 10);
      EXPECT_LT(errors[i].position_max_m, 1e-9);
      EXPECT_LT(errors[i].rotation_rms_rad, 1e-6);
    }
  }
}

TEST(EvaluationTest, TheErrorDoesNotDependOnWhereTheCameraStands) {
  test::Rng rng(52);
  const auto robot = test::chapter_robot("c", rng);
  auto samples = test::babble(robot, 20, {.regime = test::Regime::kTag}, rng);
  const BodySchema schema = truth_as_schema(robot);
  const auto before = evaluate(schema, samples);
  for (ActionPoseSample& sample : samples) {
    const Pose X = test::random_pose(rng, 0, 5);
    for (PartObservation& part : sample.parts) part.X_CB = X * part.X_CB;
  }
  const auto after = evaluate(schema, samples);
  ASSERT_EQ(before.size(), after.size());
  for (std::size_t i = 0; i < before.size(); ++i) {
    EXPECT_EQ(before[i].count, after[i].count);
    EXPECT_NEAR(before[i].position_rms_m, after[i].position_rms_m, 1e-9);
    EXPECT_NEAR(before[i].rotation_median_rad, after[i].rotation_median_rad, 1e-6);
  }
}

/// Part 2 rigidly 1 m along x of part 1; part 3 is not connected.
BodySchema by_hand() {
  BodySchema schema;
  schema.parts = {1, 2, 3};
  schema.root = 1;
  schema.signals = {{"q1", 0, 1}};
  Edge edge;
  edge.from = 1;
  edge.to = 2;
  edge.right.translation() = Eigen::Vector3d(1, 0, 0);
  schema.edges = {edge};
  return schema;
}

ActionPoseSample seen(double error_m, double error_rad, bool sees_root = true) {
  ActionPoseSample sample;
  sample.action = Eigen::VectorXd::Zero(1);
  if (sees_root) {
    sample.parts.emplace_back();
    sample.parts.back().part = 1;
  }
  sample.parts.emplace_back();
  sample.parts.back().part = 2;
  sample.parts.back().X_CB.translation() = Eigen::Vector3d(1, 0, error_m);
  sample.parts.back().X_CB.linear() = exp_so3({0, error_rad, 0});
  sample.parts.emplace_back();
  sample.parts.back().part = 3;
  return sample;
}

TEST(EvaluationTest, MediansMeansAndMaximaAreAsComputedByHand) {
  const auto errors = evaluate(by_hand(), {seen(0.004, 0.1), seen(0.001, -0.3), seen(0, 0.2),
                                           seen(-0.002, 0.4), seen(9, 3, false)});
  ASSERT_EQ(errors.size(), 1U);  // the root is left out, and what is not connected
  EXPECT_EQ(errors[0].part, 2);
  EXPECT_EQ(errors[0].count, 4);
  EXPECT_NEAR(errors[0].position_median_m, 0.0015, 1e-12);
  EXPECT_NEAR(errors[0].position_rms_m, std::sqrt((16 + 1 + 4) / 4.0) * 1e-3, 1e-12);
  EXPECT_NEAR(errors[0].position_max_m, 0.004, 1e-12);
  EXPECT_NEAR(errors[0].rotation_median_rad, 0.25, 1e-9);
  EXPECT_NEAR(errors[0].rotation_rms_rad, std::sqrt((0.01 + 0.09 + 0.04 + 0.16) / 4), 1e-9);
}

TEST(EvaluationTest, ARootThatIsNeverSeenLeavesNothingToCompare) {
  const auto errors = evaluate(by_hand(), {seen(1, 1, false), seen(2, 2, false)});
  ASSERT_EQ(errors.size(), 1U);
  EXPECT_EQ(errors[0].count, 0);
  EXPECT_EQ(errors[0].position_rms_m, 0);
  EXPECT_TRUE(evaluate(by_hand(), {}).at(0).count == 0);
}

TEST(EvaluationTest, ASchemaWithoutPartsHasNoErrors) {
  BodySchema schema;
  schema.signals = {{"q1", 0, 1}};
  EXPECT_TRUE(evaluate(schema, {seen(0, 0)}).empty());
}

TEST(EvaluationTest, ActionsOfAnotherLengthAreRefused) {
  ActionPoseSample sample = seen(0, 0);
  sample.action = Eigen::VectorXd::Zero(3);
  try {
    evaluate(by_hand(), {sample});
    FAIL();
  } catch (const std::invalid_argument& error) {
    EXPECT_STREQ(error.what(), "the samples have 3 action signals, the schema 1");
  }
}

}  // namespace
}  // namespace bodyschema
