#include "common/schema/residual_gp.h"

#include <gtest/gtest.h>

#include "common/schema/body_schema.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Rng;

// A joint that sags: a screw in signal 0 whose residual depends on signals 0, 1 and 2 (of 4).
Eigen::VectorXd random_action(Rng& rng) {
  Eigen::VectorXd q(4);
  for (double& value : q) value = test::uniform(rng, -1, 1);
  return q;
}

Vector6d sag(const Eigen::VectorXd& q) {
  Vector6d rho;
  rho << 0.02 * q(0) * q(1), 0.03 * std::sin(q(1)), -0.01 * q(2), 0.2 * q(1), 0.1 * q(2) * q(2),
      0.15 * std::cos(q(0) + q(2));
  return rho;
}

ResidualGp model(int num_samples, double noise, Rng& rng) {
  Eigen::MatrixXd inputs(3, num_samples);
  ResidualGp::Residuals residuals(6, num_samples);
  for (int n = 0; n < num_samples; ++n) {
    const Eigen::VectorXd q = random_action(rng);
    inputs.col(n) = q.head<3>();
    residuals.col(n) = sag(q) + noise * test::gaussian6(rng);
  }
  ResidualGp::Prior prior;
  prior.length_scales = Eigen::Vector3d(1.5, 2, 1.8);
  prior.variances << 1e-3, 1e-3, 1e-3, 0.04, 0.04, 0.04;
  prior.noise_variances.setConstant(noise * noise + 1e-10);
  return {{0, 1, 2}, inputs, residuals, Eigen::VectorXd::Ones(num_samples), prior};
}

Edge soft_edge(Rng& rng) {
  Edge edge;
  edge.left = test::random_pose(rng, 0.1, 0.2);
  ScrewJoint joint;
  joint.signal = 0;
  joint.turn = 0.9;
  joint.X_after = test::random_pose(rng, 0.1, 0.2);
  edge.joints.push_back(joint);
  edge.right = test::random_pose(rng, 0.1, 0.2);
  edge.residual_gp = std::make_shared<const ResidualGp>(model(64, 1e-4, rng));
  return edge;
}

TEST(ResidualGp, LearnsWhatTheScrewsLeave) {
  Rng rng(401);
  const ResidualGp gp = model(64, 1e-4, rng);
  for (int n = 0; n < 50; ++n) {
    const Eigen::VectorXd q = 0.8 * random_action(rng);
    const Vector6d error = gp.mean(q) - sag(q);
    EXPECT_LT(error.head<3>().norm(), 0.003);
    EXPECT_LT(error.tail<3>().norm(), 0.02);
    EXPECT_TRUE((error.cwiseAbs().array() < 5 * gp.variance(q).array().sqrt() + 2e-3).all());
  }
}

TEST(ResidualGp, FarFromItsSamplesTheScrewsSpeakAndItsVarianceIsThePriors) {
  Rng rng(402);
  const ResidualGp gp = model(20, 1e-4, rng);
  const Eigen::VectorXd far = Eigen::VectorXd::Constant(4, 100);
  EXPECT_LT(gp.mean(far).norm(), 1e-12);
  EXPECT_TRUE(gp.variance(far).isApprox(gp.prior().variances, 1e-12));
}

TEST(ResidualGp, ASampleOfLittleWeightDoesNotBendIt) {
  Rng rng(403);
  const ResidualGp clean = model(40, 1e-3, rng);
  ResidualGp::Residuals residuals = clean.residuals();
  residuals.col(7) << 0.1, -0.1, 0.1, 0, M_PI, 0;  // a flipped marker
  Eigen::VectorXd scales = clean.noise_scales();
  const auto with = [&](double scale) {
    scales(7) = scale;
    return ResidualGp({0, 1, 2}, clean.inputs(), residuals, scales, clean.prior());
  };
  Eigen::VectorXd q = Eigen::VectorXd::Zero(4);
  q.head<3>() = clean.inputs().col(7);
  EXPECT_GT((with(1).mean(q) - sag(q)).norm(), 1);
  EXPECT_LT((with(1e6).mean(q) - sag(q)).norm(), 0.1);
}

TEST(ResidualGp, TheEdgesJacobianIsTheDerivativeOfItsPrediction) {
  Rng rng(404);
  for (int repeat = 0; repeat < 20; ++repeat) {
    const Edge edge = soft_edge(rng);
    const Eigen::VectorXd q = random_action(rng);
    const Eigen::MatrixXd J = edge.jacobian(q);
    const auto predict = [&](const Eigen::VectorXd& a) { return edge.predict(a); };
    EXPECT_LT((J - test::numeric_jacobian(predict, q, 1e-5)).norm(), 1e-7);
    EXPECT_EQ(J.col(3).norm(), 0);
  }
}

TEST(ResidualGp, TheEdgesCovarianceIsThatOfDrawsOfParametersAndResidual) {
  Rng rng(405);
  Edge edge = soft_edge(rng);
  const int p = 14;
  Eigen::MatrixXd root(p, p);
  for (double& value : root.reshaped()) value = 3e-4 * test::uniform(rng, -1, 1);
  edge.parameter_covariance = root * root.transpose();
  const Eigen::VectorXd q = Eigen::VectorXd::Constant(4, 0.9);
  const Vector6d mean = edge.residual_gp->mean(q), variance = edge.residual_gp->variance(q);
  const Pose inverse = edge.predict(q).inverse();
  Matrix6d sum = Matrix6d::Zero();
  constexpr int kDraws = 40'000;
  for (int n = 0; n < kDraws; ++n) {
    Eigen::VectorXd unit(18);
    unit << test::gaussian6(rng), test::gaussian6(rng), test::gaussian6(rng);
    const Eigen::VectorXd step = root * unit.head(p);
    Edge moved = edge;
    moved.left = edge.left * exp(step.head<6>());
    moved.joints[0].slide += step(6);
    moved.joints[0].turn += step(7);
    moved.joints[0].X_after = edge.joints[0].X_after * exp(step.segment<6>(8));
    moved.residual_gp = nullptr;
    const Pose before = moved.predict(q) * edge.right.inverse();
    const Vector6d rho = mean + variance.cwiseSqrt().cwiseProduct(test::gaussian6(rng));
    const Vector6d e = log(inverse * before * exp(rho) * edge.right);
    sum += e * e.transpose();
  }
  const Matrix6d expected = sum / kDraws, found = edge.prediction_covariance(q);
  EXPECT_LT((found - expected).norm(), 0.04 * expected.norm());
}

TEST(ResidualGp, KindAndSignalsTellOfTheProcess) {
  Rng rng(406);
  Edge edge = soft_edge(rng);
  EXPECT_STREQ(edge.kind(), "screw_gp");
  edge.joints[0].signal = 3;
  EXPECT_EQ(edge.signals(), (std::vector<int>{3, 0, 1, 2}));
}

TEST(ResidualGp, RefusesWhatDoesNotGoTogether) {
  Rng rng(407);
  const ResidualGp good = model(5, 1e-3, rng);
  const Eigen::VectorXd scales = good.noise_scales();
  EXPECT_THROW(ResidualGp({0, 1}, good.inputs(), good.residuals(), scales, good.prior()),
               std::invalid_argument);
  EXPECT_THROW(ResidualGp({0, 1, -1}, good.inputs(), good.residuals(), scales, good.prior()),
               std::invalid_argument);
  EXPECT_THROW(ResidualGp({0, 1, 2}, good.inputs(), good.residuals(), scales.head(4), good.prior()),
               std::invalid_argument);
  ResidualGp::Prior prior = good.prior();
  prior.variances(2) = 0;
  EXPECT_THROW(ResidualGp({0, 1, 2}, good.inputs(), good.residuals(), scales, prior),
               std::invalid_argument);
  EXPECT_THROW(model(ResidualGp::kMaxSamples + 1, 1e-3, rng), std::invalid_argument);
  EXPECT_THROW(good.mean(Eigen::VectorXd::Zero(2)), std::invalid_argument);
}

}  // namespace
}  // namespace bodyschema
