#include "common/estimation/levenberg_marquardt.h"

#include <gtest/gtest.h>

#include <Eigen/Core>

namespace bodyschema {
namespace {

/// Rosenbrock's valley as a sum of squares.
Eigen::Vector2d residual(const Eigen::Vector2d& x) { return {10 * (x(1) - x(0) * x(0)), 1 - x(0)}; }

TEST(LevenbergMarquardt, StepsLeadToTheMinimumOfACurvedValley) {
  Eigen::Vector2d x(-1.2, 1);
  LevenbergMarquardt optimizer(1e-4, 1e-10, 10);
  int num_steps = 0;
  for (bool improved = true; improved && num_steps < 200; ++num_steps) {
    Eigen::Matrix2d J;
    J << -20 * x(0), 10, -1, 0;
    improved = optimizer.step(Eigen::Matrix2d(J.transpose() * J),
                              Eigen::Vector2d(J.transpose() * residual(x)),
                              [&](const Eigen::Vector2d& step) {
                                const Eigen::Vector2d next = x + step;
                                if (!(residual(next).norm() < residual(x).norm())) return false;
                                x = next;
                                return true;
                              });
  }
  EXPECT_LT((x - Eigen::Vector2d(1, 1)).norm(), 1e-9);
  EXPECT_LT(num_steps, 60);
}

TEST(LevenbergMarquardt, DampingGrowsTenfoldWhereNothingImprovesAndShrinksWhereItDoes) {
  LevenbergMarquardt optimizer(1e-4, 1e-5, 3);
  const Eigen::Matrix2d H = Eigen::Vector2d(1, 1e6).asDiagonal();
  const Eigen::Vector2d g(1, 1e6);
  int num_attempts = 0;
  EXPECT_FALSE(optimizer.step(H, g, [&](const Eigen::Vector2d&) {
    ++num_attempts;
    return false;
  }));
  EXPECT_EQ(num_attempts, 3);
  EXPECT_NEAR(optimizer.damping(), 0.1, 1e-12);
  EXPECT_TRUE(optimizer.step(H, g, [](const Eigen::Vector2d& step) {
    // Relative to the diagonal: alike in all units.
    EXPECT_NEAR(step(0), -1 / 1.1, 1e-6);
    EXPECT_NEAR(step(1), -1 / 1.1, 1e-6);
    return true;
  }));
  EXPECT_NEAR(optimizer.damping(), 0.01, 1e-12);
  for (int n = 0; n < 9; ++n) optimizer.step(H, g, [](const Eigen::Vector2d&) { return true; });
  EXPECT_EQ(optimizer.damping(), 1e-5);
}

TEST(LevenbergMarquardt, AParameterWithoutInformationStaysAtRest) {
  LevenbergMarquardt optimizer(1e-4, 1e-10, 1);
  const Eigen::Matrix2d H = Eigen::Vector2d(1, 0).asDiagonal();
  EXPECT_TRUE(optimizer.step(H, Eigen::Vector2d(1, 0), [](const Eigen::Vector2d& step) {
    return step(0) < -0.99 && step(1) == 0;
  }));
}

}  // namespace
}  // namespace bodyschema
