#include "processes/model_monitor/changes/change_size.h"

#include <gtest/gtest.h>

#include <cmath>

#include "tests/processes/model_monitor/changed_arm.h"

namespace bodyschema {
namespace {

using Kind = ChangeSize::Kind;

class ChangeSizeTest : public ChangedArm {
 protected:
  ChangeSizeTest() : ChangedArm(3) {
    for (Edge& edge : schema_.edges) edge.right = test::random_pose(rng_, 0.05, 0.1);
    schema_.signals[2] = {"q3", -1, 3, {0.2, -0.1}};
    schema_.edges[2].joints[0].gain = 1.2;
    schema_.edges[2].joints[0].offset = 0.3;
  }
  ChangeSize size(const BodyChange& change, const Eigen::VectorXd& theta) const {
    return size_of(schema_, change, theta, {});
  }
};

TEST_F(ChangeSizeTest, AStuckJointStandsAtTheCommandThatLedThere) {
  for (const double command : {-1.0, -0.4, 0.7, 2.9}) {
    const double displacement = 1.2 * schema_.signals[2].displacement(command) + 0.3;
    const ChangeSize size = this->size({Form::kStuck, kPart}, vector({displacement}));
    EXPECT_EQ(size.kind, Kind::kCommand);
    EXPECT_EQ(size.signal, 2);
    ASSERT_EQ(size.amounts.size(), 1U);
    EXPECT_NEAR(size.amounts[0], command, 1e-9);
    EXPECT_EQ(size.sds, std::vector<double>{-1});
    // The schema with it agrees with the healthy one there.
    const BodySchema stuck = changed(schema_, {Form::kStuck, kPart}, vector({displacement}));
    Eigen::VectorXd action = Eigen::VectorXd::Zero(7);
    const Pose stands = edge_to(stuck, kPart)->predict(stuck.displacements(action));
    action(2) = size.amounts[0];
    EXPECT_TRUE(
        stands.isApprox(edge_to(schema_, kPart)->predict(schema_.displacements(action)), 1e-9));
  }
}

TEST_F(ChangeSizeTest, OffsetAndGainAreThoseOfTheCommand) {
  EXPECT_NEAR(size({Form::kOffset, kPart}, vector({0.6})).amounts[0], 0.5, 1e-12);
  const ChangeSize gain = size({Form::kGain, kPart}, vector({-0.3, 0.1}));
  EXPECT_EQ(gain.kind, Kind::kFactor);
  EXPECT_NEAR(gain.amounts[0], 0.7, 1e-12);
}

TEST_F(ChangeSizeTest, AToolIsAsFarAwayAsItIs) {
  const Eigen::VectorXd theta = vector({0.03, 0, 0.04, 0, 0.5, 0});
  const ChangeSize tool = size({Form::kBent, kPart, 1}, theta);
  EXPECT_EQ(tool.kind, Kind::kPose);
  EXPECT_NEAR(tool.amounts[0], 0.05, 1e-9);
  EXPECT_NEAR(tool.amounts[1], 0.5, 1e-9);
  // Bent before the joint: the part goes as far as its lever says, the angle is the same.
  Vector6d bend = Vector6d::Zero();
  bend(4) = 0.5;
  const ChangeSize bent = size({Form::kBent, kPart}, bend);
  Eigen::VectorXd middle = Eigen::VectorXd::Zero(7);
  middle(2) = 1;
  const Pose X = edge_to(schema_, kPart)->predict(schema_.displacements(middle));
  EXPECT_NEAR(bent.amounts[0], (transform(bend) * X.translation() - X.translation()).norm(), 1e-9);
  EXPECT_NEAR(bent.amounts[1], 0.5, 1e-9);
}

TEST_F(ChangeSizeTest, ACameraWasKnockedAsFarAsItsOwnFrameMoved) {
  test::Rng rng(5);
  Pose knock = Pose::Identity();  // of the camera, in its frame of before
  knock.linear() = exp_so3({0.1, 0, 0});
  knock.translation() << 0.02, 0.01, 0;
  const Pose T = schema_.X_CR.inverse() * knock.inverse() * schema_.X_CR;
  const ChangeSize size = this->size({Form::kCamera, schema_.root}, coordinates(T));
  EXPECT_NEAR(size.amounts[0], knock.translation().norm(), 1e-9);
  EXPECT_NEAR(size.amounts[1], 0.1, 1e-9);
}

// θ scatters by A times unit noise: a standard deviation is the norm of the derivatives along its
// columns.
TEST_F(ChangeSizeTest, StandardDeviationsAreThoseOfTheAmounts) {
  for (const Case& c : cases()) {
    SCOPED_TRACE(static_cast<int>(c.change.form));
    const Eigen::Index d = c.theta.size();
    const Eigen::MatrixXd A =
        0.001 * Eigen::MatrixXd::NullaryExpr(d, d, [&] { return test::gaussian(rng_); });
    const ChangeSize size = size_of(schema_, c.change, c.theta, A * A.transpose());
    for (std::size_t i = 0; i < size.amounts.size(); ++i) {
      double variance = 0;
      for (const auto& step : A.colwise()) {
        const double more = this->size(c.change, c.theta + step).amounts[i],
                     less = this->size(c.change, c.theta - step).amounts[i];
        variance += std::pow((more - less) / 2, 2);
      }
      EXPECT_NEAR(size.sds[i], std::sqrt(variance), 1e-3 * size.sds[i]) << i;
    }
  }
}

TEST_F(ChangeSizeTest, WhatHasNoParametersHasNoSize) {
  for (const Form form : {Form::kStored, Form::kNonlinear, Form::kFresh})
    EXPECT_EQ(size({form, kPart}, {}).kind, Kind::kUnknown);
  const ChangeSize other = size({Form::kOtherSignal, kPart, 0, 5}, {});
  EXPECT_EQ(other.kind, Kind::kUnknown);
  EXPECT_EQ(other.signal, 5);
  // A joint that is not there, an edge that is not there.
  EXPECT_EQ(size({Form::kStuck, kPart, 3}, vector({1})).kind, Kind::kUnknown);
  EXPECT_EQ(size({Form::kBent, 99, 1}, Vector6d::Zero()).kind, Kind::kUnknown);
}

TEST_F(ChangeSizeTest, WhatTwoModelsDifferByIsTheChangeBetweenThem) {
  const auto between = [&](const BodyChange& change, const Eigen::VectorXd& theta) {
    return difference_at(schema_, changed(schema_, change, theta),
                         {ElementId::Kind::kJoint, kPart});
  };
  const FoundDifference stuck = between({Form::kStuck, kPart}, vector({0.9}));
  EXPECT_EQ(stuck.cause, "joint_stuck");
  EXPECT_NEAR(stuck.size.amounts[0], size({Form::kStuck, kPart}, vector({0.9})).amounts[0], 1e-9);
  EXPECT_EQ(between({Form::kOffset, kPart}, vector({0.6})).cause, "joint_offset");
  EXPECT_NEAR(between({Form::kGain, kPart}, vector({-0.3, 0.1})).size.amounts[0], 0.7, 1e-12);
  const Eigen::VectorXd theta = vector({0.03, 0, 0.04, 0, 0.5, 0});
  const FoundDifference tool = between({Form::kBent, kPart, 1}, theta);
  EXPECT_EQ(tool.cause, "geometry");
  EXPECT_NEAR(tool.size.amounts[0], 0.05, 1e-9);
}

}  // namespace
}  // namespace bodyschema
