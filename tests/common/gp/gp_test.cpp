#include "common/gp/gp.h"

#include <gtest/gtest.h>

#include <Eigen/Eigenvalues>
#include <Eigen/LU>
#include <limits>

#include "tests/common/gp/random_inputs.h"

namespace bodyschema {
namespace {

using test::random_inputs;
using test::Rng;

// A prior of two terms over two dimensions, and observations drawn from it.
struct Example {
  GpPrior prior;
  Eigen::MatrixXd inputs;  // 2×N
  Eigen::VectorXd targets;
  Eigen::VectorXd noise_scales;

  Example(int num_observations, Rng& rng, std::optional<double> mean = 0.7)
      : prior{mean,
              SquaredExponential{1.5, Eigen::Vector2d(0.8, 1.7)} +
                  SquaredExponential{0.2, Eigen::Vector2d(0.3, 0.4)},
              0.01},
        inputs(random_inputs(2, num_observations, -1, 1, rng)),
        targets(test::draw(prior, inputs, rng)),
        noise_scales(random_inputs(num_observations, 1, 0.5, 4, rng)) {}

  FittedGp fitted() const { return {prior, inputs, targets, noise_scales}; }
  Eigen::MatrixXd covariance() const {
    Eigen::MatrixXd K = prior.kernel.covariance(inputs, inputs);
    K.diagonal() += prior.noise_variance * noise_scales;
    return K;
  }
};

Eigen::MatrixXd without_column(const Eigen::MatrixXd& M, Eigen::Index column) {
  Eigen::MatrixXd result(M.rows(), M.cols() - 1);
  result << M.leftCols(column), M.rightCols(M.cols() - 1 - column);
  return result;
}
Eigen::VectorXd without(const Eigen::VectorXd& v, Eigen::Index i) {
  return without_column(v.transpose(), i).transpose();
}

TEST(FittedGp, PosteriorAgreesWithConditioningTheJointNormalDistribution) {
  Rng rng(1);
  const Example e(9, rng);
  const FittedGp gp = e.fitted();
  const Eigen::MatrixXd x = random_inputs(2, 5, -2, 2, rng);
  const Eigen::MatrixXd K_inverse = e.covariance().inverse();
  const Eigen::MatrixXd k = e.prior.kernel.covariance(x, e.inputs);
  const Eigen::VectorXd mean =
      ((k * K_inverse * (e.targets.array() - *e.prior.mean).matrix()).array() + *e.prior.mean);
  const Eigen::MatrixXd joint = e.prior.kernel.covariance(x, x) - k * K_inverse * k.transpose();
  EXPECT_LT((gp.mean(x) - mean).norm(), 1e-10);
  EXPECT_LT((gp.joint_covariance(x) - joint).norm(), 1e-10);
  EXPECT_EQ(gp.jitter(), 0);
}

TEST(FittedGp, MarginalVarianceIsTheDiagonalOfTheJointCovariance) {
  Rng rng(2);
  const Example e(10, rng);
  const FittedGp gp = e.fitted();
  const Eigen::MatrixXd x = random_inputs(2, 20, -2, 2, rng);
  const Eigen::MatrixXd joint = gp.joint_covariance(x);
  const Eigen::VectorXd variance = gp.marginal_variance(x);
  EXPECT_TRUE(variance.isApprox(joint.diagonal(), 1e-12));
  EXPECT_TRUE(joint.isApprox(joint.transpose(), 1e-14));
  EXPECT_GT(Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd>(joint).eigenvalues()(0), -1e-12);
  EXPECT_GE(variance.minCoeff(), 0);
  EXPECT_LE(variance.maxCoeff(), e.prior.kernel.variance());
}

TEST(FittedGp, InterpolatesExactObservations) {
  Rng rng(3);
  Example e(8, rng);
  e.prior.noise_variance = 0;
  const FittedGp gp(e.prior, e.inputs, e.targets);
  EXPECT_LT((gp.mean(e.inputs) - e.targets).norm(), 1e-9);
  EXPECT_LT(gp.marginal_variance(e.inputs).maxCoeff(), 1e-12);
}

TEST(FittedGp, IsThePriorFarFromTheObservationsAndWithoutAny) {
  Rng rng(4);
  const Example e(8, rng);
  const Eigen::Vector2d far(100, -100);
  const FittedGp nothing(e.prior, Eigen::MatrixXd(2, 0), Eigen::VectorXd(0));
  for (const FittedGp& gp : {e.fitted(), nothing}) {
    EXPECT_EQ(gp.mean(far)(0), *e.prior.mean);
    EXPECT_EQ(gp.marginal_variance(far)(0), e.prior.kernel.variance());
    EXPECT_EQ(gp.joint_covariance(far)(0), e.prior.kernel.variance());
    EXPECT_TRUE(gp.mean_gradient(far).isZero());
  }
  EXPECT_EQ(nothing.log_marginal_likelihood(), 0);
  EXPECT_TRUE(nothing.log_marginal_likelihood_gradient().isZero());
  EXPECT_EQ(nothing.leave_one_out().mean.size(), 0);
}

TEST(FittedGp, TwoReadingsOfOnePointCountAsOneOfHalfTheVariance) {
  Rng rng(5);
  const Example e(5, rng);
  Eigen::MatrixXd inputs(2, 6);
  inputs << e.inputs, e.inputs.col(4);
  Eigen::VectorXd targets(6);
  targets << e.targets, e.targets(4) + 0.3;
  const FittedGp twice(e.prior, inputs, targets);
  targets(4) += 0.15;
  Eigen::VectorXd scales = Eigen::VectorXd::Ones(5);
  scales(4) = 0.5;
  const FittedGp once(e.prior, e.inputs, targets.head(5), scales);
  const Eigen::MatrixXd x = random_inputs(2, 5, -1, 1, rng);
  EXPECT_TRUE(twice.mean(x).isApprox(once.mean(x), 1e-10));
  EXPECT_TRUE(twice.joint_covariance(x).isApprox(once.joint_covariance(x), 1e-10));
}

TEST(FittedGp, MeanGradientAgreesWithCentralDifferences) {
  Rng rng(6);
  const double h = 1e-6;
  for (int n = 0; n < 10; ++n) {
    const FittedGp gp = Example(10, rng).fitted();
    const Eigen::VectorXd x = random_inputs(2, 1, -1, 1, rng);
    const Eigen::VectorXd gradient = gp.mean_gradient(x);
    for (int d = 0; d < 2; ++d) {
      const Eigen::VectorXd step = h * Eigen::VectorXd::Unit(2, d);
      EXPECT_NEAR(gradient(d), (gp.mean(x + step) - gp.mean(x - step))(0) / (2 * h), 1e-7);
    }
  }
}

TEST(FittedGp, AnUnknownMeanIsTheLimitOfAVagueOne) {
  Rng rng(20);
  const Example e(9, rng, std::nullopt);
  const GpPrior vague{0, e.prior.kernel + SquaredExponential{1e5, Eigen::Vector2d::Constant(1e6)},
                      e.prior.noise_variance};
  const FittedGp limit(vague, e.inputs, e.targets, e.noise_scales), gp = e.fitted();
  const Eigen::MatrixXd x = random_inputs(2, 5, -3, 3, rng);
  EXPECT_LT((gp.mean(x) - limit.mean(x)).norm(), 1e-4);
  EXPECT_LT((gp.joint_covariance(x) - limit.joint_covariance(x)).norm(), 1e-4);
  EXPECT_TRUE(gp.marginal_variance(x).isApprox(gp.joint_covariance(x).diagonal(), 1e-12));
  EXPECT_LT((gp.mean_gradient(x.col(0)) - limit.mean_gradient(x.col(0))).norm(), 1e-4);
}

TEST(FittedGp, LeaveOneOutAgreesWithLeavingEachOneOut) {
  Rng rng(7);
  for (const auto& mean : {std::optional(0.7), std::optional<double>()}) {
    const Example e(12, rng, mean);
    const GpLeaveOneOut loo = e.fitted().leave_one_out();
    for (int i = 0; i < 12; ++i) {
      const FittedGp gp(e.prior, without_column(e.inputs, i), without(e.targets, i),
                        without(e.noise_scales, i));
      const Eigen::VectorXd x = e.inputs.col(i);
      EXPECT_NEAR(loo.mean(i), gp.mean(x)(0), 1e-9);
      EXPECT_NEAR(loo.variance(i),
                  gp.marginal_variance(x)(0) + e.prior.noise_variance * e.noise_scales(i), 1e-9);
    }
  }
}

TEST(FittedGp, MarginalLikelihoodIsTheProductOfPredictionsOneByOne) {
  Rng rng(8);
  for (const auto& mean : {std::optional(0.7), std::optional<double>()}) {
    const Example e(10, rng, mean);
    double sum = 0;
    for (int n = mean ? 0 : 1; n < 10; ++n) {  // the first one settles an unknown mean
      const FittedGp gp(e.prior, e.inputs.leftCols(n), e.targets.head(n), e.noise_scales.head(n));
      const Eigen::VectorXd x = e.inputs.col(n);
      const double variance =
          gp.marginal_variance(x)(0) + e.prior.noise_variance * e.noise_scales(n);
      sum -= 0.5 *
             (std::pow(e.targets(n) - gp.mean(x)(0), 2) / variance + std::log(2 * M_PI * variance));
    }
    EXPECT_NEAR(e.fitted().log_marginal_likelihood(), sum, 1e-9);
  }
}

TEST(FittedGp, GradientOfTheMarginalLikelihoodAgreesWithCentralDifferences) {
  Rng rng(9);
  const double h = 1e-5;
  for (int n = 0; n < 10; ++n) {
    const Example e(12, rng, n % 2 ? std::optional(0.7) : std::nullopt);
    const Eigen::VectorXd gradient = e.fitted().log_marginal_likelihood_gradient();
    const Eigen::VectorXd p = e.prior.log_parameters();
    ASSERT_EQ(gradient.size(), 7);
    const auto value = [&](const Eigen::VectorXd& parameters) {
      return FittedGp(e.prior.with_log_parameters(parameters), e.inputs, e.targets, e.noise_scales)
          .log_marginal_likelihood();
    };
    for (Eigen::Index i = 0; i < p.size(); ++i) {
      const Eigen::VectorXd step = h * Eigen::VectorXd::Unit(p.size(), i);
      EXPECT_NEAR(gradient(i), (value(p + step) - value(p - step)) / (2 * h), 1e-6) << i;
    }
  }
}

TEST(FittedGp, ScaleMultipliesKernelAndNoise) {
  Rng rng(10);
  for (const auto& mean : {std::optional(0.7), std::optional<double>()}) {
    const Example e(10, rng, mean);
    const double scale = 2.7;
    Eigen::VectorXd p = e.prior.log_parameters();
    for (const int i : {0, 3, 6}) p(i) += std::log(scale);  // two variances and the noise
    const FittedGp scaled(e.prior.with_log_parameters(p), e.inputs, e.targets, e.noise_scales);
    const FittedGp gp = e.fitted();
    EXPECT_NEAR(gp.log_marginal_likelihood(scale), scaled.log_marginal_likelihood(), 1e-9);
    EXPECT_LT(
        (gp.log_marginal_likelihood_gradient(scale) - scaled.log_marginal_likelihood_gradient())
            .norm(),
        1e-9);
    const double best = gp.best_scale();
    for (const double factor : {0.9, 1.1})
      EXPECT_GT(gp.log_marginal_likelihood(best), gp.log_marginal_likelihood(factor * best));
    // At the best scale, the derivative by all variances together vanishes.
    const Eigen::VectorXd gradient = gp.log_marginal_likelihood_gradient(best);
    EXPECT_NEAR(gradient(0) + gradient(3) + gradient(6), 0, 1e-9);
  }
}

TEST(FittedGp, OneObservationSettlesAnUnknownMeanAndNothingElse) {
  Rng rng(13);
  const Example e(1, rng, std::nullopt);
  const FittedGp gp = e.fitted();
  EXPECT_EQ(gp.mean(Eigen::Vector2d(9, 9))(0), e.targets(0));
  EXPECT_EQ(gp.log_marginal_likelihood(), 0);
  EXPECT_EQ(gp.best_scale(), 0);
  EXPECT_TRUE(gp.log_marginal_likelihood_gradient().isZero());
  EXPECT_THROW(gp.leave_one_out(), std::invalid_argument);
}

TEST(FittedGp, EqualInputsWithoutNoiseGetJitterAndStayFinite) {
  Rng rng(11);
  Example e(10, rng);
  e.prior.noise_variance = 0;
  for (int i = 1; i < 10; ++i) e.inputs.col(i) = e.inputs.col(0);
  const FittedGp gp(e.prior, e.inputs, e.targets);
  EXPECT_GT(gp.jitter(), 0);
  EXPECT_LT(gp.jitter(), 1e-10);
  EXPECT_TRUE(gp.mean(e.inputs).allFinite());
  EXPECT_TRUE(gp.leave_one_out().mean.allFinite());
  EXPECT_TRUE(gp.log_marginal_likelihood_gradient().allFinite());
  EXPECT_NEAR(gp.mean(e.inputs)(0), e.targets.mean(), 1e-3);
}

TEST(FittedGp, RefusesWhatDoesNotGoTogether) {
  Rng rng(12);
  const Example e(3, rng);
  const double nan = std::numeric_limits<double>::quiet_NaN();
  EXPECT_THROW(FittedGp(e.prior, e.inputs, Eigen::VectorXd::Zero(4)), std::invalid_argument);
  EXPECT_THROW(FittedGp(e.prior, e.inputs.topRows(1), e.targets), std::invalid_argument);
  EXPECT_THROW(FittedGp(e.prior, nan * e.inputs, e.targets), std::invalid_argument);
  EXPECT_THROW(FittedGp(e.prior, e.inputs, nan * e.targets), std::invalid_argument);
  EXPECT_THROW(FittedGp(e.prior, e.inputs, e.targets, Eigen::VectorXd::Zero(3)),
               std::invalid_argument);
  EXPECT_THROW(FittedGp(e.prior, e.inputs, e.targets, Eigen::VectorXd::Ones(2)),
               std::invalid_argument);
  GpPrior prior = e.prior;
  prior.noise_variance = -1;
  EXPECT_THROW(FittedGp(prior, e.inputs, e.targets), std::invalid_argument);
  EXPECT_THROW(e.fitted().mean(Eigen::MatrixXd::Zero(3, 1)), std::invalid_argument);
  EXPECT_THROW(FittedGp({std::nullopt, e.prior.kernel, 1}, Eigen::MatrixXd(2, 0), {}),
               std::invalid_argument);
  EXPECT_THROW(e.prior.with_log_parameters(Eigen::VectorXd::Zero(6)), std::invalid_argument);
}

}  // namespace
}  // namespace bodyschema
