#include "common/schema/matrix_gp.h"

#include <gtest/gtest.h>

#include <limits>

#include "common/schema/body_schema.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Rng;

// What a two-joint arm between two parts does, and what a matrix GP is made of.
struct Example {
  std::vector<int> signals;
  Eigen::MatrixXd inputs;
  std::vector<Pose> poses;
  std::vector<GpPrior> priors;

  // `signals` out of three; noise per axis.
  Example(std::vector<int> q, int num_samples, double noise, Rng& rng)
      : signals(std::move(q)), inputs(signals.size(), num_samples) {
    for (double& value : inputs.reshaped()) value = test::uniform(rng, -1, 1);
    for (const int signal : signals) {
      ScrewJoint joint;
      joint.signal = signal;
      joint.turn = test::uniform(rng, 0.7, 1.2);
      joint.X_after = test::random_pose(rng, 0.1, 0.2);
      truth.joints.push_back(joint);
    }
    truth.left = test::random_pose(rng, 0.1, 0.2);
    for (int t = 0; t < num_samples; ++t)
      poses.push_back(truth.predict(action(inputs.col(t))) * exp(noise * test::gaussian6(rng)));
    for (int e = 0; e < MatrixGp::kNumEntries; ++e) {
      const Eigen::VectorXd lengths = Eigen::VectorXd::Constant(inputs.rows(), e % 2 ? 1.5 : 2.0);
      priors.push_back({std::nullopt, SquaredExponential{1, lengths}, noise * noise + 1e-8});
    }
  }

  Eigen::VectorXd action(const Eigen::VectorXd& x) const {
    Eigen::VectorXd q = Eigen::VectorXd::Constant(3, 0.3);
    q(signals) = x;
    return q;
  }
  MatrixGp model() const { return {signals, inputs, poses, priors}; }

  Edge truth;
};

TEST(MatrixGp, PredictsAPoseNearTheTruth) {
  Rng rng(1);
  for (const auto& signals : {std::vector<int>{2}, {1, 0}}) {
    const Example example(signals, 40, 0, rng);
    const MatrixGp model = example.model();
    for (int n = 0; n < 20; ++n) {
      Eigen::VectorXd x(signals.size());
      for (double& value : x) value = test::uniform(rng, -0.9, 0.9);
      const Eigen::VectorXd q = example.action(x);
      const Pose X = model.predict(q);
      EXPECT_TRUE((X.linear().transpose() * X.linear()).isIdentity(1e-12));
      EXPECT_NEAR(X.linear().determinant(), 1, 1e-12);
      EXPECT_LT(log(example.truth.predict(q).inverse() * X).norm(), 1e-3);
    }
  }
}

TEST(MatrixGp, JacobianThroughTheProjectionAgreesWithCentralDifferences) {
  Rng rng(2);
  for (const auto& signals : {std::vector<int>{2}, {1, 0}, {}}) {
    // Much noise: then the 12 means are far from a rotation, and the projection matters.
    for (const double noise : {0.0, 0.3}) {
      const Example example(signals, 10, noise, rng);
      const MatrixGp model = example.model();
      const auto predict = [&](const Eigen::VectorXd& q) { return model.predict(q); };
      for (int n = 0; n < 5; ++n) {
        Eigen::VectorXd x(signals.size());
        for (double& value : x) value = test::uniform(rng, -1.5, 1.5);
        const Eigen::VectorXd q = example.action(x);
        EXPECT_LT((model.jacobian(q) - test::numeric_jacobian(predict, q, 1e-5)).norm(), 1e-6);
      }
    }
  }
}

TEST(MatrixGp, PredictionCovarianceIsThatOfPosesDrawnFromTheEntries) {
  Rng rng(3);
  const Example example({0, 2}, 15, 0.02, rng);
  const MatrixGp model = example.model();
  const Eigen::Vector2d x(0.4, -0.7);
  const Eigen::VectorXd q = example.action(x);
  const Pose inverse = model.predict(q).inverse();
  Eigen::Matrix<double, 12, 1> mean, deviation;
  for (int e = 0; e < 12; ++e) {
    Eigen::VectorXd targets(15);
    for (int t = 0; t < 15; ++t) targets(t) = example.poses[t].matrix()(e % 3, e / 3);
    const FittedGp gp(model.prior(e), model.inputs(), targets);
    mean(e) = gp.mean(x)(0);
    deviation(e) = std::sqrt(gp.marginal_variance(x)(0));
  }
  Matrix6d sum = Matrix6d::Zero();
  constexpr int kDraws = 40000;
  for (int n = 0; n < kDraws; ++n) {
    Eigen::Matrix<double, 3, 4> M;
    for (int e = 0; e < 12; ++e) M(e % 3, e / 3) = mean(e) + deviation(e) * test::gaussian(rng);
    Pose X = Pose::Identity();
    X.linear() = nearest_rotation(M.leftCols<3>());
    X.translation() = M.col(3);
    const Vector6d r = log(inverse * X);
    sum += r * r.transpose() / kDraws;
  }
  const Matrix6d covariance = model.prediction_covariance(q);
  EXPECT_LT((covariance - sum).norm(), 0.03 * sum.norm());
}

TEST(MatrixGp, LeaveOneOutAgreesWithLeavingEachOneOut) {
  Rng rng(4);
  for (const auto& signals : {std::vector<int>{}, {1}, {0, 2}}) {
    const Example example(signals, 12, 0.05, rng);
    const auto loo = example.model().leave_one_out();
    ASSERT_EQ(loo.residual.size(), 12u);
    for (int t = 0; t < 12; ++t) {
      Example rest = example;
      rest.poses.erase(rest.poses.begin() + t);
      rest.inputs.resize(signals.size(), 11);
      rest.inputs << example.inputs.leftCols(t), example.inputs.rightCols(11 - t);
      const MatrixGp model = rest.model();
      const Eigen::VectorXd q = example.action(example.inputs.col(t));
      const Vector6d residual = log(model.predict(q).inverse() * example.poses[t]);
      EXPECT_LT((loo.residual[t] - residual).norm(), 1e-9);
      // The same noise on all entries is the same along all axes.
      const Matrix6d noise = loo.covariance[t] - model.prediction_covariance(q);
      const double expected = example.priors[0].noise_variance;
      EXPECT_LT((noise - expected * Matrix6d::Identity()).topLeftCorner(3, 3).norm(), 1e-9);
    }
  }
}

TEST(MatrixGp, WithoutSignalsIsTheMeanPose) {
  Rng rng(5);
  Example example({}, 400, 0.05, rng);
  const MatrixGp model = example.model();
  const Pose X = model.predict(example.action(Eigen::VectorXd(0)));
  EXPECT_LT(log(example.truth.left.inverse() * X).norm(), 4 * 0.05 * std::sqrt(6.0 / 400));
  EXPECT_TRUE(model.jacobian(Eigen::VectorXd::Zero(3)).isZero());
  // The mean of N readings has a variance of noise / N.
  const double expected = example.priors[9].noise_variance / 400;
  EXPECT_NEAR(model.prediction_covariance(Eigen::VectorXd::Zero(3))(0, 0), expected,
              1e-3 * expected);
}

TEST(MatrixGp, IsMadeOfItsHyperParametersAndSamplesAlone) {
  Rng rng(6);
  const MatrixGp model = Example({1, 2}, 20, 0.01, rng).model();
  std::vector<GpPrior> priors;
  for (int e = 0; e < MatrixGp::kNumEntries; ++e) priors.push_back(model.prior(e));
  const MatrixGp again(model.signals(), model.inputs(), model.poses(), priors);
  const Eigen::Vector3d q(0, 0.2, -0.3);
  EXPECT_EQ(again.predict(q).matrix(), model.predict(q).matrix());
  EXPECT_EQ(again.prediction_covariance(q), model.prediction_covariance(q));
}

TEST(MatrixGp, PosesHalfATurnApartStillGiveARotation) {
  std::vector<Pose> poses(2, Pose::Identity());
  poses[1].linear() = Eigen::Vector3d(-1, -1, 1).asDiagonal();
  std::vector<GpPrior> priors;
  for (int e = 0; e < 12; ++e) priors.push_back({std::nullopt, SquaredExponential{1, {}}, 1});
  const MatrixGp model({}, Eigen::MatrixXd(0, 2), poses, priors);
  const Pose X = model.predict(Eigen::VectorXd(0));
  EXPECT_TRUE((X.linear().transpose() * X.linear()).isIdentity(1e-12));
  EXPECT_TRUE(model.prediction_covariance(Eigen::VectorXd(0)).allFinite());
  EXPECT_TRUE(model.leave_one_out().residual[0].allFinite());
}

TEST(MatrixGp, RefusesWhatDoesNotGoTogether) {
  Rng rng(7);
  const Example example({0, 2}, 5, 0.01, rng);
  EXPECT_THROW(MatrixGp({0}, example.inputs, example.poses, example.priors), std::invalid_argument);
  EXPECT_THROW(MatrixGp({0, -1}, example.inputs, example.poses, example.priors),
               std::invalid_argument);
  EXPECT_THROW(MatrixGp({0, 2}, example.inputs.leftCols(4), example.poses, example.priors),
               std::invalid_argument);
  EXPECT_THROW(MatrixGp({0, 2}, example.inputs, example.poses, {}), std::invalid_argument);
  EXPECT_THROW(MatrixGp({}, Eigen::MatrixXd(0, 0), {}, example.priors), std::invalid_argument);
  const MatrixGp model = example.model();
  EXPECT_THROW(model.predict(Eigen::VectorXd::Zero(2)), std::invalid_argument);
  EXPECT_THROW(
      model.predict(Eigen::VectorXd::Constant(3, std::numeric_limits<double>::quiet_NaN())),
      std::invalid_argument);
  EXPECT_THROW(empirical_covariance({}), std::invalid_argument);
}

TEST(MatrixGp, EmpiricalCovarianceIsThatOfTheResiduals) {
  Rng rng(8);
  std::vector<Vector6d> residuals;
  for (int n = 0; n < 20000; ++n) residuals.push_back(0.1 * test::gaussian6(rng));
  EXPECT_TRUE(empirical_covariance(residuals).isApprox(0.01 * Matrix6d::Identity(), 0.05));
}

TEST(Edge, StandsOnAMatrixGpAsOnJoints) {
  Rng rng(9);
  const Example example({2, 0}, 30, 0, rng);
  Edge edge;
  edge.left = test::random_pose(rng, 0.1, 0.2);
  edge.right = test::random_pose(rng, 0.1, 0.2);
  edge.matrix_gp = std::make_shared<const MatrixGp>(example.model());
  EXPECT_STREQ(edge.kind(), "matrix_gp");
  EXPECT_EQ(edge.signals(), (std::vector<int>{2, 0}));
  const Eigen::Vector3d q(0.5, 0.1, -0.4);
  EXPECT_TRUE(edge.predict(q).isApprox(edge.left * edge.matrix_gp->predict(q) * edge.right));
  const auto predict = [&](const Eigen::VectorXd& a) { return edge.predict(a); };
  EXPECT_LT((edge.jacobian(q) - test::numeric_jacobian(predict, q, 1e-5)).norm(), 1e-6);
  // The same uncertainty, seen from the other end of `right`.
  const Matrix6d A = adjoint(edge.right);
  EXPECT_TRUE((A * edge.prediction_covariance(q) * A.transpose())
                  .isApprox(edge.matrix_gp->prediction_covariance(q), 1e-9));

  BodySchema schema;
  schema.parts = {1, 2, 3};
  schema.root = 1;
  schema.signals = {{"q1", -1, 1}, {"q2", -1, 1}, {"q3", -1, 1}};
  schema.edges = {edge, example.truth};
  schema.edges[0].from = 1;
  schema.edges[0].to = 2;
  schema.edges[1].from = 2;
  schema.edges[1].to = 3;
  EXPECT_EQ(schema.unused_signals(), std::vector<int>{1});
  const auto along = [&](const Eigen::VectorXd& a) { return schema.predict(3, 1, a)->X_AB; };
  EXPECT_LT((*schema.jacobian(3, 1, q) - test::numeric_jacobian(along, q, 1e-5)).norm(), 1e-6);
}

}  // namespace
}  // namespace bodyschema
