#include "common/kinematics/kinematic_path.h"

#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::random_edge;
using test::Rng;

/// A matrix GP of the two signals, through 30 poses of a screw edge.
Edge matrix_gp_edge(int from, int to, Rng& rng) {
  Edge edge = random_edge(from, to, {1, 3}, rng);
  Eigen::MatrixXd inputs(2, 30);
  std::vector<Pose> poses;
  for (int t = 0; t < 30; ++t) {
    Eigen::VectorXd q = Eigen::VectorXd::Zero(4);
    q(1) = inputs(0, t) = test::uniform(rng, -1, 1);
    q(3) = inputs(1, t) = test::uniform(rng, -1, 1);
    poses.push_back(edge.predict(q));
  }
  const GpPrior prior{std::nullopt, SquaredExponential{1, Eigen::Vector2d(1, 1)}, 1e-3};
  edge.joints.clear();
  edge.matrix_gp = std::make_shared<const MatrixGp>(std::vector<int>{1, 3}, inputs, poses,
                                                    std::vector<GpPrior>(12, prior));
  return edge;
}

Signal bent_signal(const std::string& name, Rng& rng) {
  Signal signal{name, -1.2, 1.1, {}};
  for (int n = 1; n <= 20; ++n) signal.warp.push_back(test::uniform(rng, -0.1, 0.1) / (n * n));
  return signal;
}

// 1 → 2 → 3 → 6 (rigid), 2 → 4 → 7 (matrix GP); 5 alone. Signal 0 moves two edges and is bent, as
// is signal 1.
BodySchema random_schema(Rng& rng) {
  BodySchema schema;
  schema.parts = {1, 2, 3, 4, 5, 6, 7};
  schema.root = 1;
  schema.signals = {
      bent_signal("q1", rng), bent_signal("q2", rng), {"q3", -1, 1, {}}, {"q4", -1, 1, {}}};
  schema.edges = {random_edge(1, 2, {0}, rng), random_edge(2, 3, {1, 2}, rng),
                  random_edge(2, 4, {0}, rng), random_edge(3, 6, {}, rng),
                  matrix_gp_edge(4, 7, rng)};
  return schema;
}

Eigen::VectorXd random_action(Rng& rng) {
  return Eigen::VectorXd::NullaryExpr(4, [&] { return test::uniform(rng, -1, 1); });
}

const std::vector<std::pair<int, int>> kWays = {{1, 1}, {1, 2}, {1, 6}, {6, 1}, {6, 4},
                                                {4, 6}, {3, 4}, {1, 7}, {7, 1}, {6, 7}};

/// The parts from one to the other, by hand.
std::vector<int> parts_between(int from, int to) {
  const std::map<int, std::vector<int>> from_root = {
      {1, {1}}, {2, {1, 2}}, {3, {1, 2, 3}}, {4, {1, 2, 4}}, {6, {1, 2, 3, 6}}, {7, {1, 2, 4, 7}}};
  const std::vector<int>& down = from_root.at(from);
  const std::vector<int>& up = from_root.at(to);
  std::size_t common = 0;
  while (common < std::min(down.size(), up.size()) && down[common] == up[common]) ++common;
  std::vector<int> parts(down.rbegin(), down.rend() - static_cast<std::ptrdiff_t>(common) + 1);
  parts.insert(parts.end(), up.begin() + static_cast<std::ptrdiff_t>(common), up.end());
  return parts;
}

/// What the path folds into a few products, an edge at a time: pose, covariance, Jacobian by θ.
struct ByEdges {
  Pose X = Pose::Identity();
  Matrix6d first_order = Matrix6d::Zero(), empirical = Matrix6d::Zero();
  Eigen::MatrixXd jacobian = Eigen::MatrixXd::Zero(6, 4);

  ByEdges(const BodySchema& schema, int from, int to, const Eigen::VectorXd& theta) {
    const std::vector<int> parts = parts_between(from, to);
    for (std::size_t n = 1; n < parts.size(); ++n) {
      for (const Edge& edge : schema.edges) {
        const bool is_forward = edge.from == parts[n - 1] && edge.to == parts[n];
        if (!is_forward && !(edge.from == parts[n] && edge.to == parts[n - 1])) continue;
        Pose step = edge.predict(theta);
        // In the frame that the step ends in, of the step walked this way.
        Matrix6d A = Matrix6d::Identity();
        if (!is_forward) {
          A = -adjoint(step);
          step = step.inverse();
        }
        const Matrix6d B = adjoint(step.inverse());
        const auto propagate = [&](Matrix6d* sum, const Matrix6d& covariance) {
          *sum = B * *sum * B.transpose() + A * covariance * A.transpose();
        };
        propagate(&first_order, edge.prediction_covariance(theta));
        Vector6d variances;
        variances << Eigen::Vector3d::Constant(std::pow(edge.position_rms_m, 2) / 3),
            Eigen::Vector3d::Constant(std::pow(edge.rotation_rms_rad, 2) / 3);
        propagate(&empirical, variances.asDiagonal());
        jacobian = B * jacobian + A * edge.jacobian(theta);
        X = X * step;
      }
    }
  }
};

TEST(KinematicPath, PredictsWhatItsEdgesPredictOneByOne) {
  Rng rng(1);
  for (int n = 0; n < 5; ++n) {
    const BodySchema schema = random_schema(rng);
    for (const auto& [from, to] : kWays) {
      const auto path = KinematicPath::between(schema, from, to);
      ASSERT_TRUE(path);
      const Eigen::VectorXd q = random_action(rng), theta = schema.displacements(q);
      const ByEdges expected(schema, from, to, theta);
      PoseJacobian J;
      EXPECT_TRUE(path->predict(q).isApprox(expected.X, 1e-12)) << from << " " << to;
      EXPECT_TRUE(path->predict(q, &J).isApprox(expected.X, 1e-12)) << from << " " << to;
      Eigen::MatrixXd by_action = expected.jacobian;
      for (int s = 0; s < 4; ++s) by_action.col(s) *= schema.signals[s].displacement_rate(q(s));
      EXPECT_LT((J - by_action).norm(), 1e-11 * (1 + by_action.norm())) << from << " " << to;
      EXPECT_LT((path->covariance(q, Variance::kFirstOrder) - expected.first_order).norm(),
                1e-10 * (1e-12 + expected.first_order.norm()));
      EXPECT_LT((path->covariance(q, Variance::kEmpirical) - expected.empirical).norm(),
                1e-10 * (1e-12 + expected.empirical.norm()));
    }
  }
}

TEST(KinematicPath, JacobianByBentCommandsAgreesWithCentralDifferences) {
  Rng rng(2);
  for (int n = 0; n < 5; ++n) {
    const BodySchema schema = random_schema(rng);
    for (const auto& [from, to] : kWays) {
      const auto path = KinematicPath::between(schema, from, to);
      Eigen::VectorXd q = random_action(rng);
      if (n == 4) q(0) = 1.4;  // beyond the limits, where the warp stays what it is there
      PoseJacobian J;
      const Pose inverse = path->predict(q, &J).inverse();
      const double h = 1e-6;
      for (int s = 0; s < 4; ++s) {
        const Eigen::VectorXd step = h * Eigen::VectorXd::Unit(4, s);
        const Vector6d numeric =
            (log(inverse * path->predict(q + step)) - log(inverse * path->predict(q - step))) /
            (2 * h);
        EXPECT_LT((J.col(s) - numeric).norm(), 1e-8) << from << " " << to << " " << s;
      }
    }
  }
}

/// 1 → 2 by six joints, of which the third slides; 2 → 3 by one of their signals.
BodySchema long_schema(Rng& rng) {
  BodySchema schema;
  schema.parts = {1, 2, 3};
  schema.root = 1;
  for (const char* name : {"a", "b", "c", "d", "e", "f"})
    schema.signals.push_back(bent_signal(name, rng));
  schema.edges = {random_edge(1, 2, {4, 0, 2, 5, 1, 3}, rng), random_edge(2, 3, {5}, rng)};
  schema.edges[0].joints[2].turn = 0;
  return schema;
}

TEST(KinematicPath, AlongALongEdgeJacobianAgreesWithCentralDifferencesAndCovarianceWithItsEdges) {
  Rng rng(6);
  for (int n = 0; n < 10; ++n) {
    const BodySchema schema = long_schema(rng);
    const Eigen::VectorXd q =
        Eigen::VectorXd::NullaryExpr(6, [&] { return test::uniform(rng, -1, 1); });
    const Eigen::VectorXd theta = schema.displacements(q);
    for (const auto& [from, to] : {std::pair{1, 2}, {2, 1}, {1, 3}, {3, 1}}) {
      const auto path = KinematicPath::between(schema, from, to);
      PoseJacobian J;
      path->predict(q, &J);
      const auto predict = [&](const Eigen::VectorXd& a) { return path->predict(a); };
      EXPECT_LT((J - test::numeric_jacobian(predict, q)).norm(), 1e-7) << from << " " << to;
    }
    const Edge &first = schema.edges[0], &second = schema.edges[1];
    EXPECT_EQ(first.num_parameters(), 6 + 8 * 6);
    const auto forward = KinematicPath::between(schema, 1, 3);
    EXPECT_TRUE(forward->predict(q).isApprox(first.predict(theta) * second.predict(theta), 1e-12));
    const Matrix6d B = adjoint(second.predict(theta).inverse());
    const Matrix6d expected = B * first.prediction_covariance(theta) * B.transpose() +
                              second.prediction_covariance(theta);
    EXPECT_LT((forward->covariance(q, Variance::kFirstOrder) - expected).norm(),
              1e-10 * expected.norm());
  }
}

TEST(KinematicPath, ATrajectoryIsItsInstants) {
  Rng rng(3);
  const BodySchema schema = random_schema(rng);
  for (const auto& [from, to] : kWays) {
    const auto path = KinematicPath::between(schema, from, to);
    const Eigen::MatrixXd actions =
        Eigen::MatrixXd::NullaryExpr(4, 17, [&] { return test::uniform(rng, -1, 1); });
    const auto poses = path->predict_trajectory(actions);
    const auto predictions = path->predict_trajectory(actions, Variance::kEmpirical);
    const auto jacobians = path->jacobian_trajectory(actions);
    ASSERT_EQ(poses.size(), 17U);
    ASSERT_EQ(predictions.size(), 17U);
    ASSERT_EQ(jacobians.size(), 17U);
    for (int t = 0; t < 17; ++t) {
      PoseJacobian J;
      const Pose X = path->predict(actions.col(t), &J);
      EXPECT_TRUE(poses[t].isApprox(X, 1e-12));
      EXPECT_EQ(predictions[t].X_AB.matrix(), poses[t].matrix());
      EXPECT_EQ(predictions[t].covariance, path->covariance(actions.col(t), Variance::kEmpirical));
      EXPECT_EQ(jacobians[t], J);
    }
    EXPECT_TRUE(path->predict_trajectory(Eigen::MatrixXd(4, 0)).empty());
  }
}

/// How the parameters of an edge change where the frames of its two parts are off: 6 columns for
/// each part.
Eigen::MatrixXd by_frames(const Edge& edge) {
  const Eigen::Index size = edge.num_parameters();
  Eigen::MatrixXd G = Eigen::MatrixXd::Zero(size, 12);
  G.topLeftCorner<6, 6>() = -adjoint(edge.left.inverse());
  G.bottomRightCorner<6, 6>() = adjoint(edge.right);
  return G;
}

/// Edges about those of `schema`: their parameters, with these roots of the covariances, and the
/// frames of the parts.
void draw_edges(const BodySchema& schema, const std::vector<Eigen::MatrixXd>& roots,
                BodySchema* robot, Rng& rng) {
  std::map<int, Vector6d> frames;
  for (const auto& [part, covariance] : schema.frame_covariances)
    frames[part] = Eigen::LLT<Matrix6d>(covariance).matrixL() *
                   Vector6d::NullaryExpr([&] { return test::gaussian(rng); });
  for (std::size_t e = 0; e < schema.edges.size(); ++e) {
    Edge& edge = robot->edges[e];
    edge = schema.edges[e];
    Eigen::VectorXd delta = roots[e] * Eigen::VectorXd::NullaryExpr(
                                           roots[e].rows(), [&] { return test::gaussian(rng); });
    if (!frames.empty()) {
      Eigen::VectorXd of_both(12);
      of_both << frames.at(edge.from), frames.at(edge.to);
      delta += by_frames(edge) * of_both;
    }
    edge.left = edge.left * exp(delta.head<6>());
    for (std::size_t d = 0; d < edge.joints.size(); ++d) {
      const auto first = 6 + 8 * static_cast<Eigen::Index>(d);
      edge.joints[d].slide += delta(first);
      edge.joints[d].turn += delta(first + 1);
      edge.joints[d].X_after = edge.joints[d].X_after * exp(delta.segment<6>(first + 2));
      edge.joints[d].offset += edge.joints[d].scatter * test::gaussian(rng);
    }
  }
}

// Forty thousand robots whose parameters are drawn from the covariance that each edge states;
// then also the frames of the parts, which the edges that meet there share; then joints scatter,
// too.
TEST(KinematicPath, CovarianceIsThatOfDrawnParametersAndOfJointsThatScatter) {
  for (const auto& [in_common, scatter] : {std::pair(false, 0.0), {true, 0.0}, {true, 5e-4}}) {
    Rng rng(4);
    BodySchema schema = random_schema(rng);
    schema.edges.pop_back();
    for (Edge& edge : schema.edges)
      for (ScrewJoint& joint : edge.joints) joint.scatter = scatter;
    const Eigen::VectorXd q = random_action(rng), theta = schema.displacements(q);
    std::vector<Eigen::MatrixXd> roots;
    for (const Edge& edge : schema.edges)
      roots.push_back(Eigen::LLT<Eigen::MatrixXd>(edge.parameter_covariance).matrixL());
    if (in_common) {
      for (const int part : schema.parts) {
        const Matrix6d root = Matrix6d::NullaryExpr([&] { return 2e-4 * test::gaussian(rng); });
        schema.frame_covariances[part] = root * root.transpose();
      }
      for (Edge& edge : schema.edges) {
        const Eigen::MatrixXd G = by_frames(edge);
        int column = 0;
        for (const int part : {edge.from, edge.to}) {
          const auto G_part = G.middleCols<6>(column);
          edge.parameter_covariance +=
              G_part * schema.frame_covariances.at(part) * G_part.transpose();
          column += 6;
        }
      }
    }
    const auto path = KinematicPath::between(schema, 6, 4);
    const Pose inverse = path->predict(q).inverse();
    Matrix6d drawn = Matrix6d::Zero();
    constexpr int kDraws = 40'000;
    BodySchema robot = schema;
    for (int n = 0; n < kDraws; ++n) {
      draw_edges(schema, roots, &robot, rng);
      const Pose X_64 = robot.edges[3].predict(theta).inverse() *
                        robot.edges[1].predict(theta).inverse() * robot.edges[2].predict(theta);
      const Vector6d e = log(inverse * X_64);
      drawn += e * e.transpose() / kDraws;
    }
    // Relative to the drawn one the eigenvalues are 1, within 5 standard deviations of √(2/n).
    const Eigen::GeneralizedSelfAdjointEigenSolver<Matrix6d> ratio(
        path->covariance(q, scatter > 0 ? Variance::kOneAction : Variance::kFirstOrder), drawn);
    EXPECT_GT(ratio.eigenvalues().minCoeff(), 0.965) << in_common;
    EXPECT_LT(ratio.eigenvalues().maxCoeff(), 1.035) << in_common;
  }
}

TEST(KinematicPath, EmpiricalCovarianceIsThatOfEdgesThatScatterAsTheySay) {
  Rng rng(5);
  const BodySchema schema = random_schema(rng);
  const Eigen::VectorXd q = random_action(rng), theta = schema.displacements(q);
  const auto path = KinematicPath::between(schema, 6, 4);
  const Pose inverse = path->predict(q).inverse();
  const auto scattered = [&](const Edge& edge) {
    Vector6d e = test::gaussian6(rng) / std::sqrt(3.0);
    e.head<3>() *= edge.position_rms_m;
    e.tail<3>() *= edge.rotation_rms_rad;
    return edge.predict(theta) * exp(e);
  };
  Matrix6d drawn = Matrix6d::Zero();
  constexpr int kDraws = 100'000;
  for (int n = 0; n < kDraws; ++n) {
    const Vector6d e = log(inverse * scattered(schema.edges[3]).inverse() *
                           scattered(schema.edges[1]).inverse() * scattered(schema.edges[2]));
    drawn += e * e.transpose() / kDraws;
  }
  const Eigen::GeneralizedSelfAdjointEigenSolver<Matrix6d> ratio(
      path->covariance(q, Variance::kEmpirical), drawn);
  EXPECT_GT(ratio.eigenvalues().minCoeff(), 0.975);
  EXPECT_LT(ratio.eigenvalues().maxCoeff(), 1.025);
}

// Parts seen with known noise, a tenth of them anywhere.
TEST(KinematicPath, GlobalCovarianceIsTheNoiseOfTheSamplesWithoutItsOutliers) {
  Rng rng(6);
  const BodySchema schema = random_schema(rng);
  const Matrix6d root = Matrix6d::NullaryExpr([&] { return 1e-3 * test::gaussian(rng); });
  const auto path = KinematicPath::between(schema, 6, 4);
  std::vector<ActionPoseSample> samples(20'000);
  for (std::size_t t = 0; t < samples.size(); ++t) {
    samples[t].action = random_action(rng);
    samples[t].parts.resize(2);
    samples[t].parts[0].part = 4;
    samples[t].parts[1].part = 6;
    samples[t].parts[1].X_CB = test::random_pose(rng, 0, 2);
    samples[t].parts[0].X_CB = samples[t].parts[1].X_CB * path->predict(samples[t].action) *
                               exp(root * test::gaussian6(rng));
    if (t % 10 == 0) samples[t].parts[0].X_CB = test::random_pose(rng, 0, 2);
    if (t % 7 == 0) samples[t].parts.pop_back();
  }
  const auto covariance = empirical_covariance(*path, 6, 4, samples);
  ASSERT_TRUE(covariance);
  const Eigen::GeneralizedSelfAdjointEigenSolver<Matrix6d> ratio(*covariance,
                                                                 Matrix6d(root * root.transpose()));
  EXPECT_GT(ratio.eigenvalues().minCoeff(), 0.93);  // cut at χ²₆(.9973): 0.994 in the mean
  EXPECT_LT(ratio.eigenvalues().maxCoeff(), 1.05);

  samples.resize(8);  // of which 7 have both, one of them an outlier
  EXPECT_FALSE(empirical_covariance(*path, 6, 4, samples));
}

TEST(KinematicPath, AStuckJointIsAConstant) {
  Rng rng(7);
  BodySchema schema = random_schema(rng);
  schema.edges[1].joints[0].gain = 0;
  const Eigen::VectorXd q = random_action(rng);
  Eigen::VectorXd moved = q;
  moved(1) += 0.5;
  const auto path = KinematicPath::between(schema, 1, 3);
  EXPECT_EQ(path->predict(q).matrix(), path->predict(moved).matrix());
  EXPECT_TRUE(path->predict(q).isApprox(ByEdges(schema, 1, 3, schema.displacements(q)).X, 1e-12));
  PoseJacobian J;
  path->predict(q, &J);
  EXPECT_TRUE(J.col(1).isZero(0));
  EXPECT_FALSE(J.col(2).isZero(1e-3));
}

TEST(KinematicPath, LeadsOnlyWhereEdgesLead) {
  Rng rng(8);
  const BodySchema schema = random_schema(rng);
  EXPECT_FALSE(KinematicPath::between(schema, 1, 5));
  EXPECT_FALSE(KinematicPath::between(schema, 5, 1));
  EXPECT_TRUE(KinematicPath::between(schema, 5, 5)
                  ->predict(random_action(rng))
                  .isApprox(Pose::Identity(), 0));
}

TEST(KinematicPath, RefusesActionsOfTheWrongSizeAndSignalsThatAreNotThere) {
  Rng rng(9);
  BodySchema schema = random_schema(rng);
  const auto path = KinematicPath::between(schema, 1, 3);
  PoseJacobian J;
  const Eigen::VectorXd three = Eigen::VectorXd::Zero(3);
  EXPECT_THROW(path->predict(three), std::invalid_argument);
  EXPECT_THROW(path->predict(three, &J), std::invalid_argument);
  EXPECT_THROW(path->covariance(three, Variance::kEmpirical), std::invalid_argument);
  EXPECT_THROW(path->predict_trajectory(Eigen::MatrixXd::Zero(3, 4)), std::invalid_argument);
  EXPECT_THROW(path->jacobian_trajectory(Eigen::MatrixXd::Zero(5, 4)), std::invalid_argument);
  schema.edges[0].joints[0].signal = 4;
  EXPECT_THROW(KinematicPath::between(schema, 1, 3), std::invalid_argument);
}

TEST(Signal, WarpIsTheSumOfItsSines) {
  Rng rng(10);
  for (int n = 0; n < 20; ++n) {
    const Signal signal = bent_signal("q", rng);
    const double q = test::uniform(rng, signal.lower, signal.upper);
    const double x = (q - signal.lower) / (0.5 * (signal.upper - signal.lower)) - 1;
    const Eigen::Map<const Eigen::VectorXd> w(signal.warp.data(), 20);
    EXPECT_NEAR(signal.displacement(q), q + warp_basis(x, 20).dot(w), 1e-14);
    const double h = 1e-6;
    EXPECT_NEAR(signal.displacement_rate(q),
                (signal.displacement(q + h) - signal.displacement(q - h)) / (2 * h), 1e-8);
  }
}

}  // namespace
}  // namespace bodyschema
