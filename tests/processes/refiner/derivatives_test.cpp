#include <gtest/gtest.h>

#include <Eigen/Core>
#include <memory>
#include <utility>
#include <vector>

#include "common/geometry/angle.h"
#include "processes/refiner/calibrated_lens.h"
#include "processes/refiner/residuals.h"
#include "tests/processes/refiner/tagged_robot.h"

namespace bodyschema {
namespace {

using test::Rng;

using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

ParameterBlock pose_block(ParameterBlock::Kind kind, const Pose& X) {
  ParameterBlock block;
  block.kind = kind;
  block.add(X);
  block.free = {0, 1, 2, 3, 4, 5};
  return block;
}

/// Compares the derivative by every free direction of every block with central differences.
void expect_right_derivatives(const ceres::CostFunction& cost,
                              const std::vector<const ParameterBlock*>& blocks, double tolerance) {
  std::vector<std::vector<double>> values;
  std::vector<RowMajor> J;
  for (const ParameterBlock* block : blocks) {
    values.push_back(block->values);
    J.emplace_back(cost.num_residuals(), std::ssize(block->values));
  }
  std::vector<const double*> parameters;
  std::vector<double*> jacobians;
  for (std::size_t b = 0; b < blocks.size(); ++b) {
    parameters.push_back(values[b].data());
    jacobians.push_back(J[b].data());
  }
  const auto evaluate = [&](double** derivatives) {
    Eigen::VectorXd residuals(cost.num_residuals());
    EXPECT_TRUE(cost.Evaluate(parameters.data(), residuals.data(), derivatives));
    return residuals;
  };
  evaluate(jacobians.data());
  constexpr double kStep = 1e-6;
  for (std::size_t b = 0; b < blocks.size(); ++b) {
    for (int n = 0; n < blocks[b]->num_free(); ++n) {
      const auto moved = [&](double step) {
        const Eigen::VectorXd delta = step * Eigen::VectorXd::Unit(blocks[b]->num_free(), n);
        blocks[b]->plus(blocks[b]->values.data(), delta.data(), values[b].data());
        const Eigen::VectorXd residuals = evaluate(nullptr);
        values[b] = blocks[b]->values;
        return residuals;
      };
      const Eigen::VectorXd numeric = (moved(kStep) - moved(-kStep)) / (2 * kStep);
      EXPECT_LT((J[b].col(n) - numeric).norm(), tolerance * (1 + numeric.norm()))
          << "block " << b << ", direction " << blocks[b]->free[n];
    }
  }
}

/// A rigid edge, one of three joints and one of one joint that slides.
struct ThreeEdges {
  explicit ThreeEdges(Rng& rng) {
    edges = {test::random_edge(1, 2, {}, rng), test::random_edge(2, 3, {0, 1, 0}, rng),
             test::random_edge(3, 4, {2}, rng)};
    edges[2].joints[0].turn = 0;
    for (int e = 0; e < 3; ++e) storage.push_back(edge_block(edges[e], e, false));
    root = pose_block(ParameterBlock::Kind::kRoot, test::random_pose(rng, 0, 0.1));
    Pose X_CR = pose_at(root.values.data());
    X_CR.translation().z() += 2;
    std::copy_n(X_CR.matrix().data(), 16, root.values.data());
    blocks = {&root, &storage[0], &storage[1], &storage[2]};
  }
  PartChain chain() const { return {{&edges[0], &edges[1], &edges[2]}, theta}; }
  Pose X_CB() const {
    return pose_at(root.values.data()) * edges[0].predict(theta) * edges[1].predict(theta) *
           edges[2].predict(theta);
  }

  std::vector<Edge> edges;
  std::vector<ParameterBlock> storage;
  ParameterBlock root;
  std::vector<const ParameterBlock*> blocks;
  const Eigen::Vector3d theta{0.3, -0.7, 0.5};
  NoiseScale scale{1.7};
};

/// The root's pose and how far the four joints are off their commands.
ParameterBlock instant_of(const ThreeEdges& robot, Rng& rng) {
  ParameterBlock instant =
      pose_block(ParameterBlock::Kind::kInstant, pose_at(robot.root.values.data()));
  for (int n = 0; n < 4; ++n) {
    instant.free.push_back(6 + n);
    instant.add(0.01 * test::gaussian(rng));
  }
  return instant;
}

TEST(Residuals, ChainIsThatOfTheSchemasEdges) {
  Rng rng(1);
  const ThreeEdges robot(rng);
  std::vector<const double*> values;
  for (const ParameterBlock* block : robot.blocks) values.push_back(block->values.data());
  const Pose X = robot.chain().pose(values.data(), Pose::Identity(), nullptr);
  EXPECT_TRUE(X.isApprox(robot.X_CB(), 1e-12));
}

TEST(Residuals, OfCornersHaveTheirDerivatives) {
  Rng rng(2);
  ThreeEdges robot(rng);
  const RigCalibration rig = test::tagged(test::chapter_robot("a", rng), 1, rng).truth;
  ParameterBlock plays, drive;
  plays.kind = ParameterBlock::Kind::kInstant;
  drive.kind = ParameterBlock::Kind::kDrive;
  plays.free = {0, 1, 2, 3};
  drive.free = {0, 1};
  for (int n = 0; n < 4; ++n) plays.add(0.01 * test::gaussian(rng));
  for (int n = 0; n < 2; ++n) drive.add(0.1 * test::gaussian(rng));
  const Eigen::MatrixXd of_drive{{0.3, 0}, {0.2, 0.5}, {0, -0.4}, {0.1, 0.7}};
  const auto effects = std::make_shared<const Eigen::MatrixXd>(of_drive);
  const PartChain moved({&robot.edges[0], &robot.edges[1], &robot.edges[2]}, robot.theta,
                        {{&robot.edges[1], 0}, {&robot.edges[2], 3}});
  for (const auto model :
       {CameraCalibration::Model::kPlumbBob, CameraCalibration::Model::kFisheye}) {
    CameraCalibration camera = rig.camera;
    camera.model = model;
    const Lens lens = lens_of(camera);
    ParameterBlock tag = pose_block(ParameterBlock::Kind::kTag, test::random_pose(rng, 0, 0.1));
    tag.add(1.01);
    tag.free.push_back(6);
    ParameterBlock lens_block;
    lens_block.kind = ParameterBlock::Kind::kLens;
    for (const double parameter : lens.parameters()) {
      lens_block.free.push_back(static_cast<int>(lens_block.values.size()));
      lens_block.add(parameter);
    }
    robot.blocks.resize(4);
    robot.blocks.push_back(&tag);
    robot.blocks.push_back(&lens_block);
    TagSight sight;
    sight.corners_px.setConstant(600);
    Matrix8d covariance = 0.01 * Matrix8d::Identity();
    covariance(0, 3) = covariance(3, 0) = 0.004;
    const auto expect_right = [&](const PartChain& chain, const DriveEffects& by_drive) {
      const CornerResidual cost(chain, robot.blocks, 0.06, lens, sight, covariance, robot.scale,
                                by_drive);
      expect_right_derivatives(cost, robot.blocks, 1e-6);
    };
    expect_right(robot.chain(), {});
    robot.blocks.push_back(&plays);
    expect_right(moved, {});
    robot.blocks.push_back(&drive);
    expect_right(moved, effects);
    // Of a root that moves, the plays are in its block.
    ParameterBlock instant = instant_of(robot, rng);
    const ParameterBlock* const rests = std::exchange(robot.blocks[0], &instant);
    robot.blocks.erase(robot.blocks.end() - 2);
    expect_right(moved, effects);
    robot.blocks[0] = rests;
  }
}

TEST(Residuals, OfPosesAndPositionsHaveTheirDerivatives) {
  Rng rng(3);
  const ThreeEdges robot(rng);
  PartObservation observation;
  observation.X_CB = robot.X_CB() * exp(Vector6d(0.1 * test::gaussian6(rng)));
  observation.covariance = isotropic({0.003, 0.02});
  const PoseResidual pose(robot.chain(), robot.blocks, observation, {}, robot.scale);
  expect_right_derivatives(pose, robot.blocks, 1e-6);
  const PositionResidual position(robot.chain(), robot.blocks, observation, {}, robot.scale);
  expect_right_derivatives(position, robot.blocks, 1e-6);
}

TEST(Residuals, OfElasticJointsHaveTheirDerivatives) {
  Rng rng(3);
  ThreeEdges robot(rng);
  ParameterBlock compliances;
  compliances.kind = ParameterBlock::Kind::kDrive;
  for (int n = 0; n < 4; ++n) compliances.add(0.01 * test::gaussian(rng));
  compliances.free = {0, 2, 3};
  Eigen::Matrix4d effects = Eigen::Vector4d(3, 5, -4, 6).asDiagonal();
  effects(1, 3) = effects(2, 0) = 0.7;
  const PartChain chain({&robot.edges[0], &robot.edges[1], &robot.edges[2]}, robot.theta,
                        {{&robot.edges[1], 0}, {&robot.edges[2], 3}});
  robot.blocks.push_back(&compliances);
  PartObservation observation;
  observation.X_CB = robot.X_CB() * exp(Vector6d(0.1 * test::gaussian6(rng)));
  observation.covariance = isotropic({0.003, 0.02});
  const auto shared = std::make_shared<const Eigen::MatrixXd>(effects);
  const PoseResidual pose(chain, robot.blocks, observation, {}, robot.scale, shared);
  expect_right_derivatives(pose, robot.blocks, 1e-6);
  const PositionResidual position(chain, robot.blocks, observation, {}, robot.scale, shared);
  expect_right_derivatives(position, robot.blocks, 1e-6);
  // With joints that are off their commands, too.
  ParameterBlock plays;
  plays.kind = ParameterBlock::Kind::kInstant;
  for (int n = 0; n < 4; ++n) plays.add(0.01 * test::gaussian(rng));
  plays.free = {0, 1, 2, 3};
  robot.blocks.insert(robot.blocks.end() - 1, &plays);
  const auto expect_right_with_plays = [&] {
    const PoseResidual loose(chain, robot.blocks, observation, {}, robot.scale, shared);
    expect_right_derivatives(loose, robot.blocks, 1e-6);
    const PositionResidual loose_position(chain, robot.blocks, observation, {}, robot.scale,
                                          shared);
    expect_right_derivatives(loose_position, robot.blocks, 1e-6);
  };
  expect_right_with_plays();
  ParameterBlock instant = instant_of(robot, rng);
  robot.blocks[0] = &instant;
  robot.blocks.erase(robot.blocks.end() - 2);
  expect_right_with_plays();
}

TEST(Residuals, OfAFlippedPoseAreThoseOfItsOtherReading) {
  Rng rng(4);
  const ThreeEdges robot(rng);
  PartObservation observation;
  Vector6d flip = Vector6d::Zero();
  flip(3) = 40 * kDegree;
  observation.X_CB = robot.X_CB() * exp(flip);
  observation.X_CB_other = robot.X_CB();
  observation.error_ratio = 2;
  observation.covariance = isotropic({0.003, 0.02});
  const PoseResidual cost(robot.chain(), robot.blocks, observation, {}, robot.scale);
  std::vector<const double*> values;
  for (const ParameterBlock* block : robot.blocks) values.push_back(block->values.data());
  Vector6d residuals;
  ASSERT_TRUE(cost.Evaluate(values.data(), residuals.data(), nullptr));
  EXPECT_LT(residuals.norm(), 1e-9);
}

TEST(ParameterBlock, OfAnEdgeMovesWhatPosesDependOnAndNothingElse) {
  Rng rng(5);
  Edge edge = test::random_edge(1, 2, {0, 1}, rng);
  // Axes of 4 directions, slides, turns, and the last transform.
  EXPECT_EQ(edge_block(edge, 0, false).num_free(), 2 * (4 + 2) + 6);
  edge.joints[0].slide = 0;
  edge.joints[1].turn = 0;
  EXPECT_EQ(edge_block(edge, 0, false).num_free(), (4 + 1) + (2 + 1) + 6);
  EXPECT_EQ(edge_block(edge, 0, true).num_free(), (4 + 1) + (2 + 1) + 3);
  edge.joints[0].gain = 0;  // stuck
  EXPECT_EQ(edge_block(edge, 0, false).num_free(), (2 + 1) + 6);
  const Eigen::Vector2d theta(0.2, 0.4);
  EXPECT_TRUE(edge_from(edge_block(edge, 0, false), edge)
                  .predict(theta)
                  .isApprox(edge.predict(theta), 1e-12));
}

}  // namespace
}  // namespace bodyschema
