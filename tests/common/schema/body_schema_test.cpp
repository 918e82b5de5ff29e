#include "common/schema/body_schema.h"

#include <gtest/gtest.h>

#include "common/schema/sample.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::random_edge;
using test::Rng;

// 1 → 2 → 3, 2 → 4; signal 0 moves two edges.
BodySchema random_schema(Rng& rng) {
  BodySchema schema;
  schema.parts = {1, 2, 3, 4, 5};
  schema.root = 1;
  schema.signals = {{"q1", -1, 1}, {"q2", -1, 1}, {"q3", -1, 1}, {"q4", -1, 1}};
  schema.edges = {random_edge(1, 2, {0}, rng), random_edge(2, 3, {1, 2}, rng),
                  random_edge(2, 4, {0}, rng)};
  return schema;
}

Eigen::VectorXd random_action(Rng& rng, int size) {
  Eigen::VectorXd q(size);
  for (int n = 0; n < size; ++n) q(n) = test::uniform(rng, -1, 1);
  return q;
}

TEST(Edge, JacobianAgreesWithCentralDifferences) {
  Rng rng(1);
  for (int n = 0; n < 20; ++n) {
    const Edge edge =
        random_edge(1, 2, n % 2 ? std::vector<int>{2, 0} : std::vector<int>{1, 1}, rng);
    const Eigen::VectorXd q = random_action(rng, 3);
    const auto predict = [&](const Eigen::VectorXd& a) { return edge.predict(a); };
    EXPECT_LT((edge.jacobian(q) - test::numeric_jacobian(predict, q)).norm(), 1e-8);
  }
}

class EdgeOfJoints : public testing::TestWithParam<std::vector<int>> {};

INSTANTIATE_TEST_SUITE_P(Edge, EdgeOfJoints,
                         testing::Values(std::vector{1, 0}, std::vector{2, 5, 0, 4, 1, 3},
                                         std::vector{7, 5, 0, 4, 1, 3, 2, 6}));

TEST_P(EdgeOfJoints, PredictionCovarianceAgreesWithPerturbedParameters) {
  Rng rng(2);
  Edge edge = random_edge(1, 2, GetParam(), rng);
  if (edge.joints.size() > 2) edge.joints[1].turn = 0;  // it slides
  const Eigen::VectorXd q = random_action(rng, static_cast<int>(GetParam().size()));
  const double h = 1e-6;
  const auto perturbed = [&](int parameter, double step) {
    Edge e = edge;
    Vector6d xi = Vector6d::Zero();
    if (parameter < 6) {
      xi(parameter) = step;
      e.left = e.left * exp(xi);
    } else {
      ScrewJoint& joint = e.joints[(parameter - 6) / 8];
      const int k = (parameter - 6) % 8;
      if (k == 0) joint.slide += step;
      if (k == 1) joint.turn += step;
      if (k > 1) {
        xi(k - 2) = step;
        joint.X_after = joint.X_after * exp(xi);
      }
    }
    return log(edge.predict(q).inverse() * e.predict(q));
  };
  Eigen::MatrixXd J(6, edge.num_parameters());
  for (int n = 0; n < J.cols(); ++n) J.col(n) = (perturbed(n, h) - perturbed(n, -h)) / (2 * h);
  const Matrix6d expected = J * edge.parameter_covariance * J.transpose();
  EXPECT_LT((edge.prediction_covariance(q) - expected).norm(), 1e-6 * expected.norm());
  EXPECT_LT((edge.parameter_jacobian(q) - J).norm(), 1e-7 * J.norm());
}

TEST(Edge, ScatterIsThatOfTheCommandsOfItsJoints) {
  Rng rng(7);
  Edge edge = random_edge(1, 2, {0, 1}, rng);
  const Eigen::VectorXd q = random_action(rng, 2);
  EXPECT_TRUE(edge.scatter_covariance(q).isZero(0));
  edge.joints[1].scatter = 0.1;
  // The displacement is gain · θ + offset.
  const Vector6d twist = edge.jacobian(q).col(1) / edge.joints[1].gain;
  EXPECT_TRUE(edge.scatter_covariance(q).isApprox(0.01 * twist * twist.transpose(), 1e-9));
  edge.joints[1].gain = 0;
  EXPECT_TRUE(edge.scatter_covariance(q).isZero(0)) << "what is stuck misses no command";
}

TEST(Edge, SignalsAreListedOnceInTheOrderOfTheJoints) {
  Rng rng(3);
  EXPECT_EQ(random_edge(1, 2, {2, 0, 2}, rng).signals(), (std::vector<int>{2, 0}));
  EXPECT_STREQ(random_edge(1, 2, {}, rng).kind(), "rigid");
  EXPECT_STREQ(random_edge(1, 2, {1}, rng).kind(), "screw");
}

TEST(BodySchema, PredictionComposesAlongThePathInBothDirections) {
  Rng rng(4);
  const BodySchema schema = random_schema(rng);
  const Eigen::VectorXd q = random_action(rng, 4);
  const auto forward = schema.predict(3, 4, q), backward = schema.predict(4, 3, q);
  ASSERT_TRUE(forward && backward);
  EXPECT_TRUE((forward->X_AB * backward->X_AB).isApprox(Pose::Identity(), 1e-12));
  const Matrix6d A = adjoint(forward->X_AB);
  EXPECT_TRUE((A * forward->covariance * A.transpose()).isApprox(backward->covariance, 1e-9));
  EXPECT_TRUE(forward->X_AB.isApprox(
      schema.edges[1].predict(q).inverse() * schema.edges[2].predict(q), 1e-12));
}

TEST(BodySchema, JacobianAgreesWithCentralDifferencesOverBranches) {
  Rng rng(5);
  const BodySchema schema = random_schema(rng);
  const Eigen::VectorXd q = random_action(rng, 4);
  for (const auto& [from, to] : {std::pair{1, 3}, {3, 1}, {3, 4}, {4, 3}, {1, 1}}) {
    const auto predict = [&, from = from, to = to](const Eigen::VectorXd& a) {
      return schema.predict(from, to, a)->X_AB;
    };
    EXPECT_LT((*schema.jacobian(from, to, q) - test::numeric_jacobian(predict, q)).norm(), 1e-8);
  }
}

TEST(BodySchema, PredictAllGivesEveryConnectedPartInTheRoot) {
  Rng rng(6);
  const BodySchema schema = random_schema(rng);
  const Eigen::VectorXd q = random_action(rng, 4);
  const auto all = schema.predict_all(q);
  EXPECT_EQ(all.size(), 4u);
  for (const auto& [part, X_RB] : all)
    EXPECT_TRUE(X_RB.isApprox(schema.predict(1, part, q)->X_AB, 1e-12));
}

TEST(BodySchema, UnconnectedPartsHaveNoPrediction) {
  Rng rng(7);
  const BodySchema schema = random_schema(rng);
  EXPECT_FALSE(schema.predict(1, 5, random_action(rng, 4)));
  EXPECT_FALSE(schema.jacobian(5, 1, random_action(rng, 4)));
}

TEST(BodySchema, AnActionOfTheWrongSizeIsRefused) {
  Rng rng(8);
  const BodySchema schema = random_schema(rng);
  EXPECT_THROW(schema.predict(1, 2, random_action(rng, 3)), std::invalid_argument);
  EXPECT_THROW(schema.predict_all(random_action(rng, 5)), std::invalid_argument);
  EXPECT_THROW(schema.jacobian(1, 2, random_action(rng, 0)), std::invalid_argument);
}

TEST(BodySchema, SignalsThatNoEdgeUsesAreListed) {
  Rng rng(9);
  EXPECT_EQ(random_schema(rng).unused_signals(), std::vector<int>{3});
}

// 1 → 2 → 3, 2 → 4: in the first half of the range everything is seen, beyond it the root alone and
// 3, at the end 1 and 2.
TEST(BodySchema, ASignalIsCoveredWhereEveryEdgeThatItMovesLayBetweenSeenParts) {
  Rng rng(3);
  BodySchema schema = random_schema(rng);
  std::vector<ActionPoseSample> samples;
  for (const double q : {-1.0, -0.5, 0.0, 0.5, 1.0}) {
    ActionPoseSample& sample = samples.emplace_back();
    sample.action = Eigen::VectorXd::Constant(4, q);
    for (const int part : q <= 0  ? std::vector{1, 2, 3, 4}
                          : q < 1 ? std::vector{1, 3}
                                  : std::vector{1, 2})
      sample.parts.push_back({.part = part, .X_CB = Pose::Identity()});
  }
  schema.set_covered(samples);
  const auto upper = [&](int s) {
    return schema.signals[static_cast<std::size_t>(s)].covered->upper;
  };
  EXPECT_EQ(upper(0), 0);    // 2 → 4 was not seen beyond
  EXPECT_EQ(upper(1), 0.5);  // 2 was not, but 1 and 3 were
  EXPECT_EQ(upper(3), 1);    // moves nothing
  for (const Signal& signal : schema.signals) EXPECT_EQ(signal.covered->lower, -1);

  schema.edges.pop_back();
  schema.set_covered(samples);
  EXPECT_EQ(upper(0), 1);
}

TEST(ActionPoseSample, FindsAPartOrNothing) {
  ActionPoseSample sample;
  sample.parts.resize(2);
  sample.parts[0].part = 3;
  sample.parts[1].part = 7;
  EXPECT_EQ(sample.find(7), &sample.parts[1]);
  EXPECT_EQ(sample.find(5), nullptr);
}

TEST(BodySchema, AMovedTagIsKnownFromItsFindingOnAndItsEndFromItsEndOn) {
  BodySchema schema;
  schema.moved_tags = {{.tag = 41, .found = 20, .since = 10, .until = 50}};
  EXPECT_TRUE(schema.moved_tags_known(19).empty());
  for (const auto& [sample, until] : {std::pair{20, -1}, {49, -1}, {50, 50}}) {
    const auto known = schema.moved_tags_known(sample);
    ASSERT_EQ(known.size(), 1U) << sample;
    EXPECT_EQ(known[0].until, until) << sample;
  }
}

}  // namespace
}  // namespace bodyschema
