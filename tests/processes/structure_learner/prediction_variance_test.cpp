#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <functional>

#include "common/kinematics/kinematic_path.h"
#include "processes/structure_learner/learn.h"
#include "tests/support/imperfect_robot.h"
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

double mean(const std::vector<double>& values) {
  double sum = 0;
  for (const double value : values) sum += value;
  return sum / static_cast<double>(values.size());
}

// Robots learned from 60 samples with isotropic noise and no outliers, judged by 500 others.
TEST(PredictionVariance, OfALearnedRobotIsWhatItSaysOnSamplesNotLearnedFrom) {
  constexpr int kRobots = 20;
  std::vector<double> global_distance, trained_share, first_order;  // of each robot
  for (int seed = 1; seed <= kRobots; ++seed) {
    Rng rng(seed);
    const test::SyntheticRobot robot = test::chapter_robot("c", rng);
    const test::ObservationOptions chapter{.regime = test::Regime::kChapter,
                                           .with_covariances = true};
    const auto learned_from = test::babble(robot, 60, chapter, rng);
    const auto others = test::babble(robot, 500, chapter, rng);
    const BodySchema schema = learn(robot.signals, learned_from).schema;
    ASSERT_TRUE(test::is_right(schema, robot));
    const auto path = KinematicPath::between(schema, 1, 5);

    // The whole path's, from half of the others for the other half: 6 · 250/(250 − 7), since the
    // inverse of an estimated covariance is too large. A mean of 250 χ²₆ scatters by 0.22; the
    // covariance of 250 residuals adds as much.
    const std::vector<ActionPoseSample> judges(others.begin() + 250, others.end());
    const auto global = empirical_covariance(*path, 1, 5, {others.begin(), others.begin() + 250});
    ASSERT_TRUE(global);
    const double by_global =
        mean_distance(*path, 1, 5, judges, [&](const auto&) { return *global; });
    EXPECT_NEAR(by_global, 6.17, 4 * 0.31) << seed;
    global_distance.push_back(by_global);
    // From the samples learned from, it is smaller by the degrees of freedom that the fit took.
    const auto trained = empirical_covariance(*path, 1, 5, learned_from);
    ASSERT_TRUE(trained);
    trained_share.push_back(trained->trace() / global->trace());

    // The edges' residuals summed along the path count the markers between twice, an upper bound: 8
    // markers' noise for 2, and what turns about markers on the way (lever arms of 3/4, 1/2 and 1/4
    // of the path, each twice) makes 2.75 of 1. So 6/4 to 6/2.75.
    const double by_edges = mean_distance(*path, 1, 5, judges, [&](const Eigen::VectorXd& q) {
      return path->covariance(q, Variance::kEmpirical);
    });
    EXPECT_GT(by_edges, 0.85 * 6 / 4) << seed;
    EXPECT_LT(by_edges, 1.15 * 6 / 2.75) << seed;

    // First order is of the mean alone: about the truth that no marker blurs.
    double squared = 0;
    constexpr int kActions = 200;
    for (int n = 0; n < kActions; ++n) {
      const Eigen::VectorXd q = robot.random_action(rng);
      const auto truth = robot.poses_in_camera(q);
      const Vector6d e = log(path->predict(q).inverse() * truth.at(1).inverse() * truth.at(5));
      squared += e.dot(path->covariance(q, Variance::kFirstOrder).ldlt().solve(e)) / kActions;
    }
    first_order.push_back(squared);
  }
  // Over the robots; the tails of a path that turns are somewhat heavier than a Gaussian's.
  EXPECT_NEAR(mean(global_distance), 6.17, 0.4);
  // About 40 parameters of 360 numbers.
  EXPECT_NEAR(mean(trained_share), 1, 0.15);
  // What two edges have in common with opposite sign is taken out: added up as if independent they
  // gave half of it. (150 robots: 6.2 ± 0.2.)
  EXPECT_NEAR(mean(first_order), 6, 1.2);
}

/// Of robots with three joints, the mean over some of them and many actions: squared Mahalanobis
/// distance of the hand's pose in the root from where it is, by what the path tells.
double mean_distance_of_imperfect(
    const test::Imperfection& imperfection, int num_robots,
    const std::function<std::vector<ActionPoseSample>(test::ImperfectRobot*)>& record) {
  constexpr int kActions = 100, kRoot = 1, kHand = 4;
  constexpr Noise kNoise{0.003, M_PI / 180};  // of ImperfectRobot
  std::vector<double> distances;
  for (int seed = 1; seed <= num_robots; ++seed) {
    test::ImperfectRobot robot(3, true, imperfection, static_cast<std::uint64_t>(seed));
    LearnOptions options;
    options.measurement.noise = kNoise;
    const BodySchema schema = learn(robot.signals(), record(&robot), options).schema;
    const auto path = KinematicPath::between(schema, kRoot, kHand);
    if (!path) throw std::runtime_error("not learned");
    double sum = 0;
    for (int n = 0; n < kActions; ++n) {
      const Eigen::VectorXd q = robot.random_action();
      robot.go(q);
      const Pose X_RH = robot.poses()[kRoot - 1].inverse() * robot.poses()[kHand - 1];
      const Vector6d e = log(path->predict(q).inverse() * X_RH);
      sum += e.dot(path->covariance(q, Variance::kFirstOrder).ldlt().solve(e)) / kActions;
    }
    distances.push_back(sum);
  }
  return mean(distances);
}

// Motors that miss their commands by 1.5° anew each time: the parameters are as uncertain as that
// makes them, about the pose at the command itself.
TEST(PredictionVariance, OfJointsThatScatterCountsThat) {
  constexpr int kRobots = 20, kActions = 200;
  constexpr double kScatter_rad = 1.5 * M_PI / 180;
  std::vector<double> distances;
  for (int seed = 1; seed <= kRobots; ++seed) {
    Rng rng(seed);
    const test::SyntheticRobot robot = test::chapter_robot("c", rng);
    std::vector<ActionPoseSample> samples;
    for (int t = 0; t < 60; ++t) {
      const Eigen::VectorXd command = robot.random_action(rng);
      Eigen::VectorXd reached = command;
      for (double& angle : reached) angle += kScatter_rad * test::gaussian(rng);
      samples.push_back(test::observe(
          robot, reached, {.regime = test::Regime::kTagIso, .with_covariances = true}, t, rng));
      samples.back().action = command;
    }
    const BodySchema schema = learn(robot.signals, samples).schema;
    ASSERT_TRUE(test::is_right(schema, robot)) << seed;
    const auto path = KinematicPath::between(schema, 1, 5);
    double sum = 0;
    for (int n = 0; n < kActions; ++n) {
      const Eigen::VectorXd q = robot.random_action(rng);
      const auto truth = robot.poses_in_camera(q);
      const Vector6d e = log(path->predict(q).inverse() * truth.at(1).inverse() * truth.at(5));
      sum += e.dot(path->covariance(q, Variance::kFirstOrder).ldlt().solve(e)) / kActions;
    }
    distances.push_back(sum);
  }
  EXPECT_GT(mean(distances), 3.5);
  EXPECT_LT(mean(distances), 9);
}

// 600 samples of smooth motion, whose noise keeps nine tenths from one to the next: as if it were
// new at each, a mean of 6 would be 19 times that, (1 + 0.9)/(1 − 0.9).
TEST(PredictionVariance, OfAStreamCountsNoiseThatLasts) {
  const double d2 = mean_distance_of_imperfect(
      {.correlation = 0.9}, 12, [](test::ImperfectRobot* robot) { return robot->wander(600, 60); });
  EXPECT_GT(d2, 4);
  EXPECT_LT(d2, 10);
}

TEST(PredictionVariance, OfPosesAtRestCountsNoiseThatLasts) {
  const double d2 = mean_distance_of_imperfect(
      {.correlation = 0.9}, 20, [](test::ImperfectRobot* robot) { return robot->babble(100); });
  EXPECT_GT(d2, 4);
  EXPECT_LT(d2, 9);
}

}  // namespace
}  // namespace bodyschema
