#include "common/gp/minimize_in_box.h"

#include <gtest/gtest.h>

#include <Eigen/LU>
#include <cmath>
#include <limits>

#include "common/gp/gp.h"
#include "tests/common/gp/random_inputs.h"

namespace bodyschema {
namespace {

using test::random_inputs;
using test::Rng;

double rosenbrock(const Eigen::VectorXd& x, Eigen::VectorXd* gradient) {
  const double a = 1 - x(0), b = x(1) - x(0) * x(0);
  if (gradient) *gradient = Eigen::Vector2d(-2 * a - 400 * x(0) * b, 200 * b);
  return a * a + 100 * b * b;
}

TEST(MinimizeInBox, FollowsACurvedValleyToItsEnd) {
  const auto minimum =
      minimize_in_box(rosenbrock, Eigen::Vector2d(-1.2, 1), Eigen::Vector2d(-5, -5),
                      Eigen::Vector2d(5, 5), 1e-14, 1, 200);
  EXPECT_TRUE(minimum.x.isApprox(Eigen::Vector2d(1, 1), 1e-5)) << minimum.x.transpose();
  EXPECT_LT(minimum.num_evaluations, 100);
}

TEST(MinimizeInBox, FindsTheConstrainedMinimumOfConvexQuadratics) {
  Rng rng(1);
  for (int n = 0; n < 50; ++n) {
    const Eigen::MatrixXd M = random_inputs(4, 4, -1, 1, rng);
    const Eigen::MatrixXd A = M * M.transpose() + 0.1 * Eigen::MatrixXd::Identity(4, 4);
    const Eigen::VectorXd centre = random_inputs(4, 1, -2, 2, rng);
    const auto objective = [&](const Eigen::VectorXd& x, Eigen::VectorXd* gradient) {
      if (gradient) *gradient = A * (x - centre);
      return 0.5 * (x - centre).dot(A * (x - centre));
    };
    const Eigen::VectorXd one = Eigen::VectorXd::Ones(4);
    const Eigen::VectorXd start = random_inputs(4, 1, -1, 1, rng);
    const auto minimum = minimize_in_box(objective, start, -one, one, 1e-14, 1, 200);
    // Karush, Kuhn, Tucker: no gradient inside, outward descent at a bound.
    Eigen::VectorXd gradient;
    EXPECT_EQ(minimum.value, objective(minimum.x, &gradient));
    for (int i = 0; i < 4; ++i) {
      ASSERT_LE(std::abs(minimum.x(i)), 1);
      if (minimum.x(i) == 1) {
        EXPECT_LT(gradient(i), 1e-5) << n;
      } else if (minimum.x(i) == -1) {
        EXPECT_GT(gradient(i), -1e-5) << n;
      } else {
        EXPECT_NEAR(gradient(i), 0, 1e-5) << n;
      }
    }
  }
}

TEST(MinimizeInBox, IsNeverAboveItsStartAndStaysWhereTheFunctionIsFinite) {
  // A cliff of infinities beside the minimum.
  const auto objective = [](const Eigen::VectorXd& x, Eigen::VectorXd* gradient) {
    if (gradient) *gradient = Eigen::VectorXd::Constant(1, -1 - 0.1 * x(0));
    return x(0) > 0.3 ? std::numeric_limits<double>::quiet_NaN() : -x(0) - 0.05 * x(0) * x(0);
  };
  const Eigen::VectorXd one = Eigen::VectorXd::Ones(1);
  const auto minimum = minimize_in_box(objective, -one, -one, one, 1e-12, 2, 50);
  EXPECT_LT(minimum.value, objective(-one, nullptr));
  EXPECT_LE(minimum.x(0), 0.3);
}

TEST(MinimizeInBox, RefusesAStartOutOfItsMind) {
  const Eigen::Vector2d one(1, 1);
  EXPECT_THROW(minimize_in_box(rosenbrock, one, one, -one, 1e-6, 1, 10), std::invalid_argument);
  EXPECT_THROW(minimize_in_box(rosenbrock, one, Eigen::VectorXd::Zero(1), one, 1e-6, 1, 10),
               std::invalid_argument);
  const auto nan = [](const Eigen::VectorXd& x, Eigen::VectorXd* gradient) {
    if (gradient) *gradient = x;
    return std::numeric_limits<double>::quiet_NaN();
  };
  EXPECT_THROW(minimize_in_box(nan, one, -one, one, 1e-6, 1, 10), std::invalid_argument);
}

}  // namespace
}  // namespace bodyschema
