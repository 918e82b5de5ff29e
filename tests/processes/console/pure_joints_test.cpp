#include "processes/console/pure_joints.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <memory>

#include "common/geometry/angle.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Rng;
using testing::ElementsAre;
using testing::HasSubstr;

/// Part 1 carries part 2 by one joint for each of the two signals.
BodySchema two_joints(Rng& rng) {
  BodySchema schema;
  schema.complete = true;
  schema.parts = {1, 2};
  schema.root = 1;
  schema.signals = {{"a", -1, 1}, {"b", -0.5, 1}};
  schema.edges = {test::random_edge(1, 2, {0, 1}, rng)};
  schema.edges.front().joints[0] = {
      .signal = 0, .turn = 0.9, .X_after = test::random_pose(rng, 0.1, 0.2)};
  schema.edges.front().joints[1] = {
      .signal = 1, .turn = 0.8, .X_after = test::random_pose(rng, 0.1, 0.2)};
  return schema;
}

void expect_refusal(const BodySchema& schema, const std::string& why) {
  try {
    pure_joints(schema, false);
    FAIL() << "no error, expected: " << why;
  } catch (const std::invalid_argument& error) {
    EXPECT_THAT(error.what(), HasSubstr(why));
    EXPECT_THAT(error.what(), HasSubstr("--nominal"));
  }
}

double difference(const BodySchema& a, const BodySchema& b, const Eigen::VectorXd& action) {
  const Pose X = a.edges[0].predict(a.displacements(action));
  return log(X.inverse() * b.edges[0].predict(b.displacements(action))).norm();
}

bool is_pure(const BodySchema& schema) {
  for (const Edge& edge : schema.edges) {
    if (edge.matrix_gp || edge.residual_gp) return false;
    for (const ScrewJoint& joint : edge.joints)
      if (joint.slide != 0 && joint.turn != 0) return false;
  }
  return true;
}

TEST(PureJoints, PureOnesStayAsTheyAre) {
  Rng rng(1);
  const BodySchema schema = two_joints(rng);
  const PureJoints pure = pure_joints(schema, false);
  EXPECT_THAT(pure.about_signals, ElementsAre());
  for (int n = 0; n < 10; ++n) {
    const Eigen::Vector2d action(test::uniform(rng, -1, 1), test::uniform(rng, -0.5, 1));
    EXPECT_LT(difference(schema, pure.schema, action), 1e-15);
  }
}

TEST(PureJoints, AHelicalJointKeepsWhatMovesItsPartMore) {
  Rng rng(2);
  BodySchema schema = two_joints(rng);
  schema.edges[0].joints[0].slide = 0.02;  // a screw: 0.9 rad with it
  schema.edges[0].joints[1].slide = 0.3;
  schema.edges[0].joints[1].turn = 0.004;  // a rail that is not straight
  expect_refusal(schema, "1→2 a: helical, slides 20 ±");
  expect_refusal(schema, "1→2 b: helical, turns 0.23 ±");
  schema.edges[0].parameter_covariance.resize(0, 0);
  const PureJoints pure = pure_joints(schema, true);
  EXPECT_EQ(pure.schema.edges[0].joints[0].slide, 0);
  EXPECT_EQ(pure.schema.edges[0].joints[1].turn, 0);
  EXPECT_LT(difference(schema, pure.schema, mid_range(schema.signals)), 1e-12);
  // Half a range of a from the middle: 20 mm, whatever way the axis has.
  EXPECT_NEAR(difference(schema, pure.schema, Eigen::Vector2d(1, 0.25)), 0.02, 1e-12);
}

TEST(PureJoints, TheOtherParametersMakeUpForWhatIsLeftOut) {
  Rng rng(6);
  BodySchema schema = two_joints(rng);
  Edge& edge = schema.edges[0];
  edge.joints[0].slide = 2e-3;
  edge.joints[1].slide = -1e-3;
  // As of a fit to samples with equal noise along all axes; the prior holds the screw frames.
  Eigen::MatrixXd information = 1e-6 * Eigen::MatrixXd::Identity(22, 22);
  std::vector<Eigen::VectorXd> actions;
  for (int n = 0; n < 50; ++n) {
    actions.push_back(Eigen::Vector2d(test::uniform(rng, -1, 1), test::uniform(rng, -0.5, 1)));
    const Eigen::MatrixXd J = edge.parameter_jacobian(actions.back());
    information += J.transpose() * J;
  }
  const auto error = [&](const BodySchema& pure) {
    double sum = 0;
    for (const Eigen::VectorXd& action : actions)
      sum += std::pow(difference(schema, pure, action), 2);
    return sum;
  };
  edge.parameter_covariance.resize(0, 0);
  const double without = error(pure_joints(schema, true).schema);
  edge.parameter_covariance = information.inverse();
  const BodySchema pure = pure_joints(schema, true).schema;
  EXPECT_TRUE(is_pure(pure));
  EXPECT_LT(error(pure), without);
  // No pure joints near by are better, but for what is not linear.
  for (int n = 0; n < 100; ++n) {
    BodySchema other = pure;
    Edge& moved = other.edges[0];
    moved.left = moved.left * exp(1e-4 * test::gaussian6(rng));
    for (ScrewJoint& joint : moved.joints) {
      joint.turn += 1e-4 * test::gaussian(rng);
      joint.X_after = joint.X_after * exp(1e-4 * test::gaussian6(rng));
    }
    EXPECT_LT(error(pure), error(other) * 1.001);
  }
}

TEST(PureJoints, ABentCommandBecomesTheLineOfLeastSquares) {
  Rng rng(3);
  BodySchema schema = two_joints(rng);
  schema.signals[1].warp = {0.03, -0.02, 0.01};
  expect_refusal(schema, "b: its command is bent, by up to");
  const BodySchema line = pure_joints(schema, true).schema;
  EXPECT_TRUE(line.signals[1].warp.empty());
  const ScrewJoint& joint = line.edges[0].joints[1];
  // The residuals of least squares have no mean and no slope.
  double mean = 0, slope = 0;
  for (int n = 0; n <= 100; ++n) {
    const double q = -0.5 + 0.015 * n;
    const double residual = schema.signals[1].displacement(q) - (joint.gain * q + joint.offset);
    mean += residual;
    slope += q * residual;
  }
  EXPECT_NEAR(mean, 0, 1e-12);
  EXPECT_NEAR(slope, 0, 1e-12);
}

TEST(PureJoints, OfAResidualProcessTheValueInTheMiddleStays) {
  Rng rng(4);
  BodySchema schema = two_joints(rng);
  constexpr int kSamples = 12;
  Eigen::MatrixXd inputs(1, kSamples);
  ResidualGp::Residuals residuals(6, kSamples);
  for (int n = 0; n < kSamples; ++n) {
    inputs(0, n) = -1 + 2.0 * n / (kSamples - 1);
    residuals.col(n) << 0.02, 0, 0.01 * inputs(0, n), 0.1, 0, 0;
  }
  const ResidualGp::Prior prior{Eigen::VectorXd::Constant(1, 1.0), Vector6d::Constant(1e-2),
                                Vector6d::Constant(1e-8)};
  schema.edges[0].residual_gp = std::make_shared<const ResidualGp>(
      std::vector<int>{0}, inputs, residuals, Eigen::VectorXd::Ones(kSamples), prior);
  expect_refusal(schema, "1→2: screws with a Gaussian process behind them");
  const PureJoints pure = pure_joints(schema, true);
  EXPECT_TRUE(is_pure(pure.schema));
  EXPECT_THAT(pure.about_edges.at(0), ElementsAre(HasSubstr("value at mid-range")));
  EXPECT_LT(difference(schema, pure.schema, mid_range(schema.signals)), 1e-12);
}

TEST(PureJoints, OfAMatrixProcessThatSawTwoHingesTwoHingesStay) {
  Rng rng(5);
  const BodySchema truth = two_joints(rng);
  BodySchema schema = truth;
  constexpr int kSamples = 60;
  Eigen::MatrixXd inputs(2, kSamples);
  std::vector<Pose> poses;
  for (int n = 0; n < kSamples; ++n) {
    inputs.col(n) << test::uniform(rng, -1, 1), test::uniform(rng, -0.5, 1);
    poses.push_back(truth.edges[0].predict(inputs.col(n)));
  }
  const GpPrior prior{std::nullopt, SquaredExponential{1, Eigen::Vector2d(2, 2)}, 1e-8};
  Edge& edge = schema.edges[0];
  edge.matrix_gp = std::make_shared<const MatrixGp>(
      std::vector<int>{0, 1}, inputs, poses, std::vector<GpPrior>(MatrixGp::kNumEntries, prior));
  edge.left = edge.right = Pose::Identity();
  edge.joints.clear();
  edge.parameter_covariance.resize(0, 0);
  expect_refusal(schema, "1→2: a matrix of Gaussian processes");
  const PureJoints pure = pure_joints(schema, true);
  EXPECT_TRUE(is_pure(pure.schema));
  ASSERT_EQ(pure.schema.edges[0].joints.size(), 2U);
  EXPECT_LT(difference(schema, pure.schema, mid_range(schema.signals)), 1e-12);
  EXPECT_NEAR(std::abs(pure.schema.edges[0].joints[0].turn), 0.9, 5e-3);
  EXPECT_NEAR(std::abs(pure.schema.edges[0].joints[1].turn), 0.8, 5e-3);
  // Not only in the middle, for hinges these are.
  EXPECT_LT(difference(truth, pure.schema, Eigen::Vector2d(0.9, -0.4)), 2e-2);
}

}  // namespace
}  // namespace bodyschema
