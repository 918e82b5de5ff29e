// What may change inside an edge of several joints.

#include <gtest/gtest.h>

#include <map>

#include "processes/model_monitor/changes/change_family.h"
#include "processes/model_monitor/hypotheses/change_fit.h"
#include "tests/processes/model_monitor/changed_arm.h"
#include "tests/support/long_arm.h"

namespace bodyschema {
namespace {

using test::LongArm;

constexpr int kJoints = 6;

class LongEdgeTest : public testing::Test {
 protected:
  LongEdgeTest() {
    schema_.edges[0].right = test::random_pose(rng_, 0.05, 0.1);
    schema_.edges[0].joints[1].offset = 0.2;
    schema_.edges[0].joints[4].gain = -1.3;
    action_ = robot_action();
  }
  Eigen::VectorXd robot_action() {
    Eigen::VectorXd action(kJoints);
    for (int s = 0; s < kJoints; ++s)
      action(s) = test::uniform(rng_, schema_.signals[static_cast<std::size_t>(s)].lower,
                                schema_.signals[static_cast<std::size_t>(s)].upper);
    return action;
  }
  Pose predict(const BodySchema& schema) const {
    return schema.edges[0].predict(schema.displacements(action_));
  }

  test::Rng rng_{7};
  BodySchema schema_ =
      LongArm({.num_joints = kJoints, .slides = 2}, test::LongFault::kNone, 0, 3).engineered();
  Eigen::VectorXd action_;
};

TEST_F(LongEdgeTest, ATransformStandsInTheLinkThatIsBent) {
  const Vector6d theta = 0.3 * test::gaussian6(rng_);
  for (int link = 0; link <= kJoints; ++link) {
    // By hand: the chain up to there, T, and the chain from there on.
    Edge first = schema_.edges[0], rest = first;
    first.right = Pose::Identity();
    first.joints.resize(static_cast<std::size_t>(link));
    rest.joints.erase(rest.joints.begin(), rest.joints.begin() + link);
    rest.left = Pose::Identity();
    if (link == 0) std::swap(first.left, rest.left);
    if (link == kJoints) std::swap(first.right, rest.right);
    const Eigen::VectorXd q = schema_.displacements(action_);
    const Pose expected = first.predict(q) * transform(theta) * rest.predict(q);
    EXPECT_TRUE(predict(changed(schema_, {Form::kBent, LongArm::kHand, link}, theta))
                    .isApprox(expected, 1e-9))
        << link;
  }
  EXPECT_FALSE(form_of({Form::kBent, LongArm::kHand, kJoints + 1})
                   .family.is_possible(schema_, {Form::kBent, LongArm::kHand, kJoints + 1}));
}

TEST_F(LongEdgeTest, EveryChangeIsPredictedAsItIsApplied) {
  const Eigen::VectorXd q = schema_.displacements(action_);
  const Edge& edge = schema_.edges[0];
  PlaceMeasurement m;
  m.displacements = q;
  m.X = edge.predict(q);
  m.links = link_poses(&edge, q, m.X);
  for (const BodyChange& change :
       possible_changes(schema_, edge_element(LongArm::kHand, LongArm::kRoot))) {
    SCOPED_TRACE("form " + std::to_string(static_cast<int>(change.form)) + " at " +
                 std::to_string(change.at));
    Eigen::VectorXd theta(change.size());
    for (double& t : theta) t = 0.2 * test::gaussian(rng_);
    const auto of = [&](const Eigen::VectorXd& t, ChangeJacobian* J) {
      return form_of(change).family.prediction(schema_, change, t)(m, J);
    };
    ChangeJacobian J(6, change.size());
    EXPECT_TRUE(of(theta, &J).isApprox(predict(changed(schema_, change, theta)), 1e-9));
    const auto numeric =
        test::numeric_jacobian([&](const auto& t) { return of(t, nullptr); }, theta);
    EXPECT_LT((J - numeric).norm(), 1e-6 * (1 + numeric.norm()));
    // θ's covariance becomes that of the prediction.
    if (change.size() == 0) continue;
    const Eigen::MatrixXd C = 1e-4 * Eigen::MatrixXd::Identity(change.size(), change.size());
    const Matrix6d added = changed(schema_, change, theta, C).edges[0].prediction_covariance(q) -
                           changed(schema_, change, theta).edges[0].prediction_covariance(q);
    const Matrix6d expected = J * C * J.transpose();
    if (change.form != Form::kGain)  // its covariance is at a displacement without offset
      EXPECT_LT((added - expected).norm(), 1e-6 * (1 + expected.norm()));
  }
}

TEST_F(LongEdgeTest, AnEdgeOfManyJointsChangesNoOftenerThanOneOfOne) {
  const auto odds = [](const BodySchema& schema, int part) {
    std::map<Form, double> sum;
    for (const BodyChange& change : possible_changes(schema, edge_element(part, LongArm::kRoot)))
      if (!change.small) sum[change.form] += std::exp(change.log_odds());
    return sum;
  };
  const auto of_many = odds(schema_, LongArm::kHand);
  const BodySchema one = LongArm({.num_joints = 1}, test::LongFault::kNone, 0, 3).engineered();
  for (const auto& [form, share] : odds(one, LongArm::kHand))
    EXPECT_NEAR(of_many.at(form), share, 1e-12) << static_cast<int>(form);
}

TEST_F(LongEdgeTest, TheJointBeforeABentLinkIsTold) {
  const Vector6d theta = 0.1 * test::gaussian6(rng_);
  for (int link = 0; link <= kJoints; ++link) {
    const BodyChange bent{Form::kBent, LongArm::kHand, link};
    EXPECT_EQ(size_of(schema_, bent, theta, {}).signal, link - 1);
    const FoundDifference found = difference_at(schema_, changed(schema_, bent, theta),
                                                edge_element(LongArm::kHand, LongArm::kRoot));
    EXPECT_EQ(found.cause, "geometry");
    EXPECT_EQ(found.size.signal, link - 1);
  }
}

}  // namespace
}  // namespace bodyschema
