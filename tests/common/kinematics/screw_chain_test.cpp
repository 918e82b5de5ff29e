#include "common/kinematics/screw_chain.h"

#include <gtest/gtest.h>

#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

constexpr int kScrews = 3;

struct Chain {
  Pose A[kScrews + 1];
  Screw screws[kScrews];
  double q[kScrews];

  explicit Chain(test::Rng& rng) {
    for (Pose& X : A) X = test::random_pose(rng, 0.1, 0.5);
    for (int d = 0; d < kScrews; ++d) {
      screws[d] = {test::uniform(rng, -0.1, 0.1), test::uniform(rng, -1, 1)};
      q[d] = test::uniform(rng, -1, 1);
    }
  }
  auto view() const {
    return ScrewChain(A[0], kScrews, [this](int d) {
      return ScrewLink{screws[d], q[d], A[d + 1]};
    });
  }
};

TEST(ScrewChain, ItsPoseIsTheProductOfExponentials) {
  test::Rng rng(1);
  const Chain chain(rng);
  Pose X = chain.A[0];
  for (int d = 0; d < kScrews; ++d) {
    Vector6d twist = Vector6d::Zero();
    twist(2) = chain.screws[d].slide;
    twist(5) = chain.screws[d].turn;
    X = X * exp(chain.q[d] * twist) * chain.A[d + 1];
  }
  EXPECT_TRUE(chain.view().predict().isApprox(X, 1e-12));
}

TEST(ScrewChain, DisplacementJacobianAgreesWithCentralDifferences) {
  test::Rng rng(2);
  const Chain chain(rng);
  const Pose suffix = test::random_pose(rng, 0.1, 0.5);
  Eigen::MatrixXd J;
  const Pose X = chain.view().predict_by_displacements(&J, suffix);
  EXPECT_TRUE(X.isApprox(chain.view().predict() * suffix, 1e-12));
  constexpr double kStep = 1e-6;
  for (int d = 0; d < kScrews; ++d) {
    Chain plus = chain, minus = chain;
    plus.q[d] += kStep;
    minus.q[d] -= kStep;
    const Vector6d numeric = (log(X.inverse() * plus.view().predict() * suffix) -
                              log(X.inverse() * minus.view().predict() * suffix)) /
                             (2 * kStep);
    EXPECT_LT((J.col(d) - numeric).norm(), 1e-8) << d;
  }
}

TEST(ScrewChain, ParameterJacobianAgreesWithCentralDifferencesInTheLayoutsOrder) {
  using Layout = ScrewChainLayout;
  test::Rng rng(3);
  const Chain chain(rng);
  Eigen::MatrixXd J;
  const Pose X = chain.view().predict_by_parameters(&J);
  ASSERT_EQ(J.cols(), Layout::size(kScrews));
  constexpr double kStep = 1e-6;
  const auto expect_column = [&](int column, const auto& move) {
    Chain plus = chain, minus = chain;
    move(plus, kStep);
    move(minus, -kStep);
    const Vector6d numeric =
        (log(X.inverse() * plus.view().predict()) - log(X.inverse() * minus.view().predict())) /
        (2 * kStep);
    EXPECT_LT((J.col(column) - numeric).norm(), 1e-8) << column;
  };
  for (int d = 0; d <= kScrews; ++d)
    for (int n = 0; n < 6; ++n)
      expect_column(Layout::transform(d) + n,
                    [&](Chain& c, double h) { c.A[d] = c.A[d] * exp(h * Vector6d::Unit(n)); });
  for (int d = 0; d < kScrews; ++d) {
    expect_column(Layout::slide(d), [&](Chain& c, double h) { c.screws[d].slide += h; });
    expect_column(Layout::turn(d), [&](Chain& c, double h) { c.screws[d].turn += h; });
  }
}

}  // namespace
}  // namespace bodyschema
