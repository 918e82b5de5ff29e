#include "common/gp/kernel.h"

#include <gtest/gtest.h>

#include <Eigen/Eigenvalues>
#include <limits>

#include "common/gp/gp.h"
#include "tests/common/gp/random_inputs.h"

namespace bodyschema {
namespace {

using test::random_inputs;
using test::Rng;

Kernel random_kernel(int num_dimensions, int num_terms, Rng& rng) {
  const auto term = [&] {
    return SquaredExponential{test::uniform(rng, 0.1, 2),
                              random_inputs(num_dimensions, 1, 0.3, 2, rng)};
  };
  Kernel kernel = term();
  for (int n = 1; n < num_terms; ++n) kernel = kernel + term();
  return kernel;
}

TEST(Kernel, CovarianceIsSymmetricAndPositiveDefinite) {
  Rng rng(1);
  for (int n = 0; n < 20; ++n) {
    const Kernel kernel = random_kernel(1 + n % 3, 1 + n % 2, rng);
    const Eigen::MatrixXd x = random_inputs(1 + n % 3, 12, -1, 1, rng);
    const Eigen::MatrixXd K = kernel.covariance(x, x);
    EXPECT_EQ(K, K.transpose());
    const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> eigen(K);
    EXPECT_GT(eigen.eigenvalues()(0), -1e-13 * eigen.eigenvalues()(11));
    EXPECT_TRUE(K.diagonal().isConstant(kernel.variance(), 1e-14));
  }
}

TEST(Kernel, FallsWithTheDistanceInUnitsOfEachLengthScale) {
  const Kernel kernel = SquaredExponential{2, Eigen::Vector2d(0.5, 3)};
  const Eigen::Vector2d a(1, -1);
  EXPECT_NEAR(kernel.covariance(a, a + Eigen::Vector2d(0.5, 0))(0), 2 * std::exp(-0.5), 1e-15);
  EXPECT_NEAR(kernel.covariance(a, a + Eigen::Vector2d(0, 6))(0), 2 * std::exp(-2.0), 1e-15);
  EXPECT_NEAR(kernel.covariance(a, a - Eigen::Vector2d(0.5, 3))(0), 2 * std::exp(-1.0), 1e-15);
}

TEST(Kernel, SumOfKernelsIsTheSumOfTheirCovariances) {
  Rng rng(2);
  const Kernel a = random_kernel(2, 1, rng), b = random_kernel(2, 2, rng);
  const Eigen::MatrixXd x = random_inputs(2, 4, -1, 1, rng), y = random_inputs(2, 3, -1, 1, rng);
  EXPECT_TRUE((a + b).covariance(x, y).isApprox(a.covariance(x, y) + b.covariance(x, y), 1e-14));
  EXPECT_EQ((a + b).num_parameters(), a.num_parameters() + b.num_parameters());
}

TEST(Kernel, OverNoDimensionsIsAConstant) {
  const Kernel kernel = SquaredExponential{3, {}};
  EXPECT_EQ(kernel.covariance(Eigen::MatrixXd(0, 2), Eigen::MatrixXd(0, 4)),
            Eigen::MatrixXd::Constant(2, 4, 3));
}

TEST(Kernel, LogParametersComeBack) {
  Rng rng(3);
  const Kernel kernel = random_kernel(3, 2, rng);
  const Eigen::VectorXd p = kernel.log_parameters();
  ASSERT_EQ(p.size(), 8);
  EXPECT_TRUE(kernel.with_log_parameters(p).log_parameters().isApprox(p, 1e-14));
  EXPECT_NEAR(kernel.with_log_parameters(p).variance(), kernel.variance(), 1e-14);
}

TEST(Kernel, InputGradientAgreesWithCentralDifferences) {
  Rng rng(4);
  const double h = 1e-6;
  for (int n = 0; n < 10; ++n) {
    const Kernel kernel = random_kernel(2, 1 + n % 2, rng);
    const Eigen::MatrixXd a = random_inputs(2, 5, -1, 1, rng);
    const Eigen::VectorXd x = random_inputs(2, 1, -1, 1, rng);
    const Eigen::MatrixXd gradient = kernel.input_gradient(x, a);
    for (int d = 0; d < 2; ++d) {
      const Eigen::VectorXd step = h * Eigen::VectorXd::Unit(2, d);
      const Eigen::RowVectorXd expected =
          (kernel.covariance(x + step, a) - kernel.covariance(x - step, a)) / (2 * h);
      EXPECT_LT((gradient.row(d) - expected).norm(), 1e-8);
    }
  }
}

TEST(Kernel, WeightedParameterGradientAgreesWithCentralDifferences) {
  Rng rng(5);
  const double h = 1e-6;
  for (int n = 0; n < 10; ++n) {
    const Kernel kernel = random_kernel(2, 1 + n % 2, rng);
    const Eigen::MatrixXd x = random_inputs(2, 6, -1, 1, rng);
    Eigen::MatrixXd weights = random_inputs(6, 6, -1, 1, rng);
    weights = (weights + weights.transpose()).eval();
    const Eigen::VectorXd gradient = kernel.weighted_parameter_gradient(x, weights);
    const Eigen::VectorXd p = kernel.log_parameters();
    const auto sum = [&](const Eigen::VectorXd& parameters) {
      return kernel.with_log_parameters(parameters).covariance(x, x).cwiseProduct(weights).sum();
    };
    for (Eigen::Index i = 0; i < p.size(); ++i) {
      const Eigen::VectorXd step = h * Eigen::VectorXd::Unit(p.size(), i);
      EXPECT_NEAR(gradient(i), (sum(p + step) - sum(p - step)) / (2 * h), 1e-7);
    }
  }
}

TEST(Kernel, RefusesWhatIsNoKernel) {
  const double infinity = std::numeric_limits<double>::infinity();
  EXPECT_THROW(Kernel(SquaredExponential{0, Eigen::VectorXd::Ones(1)}), std::invalid_argument);
  EXPECT_THROW(Kernel(SquaredExponential{infinity, {}}), std::invalid_argument);
  EXPECT_THROW(Kernel(SquaredExponential{1, -Eigen::VectorXd::Ones(1)}), std::invalid_argument);
  const Kernel one = SquaredExponential{1, Eigen::VectorXd::Ones(1)};
  EXPECT_THROW(one + Kernel(SquaredExponential{1, Eigen::VectorXd::Ones(2)}),
               std::invalid_argument);
  EXPECT_THROW(one.covariance(Eigen::MatrixXd(2, 3), Eigen::MatrixXd(1, 3)), std::invalid_argument);
  EXPECT_THROW(one.with_log_parameters(Eigen::VectorXd::Zero(3)), std::invalid_argument);
  EXPECT_THROW(one.with_log_parameters(Eigen::Vector2d(1e4, 0)), std::invalid_argument);
}

}  // namespace
}  // namespace bodyschema
