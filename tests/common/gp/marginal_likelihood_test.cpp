#include "common/gp/marginal_likelihood.h"

#include <gtest/gtest.h>

#include <limits>

#include "tests/common/gp/random_inputs.h"

namespace bodyschema {
namespace {

using test::random_inputs;
using test::Rng;

GpPrior maximum(const Eigen::MatrixXd& inputs, const Eigen::VectorXd& targets) {
  return maximize_marginal_likelihood(inputs, targets).front();
}

Eigen::VectorXd length_scales(const GpPrior& prior) {
  return prior.kernel.terms().front().length_scales;
}

TEST(MarginalLikelihood, FindsTheHyperParametersThatTheDataWereDrawnFrom) {
  const GpPrior truth{3, SquaredExponential{0.8, Eigen::Vector2d(0.5, 1.4)}, 0.01};
  Eigen::VectorXd error = Eigen::VectorXd::Zero(4);
  constexpr int kDraws = 8;
  for (int seed = 1; seed <= kDraws; ++seed) {
    Rng rng(seed);
    const Eigen::MatrixXd x = random_inputs(2, 80, -2, 2, rng);
    const GpPrior found = maximum(x, test::draw(truth, x, rng));
    error += (found.log_parameters() - truth.log_parameters()) / kDraws;
  }
  EXPECT_NEAR(error(0), 0, 0.5);  // the variance of one draw says little
  EXPECT_NEAR(error(1), 0, 0.15);
  EXPECT_NEAR(error(2), 0, 0.15);
  EXPECT_NEAR(error(3), 0, 0.15);
}

// The search ends on one of several maxima; a gain of less than a nat is no better.
TEST(MarginalLikelihood, NoPriorOfAThousandAtRandomIsLikelierByANat) {
  const HyperParameterRange range;
  for (int seed = 1; seed <= 12; ++seed) {
    Rng rng(seed);
    const Eigen::MatrixXd x = random_inputs(1 + seed % 2, 15, -1, 1, rng);
    // From exact and long to noisy and short.
    const GpPrior truth{0, SquaredExponential{1, random_inputs(x.rows(), 1, 0.2, 3, rng)},
                        seed % 3 == 0 ? 0 : std::pow(10, test::uniform(rng, -6, 0))};
    const Eigen::VectorXd y = test::draw(truth, x, rng);
    const GpPrior found = maximum(x, y);
    const double best = FittedGp(found, x, y).log_marginal_likelihood();
    const Eigen::VectorXd half_ranges = (x.rowwise().maxCoeff() - x.rowwise().minCoeff()) / 2;
    for (int n = 0; n < 1000; ++n) {
      Eigen::VectorXd lengths = half_ranges;
      for (double& length : lengths)
        length *= std::exp(
            test::uniform(rng, std::log(range.least_length), std::log(range.largest_length)));
      const FittedGp other(
          {std::nullopt, SquaredExponential{1, lengths}, std::exp(test::uniform(rng, -29.9, 6.9))},
          x, y);
      EXPECT_LT(other.log_marginal_likelihood(other.best_scale()), best + 1) << seed;
    }
  }
}

TEST(MarginalLikelihood, GradientVanishesAtAMaximumInsideTheRange) {
  for (int seed = 1; seed <= 5; ++seed) {
    Rng rng(seed);
    const GpPrior truth{1, SquaredExponential{1, Eigen::VectorXd::Constant(1, 0.6)}, 0.01};
    const Eigen::MatrixXd x = random_inputs(1, 40, -1, 1, rng);
    const Eigen::VectorXd y = test::draw(truth, x, rng);
    const FittedGp gp(maximum(x, y), x, y);
    EXPECT_LT(gp.log_marginal_likelihood_gradient().cwiseAbs().maxCoeff(), 0.02) << seed;
  }
}

TEST(MarginalLikelihood, DoesNotDependOnUnits) {
  Rng rng(3);
  const GpPrior truth{0, SquaredExponential{1, Eigen::Vector2d(0.5, 1)}, 0.01};
  const Eigen::MatrixXd x = random_inputs(2, 25, -1, 1, rng);
  const Eigen::VectorXd y = test::draw(truth, x, rng);
  Eigen::MatrixXd x_ticks = 700 * x;
  x_ticks.row(1).array() = 0.01 * x.row(1).array() - 40;
  const Eigen::VectorXd difference =
      maximum(x_ticks, 1000 * y).log_parameters() - maximum(x, y).log_parameters();
  const Eigen::Vector4d expected(std::log(1e6), std::log(700), std::log(0.01), std::log(1e6));
  EXPECT_LT((difference - expected).cwiseAbs().maxCoeff(), 0.01);
}

TEST(MarginalLikelihood, TreatsEachFunctionAsIfItWereAlone) {
  Rng rng(4);
  const Eigen::MatrixXd x = random_inputs(1, 15, -1, 1, rng);
  const GpPrior truth{0, SquaredExponential{1, Eigen::VectorXd::Constant(1, 0.6)}, 0.01};
  Eigen::MatrixXd targets(15, 3);
  for (int p = 0; p < 3; ++p) targets.col(p) = test::draw(truth, x, rng);
  const auto together = maximize_marginal_likelihood(x, targets);
  for (int p = 0; p < 3; ++p)
    EXPECT_TRUE(
        together[p].log_parameters().isApprox(maximum(x, targets.col(p)).log_parameters(), 1e-6));
}

TEST(MarginalLikelihood, AKnownMeanIsKept) {
  Rng rng(9);
  const Eigen::MatrixXd x = random_inputs(1, 20, -1, 1, rng);
  const GpPrior truth{5, SquaredExponential{1, Eigen::VectorXd::Constant(1, 0.6)}, 0.01};
  const Eigen::VectorXd y = test::draw(truth, x, rng);
  const GpPrior known = maximize_marginal_likelihood(x, y, {}, 5).front();
  EXPECT_EQ(known.mean, 5);
  EXPECT_FALSE(maximum(x, y).mean);
  const double best = FittedGp(known, x, y).log_marginal_likelihood();
  for (int n = 0; n < 300; ++n) {
    const FittedGp other({5, SquaredExponential{1, random_inputs(1, 1, 0.1, 20, rng)},
                          std::exp(test::uniform(rng, -20, 5))},
                         x, y);
    EXPECT_LT(other.log_marginal_likelihood(other.best_scale()), best + 1e-3);
  }
}

TEST(MarginalLikelihood, AnInputWithoutInfluenceGetsALongLengthScale) {
  Rng rng(5);
  const Eigen::MatrixXd x = random_inputs(2, 30, -1, 1, rng);
  Eigen::VectorXd y(30);
  for (int t = 0; t < 30; ++t) y(t) = std::sin(2 * x(0, t)) + 0.01 * test::gaussian(rng);
  const Eigen::VectorXd lengths = length_scales(maximum(x, y));
  EXPECT_LT(lengths(0), 2);
  EXPECT_GT(lengths(1), 10);
}

TEST(MarginalLikelihood, ADownWeightedOutlierDoesNoHarm) {
  Rng rng(6);
  const Eigen::MatrixXd x = random_inputs(1, 20, -1, 1, rng);
  Eigen::VectorXd y = x.row(0).array().sin(), scales = Eigen::VectorXd::Ones(20);
  for (double& value : y) value += 1e-3 * test::gaussian(rng);
  y(7) += 5;
  scales(7) = 1e8;
  const GpPrior prior = maximize_marginal_likelihood(x, y, scales).front();
  EXPECT_LT(prior.noise_variance, 1e-5);
  const FittedGp gp(prior, x, y, scales);
  EXPECT_LT((gp.mean(x).array() - x.row(0).transpose().array().sin()).abs().maxCoeff(), 3e-3);
}

TEST(MarginalLikelihood, ConstantsPureNoiseAndSinglesGiveFiniteAnswers) {
  Rng rng(7);
  const Eigen::MatrixXd x = random_inputs(1, 10, -1, 1, rng);
  Eigen::MatrixXd y(10, 3);
  y.col(0).setConstant(2.5);
  y.col(1).setConstant(2.5);
  for (int t = 0; t < 10; ++t) {
    y(t, 1) += 1e-16 * test::gaussian(rng);
    y(t, 2) = test::gaussian(rng);
  }
  const auto priors = maximize_marginal_likelihood(x, y);
  for (int p = 0; p < 3; ++p) {
    EXPECT_TRUE(priors[p].log_parameters().allFinite()) << p;
    EXPECT_TRUE(FittedGp(priors[p], x, y.col(p)).mean(x).allFinite()) << p;
  }
  EXPECT_NEAR(FittedGp(priors[0], x, y.col(0)).mean(Eigen::VectorXd::Constant(1, 9))(0), 2.5, 1e-9);
  // One sample, and an input that stands still.
  EXPECT_TRUE(maximum(x.leftCols(1), y.col(0).head(1)).log_parameters().allFinite());
  EXPECT_TRUE(maximum(Eigen::MatrixXd::Ones(1, 10), y.col(2)).log_parameters().allFinite());
}

TEST(MarginalLikelihood, ManyDimensionsAreSearchedFromACoarserGrid) {
  Rng rng(8);
  const Eigen::MatrixXd x = random_inputs(3, 40, -1, 1, rng);
  Eigen::VectorXd y(40);
  for (int t = 0; t < 40; ++t) y(t) = std::sin(2 * x(0, t)) * std::cos(x(2, t));
  const GpPrior prior = maximum(x, y);
  const Eigen::MatrixXd test_x = random_inputs(3, 50, -0.8, 0.8, rng);
  const Eigen::VectorXd error =
      FittedGp(prior, x, y).mean(test_x) -
      ((2 * test_x.row(0).array()).sin() * test_x.row(2).array().cos()).matrix().transpose();
  EXPECT_LT(error.cwiseAbs().maxCoeff(), 0.02);
  EXPECT_GT(length_scales(prior)(1), 3 * length_scales(prior)(0));
}

TEST(MarginalLikelihood, RefusesWhatDoesNotGoTogether) {
  const Eigen::MatrixXd x = Eigen::MatrixXd::Ones(1, 3), y = Eigen::MatrixXd::Ones(3, 2);
  EXPECT_THROW(maximize_marginal_likelihood(x, y.topRows(2)), std::invalid_argument);
  EXPECT_THROW(maximize_marginal_likelihood(Eigen::MatrixXd(0, 3), y), std::invalid_argument);
  EXPECT_THROW(maximize_marginal_likelihood(Eigen::MatrixXd(1, 0), Eigen::MatrixXd(0, 1)),
               std::invalid_argument);
  EXPECT_THROW(maximize_marginal_likelihood(x, y, Eigen::VectorXd::Ones(2)), std::invalid_argument);
  EXPECT_THROW(maximize_marginal_likelihood(x, std::numeric_limits<double>::quiet_NaN() * y),
               std::invalid_argument);
  HyperParameterRange empty;
  empty.least_noise = 1e6;
  EXPECT_THROW(maximize_marginal_likelihood(x, y, {}, 0, empty), std::invalid_argument);
}

}  // namespace
}  // namespace bodyschema
