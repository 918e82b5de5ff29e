#include "common/bus/convert.h"

#include <gtest/gtest.h>

#include <random>

#include "bodyschema/action_command_t.hpp"
#include "common/bus/check.h"
#include "common/bus/rest_position.h"
#include "tests/lcmtypes/example_messages.h"

namespace bodyschema::test {
namespace {

Pose random_pose(std::mt19937_64& rng) {
  std::normal_distribution<double> normal;
  return make_pose(Eigen::Quaterniond(normal(rng), normal(rng), normal(rng), normal(rng)),
                   Eigen::Vector3d(normal(rng), normal(rng), normal(rng)));
}

TEST(Convert, APoseSurvivesTheWireAndItsQuaternionIsUnitWithPositiveW) {
  std::mt19937_64 rng(1);
  for (int n = 0; n < 200; ++n) {
    const Pose X = random_pose(rng);
    const pose_t message = to_message(X);
    EXPECT_GE(message.rotation_wxyz[0], 0);
    EXPECT_TRUE(from_message(message).matrix().isApprox(X.matrix(), 1e-14));
  }
}

TEST(Convert, TheWireOrderIsWXYZ) {
  const pose_t message =
      to_message(make_pose(Eigen::Quaterniond(0.5, 0.5, -0.5, 0.5), Eigen::Vector3d(1, 2, 3)));
  EXPECT_DOUBLE_EQ(message.rotation_wxyz[0], 0.5);
  EXPECT_DOUBLE_EQ(message.rotation_wxyz[1], 0.5);
  EXPECT_DOUBLE_EQ(message.rotation_wxyz[2], -0.5);
  EXPECT_DOUBLE_EQ(message.rotation_wxyz[3], 0.5);
  EXPECT_EQ(message.position_m[2], 3);
}

TEST(Convert, AQuaternionThatPassesCheckBecomesARotation) {
  pose_t message = to_message(Pose::Identity());
  message.rotation_wxyz[0] = 1.0009;
  const Eigen::Matrix3d R = from_message(message).linear();
  EXPECT_TRUE((R * R.transpose()).isApprox(Eigen::Matrix3d::Identity(), 1e-14));
}

TEST(Convert, ASampleSurvivesTheWire) {
  const ActionPoseSample sample = from_message(example_sample());
  EXPECT_EQ(sample.sample_index, 12);
  EXPECT_EQ(sample.calibration_id, 99);
  EXPECT_EQ(sample.purpose, Purpose::kProbe);
  EXPECT_EQ(sample.action, Eigen::Vector2d(0.25, -0.5));
  ASSERT_EQ(sample.parts.size(), 2U);
  EXPECT_FALSE(sample.parts[0].X_CB_other);
  EXPECT_TRUE(sample.parts[1].X_CB_other);
  EXPECT_EQ(sample.parts[1].error_ratio, 2.5);

  const sample_t message = to_message(sample);
  EXPECT_EQ(check(message), "");
  const ActionPoseSample again = from_message(message);
  EXPECT_EQ(again.utime, sample.utime);
  EXPECT_EQ(again.calibration_id, 99);
  EXPECT_EQ(again.action, sample.action);
  for (std::size_t i = 0; i < sample.parts.size(); ++i) {
    EXPECT_EQ(again.parts[i].part, sample.parts[i].part);
    EXPECT_TRUE(again.parts[i].X_CB.isApprox(sample.parts[i].X_CB, 1e-14));
    EXPECT_EQ(again.parts[i].covariance, sample.parts[i].covariance);
    EXPECT_EQ(again.parts[i].X_CB_other.has_value(), sample.parts[i].X_CB_other.has_value());
    EXPECT_EQ(again.parts[i].error_ratio, sample.parts[i].error_ratio);
    EXPECT_EQ(again.parts[i].tags, sample.parts[i].tags);
  }
}

TEST(Convert, APositionAloneSurvivesTheWire) {
  ActionPoseSample sample = from_message(example_sample());
  PartObservation& alone = sample.parts[0];
  alone.has_rotation = false;
  alone.X_CB.linear().setIdentity();
  alone.X_CB_other.reset();
  alone.error_ratio = 0;
  alone.covariance.setZero();
  alone.covariance.diagonal().head<3>().setConstant(0.25);
  const sample_t message = to_message(sample);
  EXPECT_EQ(message.parts[0].has_rotation, 0);
  EXPECT_EQ(message.parts[1].has_rotation, 1);
  const ActionPoseSample again = from_message(message);
  EXPECT_FALSE(again.parts[0].has_rotation);
  EXPECT_EQ(again.parts[0].X_CB.matrix(), alone.X_CB.matrix());
  EXPECT_EQ(again.parts[0].covariance, alone.covariance);
  EXPECT_TRUE(again.parts[1].has_rotation);
}

TEST(Convert, ABodySchemaSurvivesTheWire) {
  const body_schema_t message = example_body_schema();
  const BodySchema schema = from_message(message);
  EXPECT_EQ(schema.version, 4);
  EXPECT_EQ(schema.root, 2);
  EXPECT_EQ(schema.position_parts, (std::vector<int>{5, 9}));
  EXPECT_EQ(to_message(schema).position_parts, message.position_parts);
  EXPECT_EQ(schema.edges[0].state, EdgeState::kSuspect);
  EXPECT_EQ(schema.unconnected[0].reason, Unconnected::kNoValidModel);
  ASSERT_EQ(schema.edges[0].parameter_covariance.rows(), 22);
  EXPECT_EQ(schema.edges[0].parameter_covariance, schema.edges[0].parameter_covariance.transpose());

  const body_schema_t again = to_message(schema);
  EXPECT_EQ(check(again), "");
  const BodySchema twice = from_message(again);
  ASSERT_EQ(twice.edges.size(), schema.edges.size());
  const Eigen::Vector2d action(0.3, -0.7);
  for (std::size_t i = 0; i < schema.edges.size(); ++i) {
    EXPECT_TRUE(twice.edges[i].predict(action).isApprox(schema.edges[i].predict(action), 1e-13));
    EXPECT_EQ(twice.edges[i].parameter_covariance, schema.edges[i].parameter_covariance);
  }
  EXPECT_EQ(schema.edges[0].joints[0].order_group, 3);
  EXPECT_EQ(twice.edges[0].joints[1].order_group, 3);
  EXPECT_EQ(twice.edges[2].joints[0].order_group, -1);
  EXPECT_EQ(schema.edges[0].joints[0].scatter, 0.01);
  EXPECT_EQ(twice.edges[0].joints[0].scatter, 0.01);
  EXPECT_EQ(twice.calibration_id, 99);
  EXPECT_EQ(twice.X_CR_covariance, schema.X_CR_covariance);
  EXPECT_EQ(twice.parts, schema.parts);
  EXPECT_EQ(twice.noise.position_m, schema.noise.position_m);
  ASSERT_EQ(schema.moved_tags.size(), 1U);
  EXPECT_EQ(schema.moved_tags[0], (MovedTag{11, 34, 31, 45}));
  EXPECT_EQ(twice.moved_tags, schema.moved_tags);
}

TEST(Convert, AParameterCovarianceKeepsFloatPrecision) {
  std::mt19937_64 rng(3);
  std::normal_distribution<double> normal;
  BodySchema schema = from_message(example_body_schema());
  Eigen::MatrixXd root(22, 22);
  for (double& value : root.reshaped()) value = 1e-3 * normal(rng);
  schema.edges[0].parameter_covariance = root * root.transpose();
  const body_schema_t message = to_message(schema);
  EXPECT_EQ(check(message), "");
  const Eigen::MatrixXd found = from_message(message).edges[0].parameter_covariance;
  EXPECT_TRUE(found.isApprox(schema.edges[0].parameter_covariance, 1e-6));
}

TEST(Convert, AnEdgeOfEightJointsSurvivesTheWire) {
  std::mt19937_64 rng(4);
  std::uniform_real_distribution<double> unit(-1, 1);
  BodySchema schema;
  schema.parts = {1, 2};
  schema.root = 1;
  schema.complete = true;
  Edge edge;
  edge.from = 1;
  edge.to = 2;
  for (int s = 7; s >= 0; --s) {
    std::string name = "q";
    schema.signals.push_back({name += std::to_string(7 - s), -1, 1, {}});
    ScrewJoint joint{.signal = s, .offset = unit(rng), .turn = unit(rng)};
    if (s == 2) std::swap(joint.slide, joint.turn);
    if (s == 3 || s == 4) joint.order_group = 1;
    Vector6d xi;
    for (double& value : xi) value = unit(rng);
    joint.X_after = exp(xi);
    edge.joints.push_back(joint);
  }
  const Eigen::Index side = 6 + 8 * 8;
  const Eigen::MatrixXd root = Eigen::MatrixXd::NullaryExpr(side, side, [&] { return unit(rng); });
  edge.parameter_covariance = 1e-6 * root * root.transpose();
  schema.edges = {edge};

  const body_schema_t message = to_message(schema);
  EXPECT_EQ(check(message), "");
  EXPECT_EQ(message.edges[0].num_joints, 8);
  EXPECT_EQ(message.edges[0].parameter_covariance.size(), 70U * 71 / 2);
  EXPECT_LT(message.getEncodedSize(), 64000);  // one datagram
  const Edge found = from_message(message).edges[0];
  ASSERT_EQ(found.joints.size(), 8U);
  for (std::size_t d = 0; d < 8; ++d) {
    EXPECT_EQ(found.joints[d].signal, edge.joints[d].signal);
    EXPECT_EQ(found.joints[d].order_group, edge.joints[d].order_group);
  }
  EXPECT_TRUE(found.parameter_covariance.isApprox(edge.parameter_covariance, 1e-6));
  const Eigen::VectorXd q = Eigen::VectorXd::NullaryExpr(8, [&] { return unit(rng); });
  EXPECT_TRUE(found.predict(q).isApprox(edge.predict(q), 1e-12));
}

TEST(Convert, GaussianProcessesSurviveTheWireToTheLastBit) {
  const BodySchema schema = from_message(example_body_schema());
  EXPECT_STREQ(schema.edges[2].kind(), "screw_gp");
  EXPECT_STREQ(schema.edges[3].kind(), "matrix_gp");
  EXPECT_EQ(schema.edges[2].signals(), (std::vector<int>{0, 1}));
  const BodySchema again = from_message(to_message(schema));
  const Eigen::Vector2d action(0.3, -0.7);
  EXPECT_EQ(again.edges[2].residual_gp->mean(action), schema.edges[2].residual_gp->mean(action));
  EXPECT_EQ(again.edges[2].residual_gp->variance(action),
            schema.edges[2].residual_gp->variance(action));
  EXPECT_GT(schema.edges[2].residual_gp->mean(action).norm(), 0);
  for (const std::size_t edge : {2, 3}) {
    EXPECT_TRUE(again.edges[edge].has_process_of(schema.edges[edge]));
    EXPECT_FALSE(again.edges[edge].has_process_of(schema.edges[5 - edge]));
  }
  EXPECT_TRUE(again.edges[3].matrix_gp->prediction_covariance(action).isApprox(
      schema.edges[3].matrix_gp->prediction_covariance(action), 1e-9));
}

MatrixGp matrix_gp_of(int num_samples, std::optional<double> mean) {
  const std::vector<GpPrior> priors(MatrixGp::kNumEntries, {mean, SquaredExponential{1, {}}, 1});
  return {{},
          Eigen::MatrixXd(0, num_samples),
          std::vector<Pose>(num_samples, Pose::Identity()),
          priors};
}

TEST(Convert, AMatrixGpThatNoMessageHoldsIsRefused) {
  BodySchema schema;
  Edge& edge = schema.edges.emplace_back();
  const auto holds = [&](MatrixGp gp) {
    edge.matrix_gp = std::make_shared<const MatrixGp>(std::move(gp));
    to_message(schema);
  };
  EXPECT_NO_THROW(holds(matrix_gp_of(64, std::nullopt)));
  EXPECT_THROW(holds(matrix_gp_of(65, std::nullopt)), std::invalid_argument);
  EXPECT_THROW(holds(matrix_gp_of(3, 0.5)), std::invalid_argument);
}

TEST(Convert, AnEmptySchemaIsAMessageThatMakesSense) {
  EXPECT_EQ(check(to_message(BodySchema{})), "");
}

TEST(RestPosition, IsKnownOnlyWhereTheDriverSaysThatTheArmIs) {
  motion_status_t status{};
  status.action_id = 7;
  status.kind = action_command_t::KIND_MOVE;
  status.rest_since_utime = 1;
  status.num_signals = 2;
  status.commanded = {0.5, -2};
  const auto position = [&](std::int8_t state) {
    status.state = state;
    return rest_position(status, 2);
  };
  EXPECT_EQ(position(motion_status_t::STATE_SETTLED), Eigen::Vector2d(0.5, -2));
  // The action of a MOVE that was not carried out is not where the arm is.
  for (const auto state : {motion_status_t::STATE_REJECTED, motion_status_t::STATE_STOPPED,
                           motion_status_t::STATE_EXPIRED, motion_status_t::STATE_ACCEPTED})
    EXPECT_FALSE(position(state));
  status.rest_since_utime = -1;
  EXPECT_FALSE(position(motion_status_t::STATE_SETTLED));
  status.rest_since_utime = 1;
  status.kind = action_command_t::KIND_HOLD;
  EXPECT_TRUE(position(motion_status_t::STATE_HOLDING));
  EXPECT_FALSE(rest_position(status, 3));
}

}  // namespace
}  // namespace bodyschema::test
