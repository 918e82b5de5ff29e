#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <functional>

#include "common/schema/kinematic_path.h"
#include "processes/structure_learner/learn.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Rng;

/// Mean squared Mahalanobis distance of what is seen from what is predicted; 6 if the covariance is
/// right.
double mean_distance(const KinematicPath& path, int from, int to,
                     const std::vector<ActionPoseSample>& samples,
                     const std::function<Matrix6d(const Eigen::VectorXd&)>& covariance) {
  double sum = 0;
  int count = 0;
  for (const ActionPoseSample& sample : samples) {
    const PartObservation *a = sample.find(from), *b = sample.find(to);
    if (!a || !b) continue;
    const Vector6d r = log(path.predict(sample.action).inverse() * a->X_CB.inverse() * b->X_CB);
    sum += r.dot(covariance(sample.action).ldlt().solve(r));
    ++count;
  }
  return sum / count;
}

// Robots learned from 60 samples with isotropic noise and no outliers, judged by 500 others.
TEST(PredictionVariance, OfALearnedRobotIsWhatItSaysOnSamplesNotLearnedFrom) {
  for (const int seed : {1, 2, 3}) {
    Rng rng(seed);
    const test::SyntheticRobot robot = test::chapter_robot("c", rng);
    const test::ObservationOptions chapter{.regime = test::Regime::kChapter,
                                           .with_covariances = true};
    const auto learned_from = test::babble(robot, 60, chapter, rng);
    const auto others = test::babble(robot, 500, chapter, rng);
    const BodySchema schema = learn(robot.signals, learned_from).schema;
    ASSERT_TRUE(test::is_right(schema, robot));
    const auto path = KinematicPath::between(schema, 1, 5);

    // The whole path's, from half of the others for the other half. A mean of 250 χ²₆ scatters by
    // 0.22; the covariance of 250 residuals adds as much.
    const std::vector<ActionPoseSample> judges(others.begin() + 250, others.end());
    const auto global = empirical_covariance(*path, 1, 5, {others.begin(), others.begin() + 250});
    ASSERT_TRUE(global);
    const double by_global =
        mean_distance(*path, 1, 5, judges, [&](const auto&) { return *global; });
    EXPECT_GT(by_global, 5.0) << seed;
    EXPECT_LT(by_global, 7.2) << seed;
    // From the samples learned from, it is smaller by the degrees of freedom that the fit took.
    const auto trained = empirical_covariance(*path, 1, 5, learned_from);
    ASSERT_TRUE(trained);
    EXPECT_LT(trained->trace(), 1.2 * global->trace()) << seed;
    EXPECT_GT(trained->trace(), 0.4 * global->trace()) << seed;

    // The edges' residuals summed along the path count the markers between twice: an upper bound.
    const double by_edges = mean_distance(*path, 1, 5, judges, [&](const Eigen::VectorXd& q) {
      return path->covariance(q, Variance::kEmpirical);
    });
    EXPECT_LT(by_edges, by_global) << seed;
    EXPECT_GT(by_edges, 1.0) << seed;

    // First order is of the mean alone: right about the truth that no marker blurs.
    double squared = 0;
    constexpr int kActions = 200;
    for (int n = 0; n < kActions; ++n) {
      const Eigen::VectorXd q = robot.random_action(rng);
      const auto truth = robot.poses_in_camera(q);
      const Vector6d e = log(path->predict(q).inverse() * truth.at(1).inverse() * truth.at(5));
      squared += e.dot(path->covariance(q, Variance::kFirstOrder).ldlt().solve(e)) / kActions;
    }
    // One robot's errors at different actions are one draw, not many.
    EXPECT_GT(squared, 1.0) << seed;
    EXPECT_LT(squared, 20.0) << seed;
  }
}

}  // namespace
}  // namespace bodyschema
