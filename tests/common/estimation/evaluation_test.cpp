#include "common/estimation/evaluation.h"

#include <gtest/gtest.h>

#include <cmath>

#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

TEST(EvaluationTest, TheTrueSchemaHasNoErrorOnExactData) {
  test::Rng rng(51);
  for (int run = 0; run < 20; ++run) {
    const auto robot = test::random_tree({.num_hidden = 0}, rng);
    const auto errors = evaluate(test::true_schema(robot), test::babble(robot, 10, {}, rng));
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
  const BodySchema schema = test::true_schema(robot);
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

/// The samples as a rig tells them whose tags are not where it says, and whose metre is another
/// one.
std::vector<ActionPoseSample> displaced(std::vector<ActionPoseSample> samples, double scale,
                                        test::Rng& rng) {
  std::map<int, Pose> X_PB;
  for (ActionPoseSample& sample : samples) {
    const Pose X_RC = sample.find(1)->X_CB.inverse();
    for (PartObservation& part : sample.parts) {
      if (!X_PB.contains(part.part)) {
        X_PB[part.part] =
            exp(Vector6d((Vector6d() << 0.001 * test::random_pose(rng, 1, 1).translation(),
                          0.01 * test::random_pose(rng, 1, 1).translation())
                             .finished()));
      }
      Pose X_RP = X_RC * part.X_CB;
      X_RP.translation() *= scale;
      part.X_CB = X_RP * X_PB.at(part.part);
    }
  }
  return samples;
}

TEST(EvaluationTest, AlignmentFindsTheFramesOfThePartsAndTheScale) {
  test::Rng rng(53);
  for (int run = 0; run < 10; ++run) {
    const auto robot = test::random_tree({.num_hidden = 0}, rng);
    const BodySchema schema = test::true_schema(robot);
    const auto truth = displaced(test::babble(robot, 15, {}, rng), 1.003, rng);
    const JudgedErrors errors = judge(schema, truth, truth);
    ASSERT_TRUE(errors.alignment.has_value());
    EXPECT_NEAR(errors.alignment->scale, 1.003, 1e-4);
    ASSERT_EQ(errors.parts.size(), errors.aligned_parts.size());
    for (std::size_t i = 0; i < errors.parts.size(); ++i) {
      EXPECT_GT(errors.parts[i].position_median_m, 1e-4);
      EXPECT_LT(errors.aligned_parts[i].position_max_m, 1e-5);
      EXPECT_LT(errors.aligned_parts[i].rotation_rms_rad, 1e-4);
    }
  }
}

TEST(EvaluationTest, AScaleThatNoSampleTellsStaysOne) {
  // One joint, part 2 on its axis: any length may be the frame's.
  BodySchema schema;
  schema.parts = {1, 2};
  schema.root = 1;
  schema.signals = {{"q1", -1, 1}};
  Edge edge;
  edge.from = 1;
  edge.to = 2;
  edge.left.translation() = Eigen::Vector3d(0, 0, 0.5);
  ScrewJoint joint;
  joint.turn = 1;
  edge.joints = {joint};
  schema.edges = {edge};
  test::Rng rng(55);
  std::vector<ActionPoseSample> truth;
  for (int i = 0; i < 20; ++i) {
    ActionPoseSample& sample = truth.emplace_back();
    sample.action = Eigen::VectorXd::Constant(1, -1 + i / 10.0);
    sample.parts.resize(2);
    sample.parts[0].part = 1;
    sample.parts[1].part = 2;
    sample.parts[1].X_CB =
        schema.predict_all(sample.action).at(2) * exp(Vector6d(0.002 * Vector6d::Unit(6, i % 6)));
  }
  const JudgedErrors errors = judge(schema, truth, truth);
  ASSERT_TRUE(errors.alignment.has_value());
  EXPECT_NEAR(errors.alignment->scale, 1, 0.01);
  EXPECT_LT(errors.aligned_parts[0].position_rms_m, 0.002);
}

TEST(EvaluationTest, AlignmentHidesNoErrorOfTheKinematics) {
  test::Rng rng(54);
  const auto robot = test::chapter_robot("c", rng);
  BodySchema schema = test::true_schema(robot);
  const auto truth = test::babble(robot, 40, {}, rng);
  ASSERT_EQ(schema.edges.back().joints.size(), 1U);
  schema.edges.back().joints[0].gain *= 1.1;
  const JudgedErrors errors = judge(schema, truth, truth);
  ASSERT_TRUE(errors.alignment.has_value());
  EXPECT_GT(errors.aligned_parts.back().rotation_rms_rad,
            0.3 * errors.parts.back().rotation_rms_rad);
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

TEST(EvaluationTest, ARigidPairAndFewSamplesAreAlignedAsFarAsTheyTell) {
  const JudgedErrors few = judge(by_hand(), {seen(0.004, 0.01)}, {seen(0.004, 0.01)});
  EXPECT_FALSE(few.alignment.has_value());
  EXPECT_TRUE(few.aligned_parts.empty());
  const JudgedErrors rigid =
      judge(by_hand(), {seen(0.004, 0.01)}, std::vector(5, seen(0.004, 0.01)));
  ASSERT_TRUE(rigid.alignment.has_value());
  EXPECT_LT(rigid.aligned_parts.at(0).position_max_m, 1e-5);
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
