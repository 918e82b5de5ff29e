#include "tests/experiments/figures/cramer_rao.h"

#include <gtest/gtest.h>

#include <Eigen/QR>
#include <cmath>

#include "tests/experiments/figures/robots.h"

namespace bodyschema::experiments {
namespace {

using test::Regime;
using test::Rng;
using test::SyntheticRobot;

TEST(CramerRao, KnowsHowEveryPoseDependsOnEveryParameter) {
  for (const char* kind : {"a", "b", "c", "d", "dP", "tree"}) {
    const Trial trial = make_trial(kind, Regime::kFree, 1, 3);
    const CramerRao bound(trial.robot);
    const Eigen::VectorXd q = trial.test_actions[0];
    constexpr double kStep = 1e-6;
    for (const int part : trial.robot.visible_parts()) {
      const Eigen::MatrixXd J = bound.pose_jacobian(part, q);
      for (int n = 0; n < bound.num_parameters(); ++n) {
        const Eigen::VectorXd step = kStep * Eigen::VectorXd::Unit(bound.num_parameters(), n);
        const Pose plus = bound.perturbed(step).poses_in_camera(q).at(part);
        const Pose minus = bound.perturbed(-step).poses_in_camera(q).at(part);
        const Vector6d numeric = log(minus.inverse() * plus) / (2 * kStep);
        EXPECT_LT((J.col(n) - numeric).norm(), 1e-7) << kind << " part " << part << ", " << n;
      }
    }
  }
}

// Two rigidly connected parts: the information of N samples is that of the mean of z.
TEST(CramerRao, OfARigidConnectionIsTheCovarianceOfTheMean) {
  Rng rng(5);
  SyntheticRobot robot;
  robot.links.push_back({.part = 1});
  robot.links.push_back({.part = 2, .parent = 1, .X_before = test::random_pose(rng, 0.1, 0.3)});
  robot.X_CR = test::random_pose(rng, 1, 2);
  test::ObservationOptions options;
  options.regime = Regime::kChapter;
  options.with_covariances = true;
  CramerRao bound(robot);
  constexpr int kSamples = 7;
  const auto samples = test::babble(robot, kSamples, options, rng);
  for (const ActionPoseSample& sample : samples) bound.add(sample);
  const Eigen::VectorXd q(0);
  const auto X = robot.poses_in_camera(q);
  const Pose z = X.at(1).inverse() * X.at(2);
  const Matrix6d expected =
      relative_covariance(z, samples[0].find(1)->covariance, samples[0].find(2)->covariance) /
      kSamples;
  EXPECT_TRUE(bound.bound(1, 2, q).isApprox(expected, 1e-6));
}

TEST(CramerRao, IsInfiniteWhereNothingWasSeen) {
  Trial trial = make_trial("a", Regime::kChapter, 10, 1);
  for (ActionPoseSample& sample : trial.samples)
    std::erase_if(sample.parts, [](const auto& o) { return o.part == 5; });
  CramerRao bound(trial.robot);
  for (const ActionPoseSample& sample : trial.samples) bound.add(sample);
  EXPECT_TRUE(std::isfinite(bound.bound(1, 4, trial.test_actions[0])(0, 0)));
  EXPECT_TRUE(std::isinf(bound.bound(1, 5, trial.test_actions[0])(0, 0)));
  CramerRao at_one_pose(trial.robot);  // a joint that was never moved is not known
  for (int n = 0; n < 5; ++n) at_one_pose.add(trial.samples[0]);
  EXPECT_TRUE(std::isinf(at_one_pose.bound(1, 4, trial.test_actions[0])(0, 0)));
}

/// Errors of all marker poses, `seen` by sample, in standard deviations.
Eigen::VectorXd whitened(const SyntheticRobot& model, const std::vector<ActionPoseSample>& samples,
                         const std::vector<std::map<int, Pose>>& seen, const Vector6d& variances) {
  const Vector6d whitening = variances.cwiseSqrt().cwiseInverse();
  Eigen::VectorXd result(6 * 5 * static_cast<Eigen::Index>(samples.size()));
  Eigen::Index row = 0;
  for (std::size_t t = 0; t < samples.size(); ++t) {
    const auto X = model.poses_in_camera(samples[t].action);
    for (const auto& [part, y] : seen[t]) {
      result.segment<6>(row) = whitening.cwiseProduct(log(X.at(part).inverse() * y));
      row += 6;
    }
  }
  return result;
}

SyntheticRobot fitted(SyntheticRobot model, const std::vector<ActionPoseSample>& samples,
                      const std::vector<std::map<int, Pose>>& seen, const Vector6d& variances) {
  constexpr double kStep = 1e-6;
  for (int iteration = 0; iteration < 2; ++iteration) {
    const CramerRao parameters(model);
    const Eigen::VectorXd r = whitened(model, samples, seen, variances);
    Eigen::MatrixXd J(r.size(), parameters.num_parameters());
    for (int n = 0; n < parameters.num_parameters(); ++n) {
      const Eigen::VectorXd step = kStep * Eigen::VectorXd::Unit(parameters.num_parameters(), n);
      J.col(n) = (whitened(parameters.perturbed(step), samples, seen, variances) - r) / kStep;
    }
    // Along the gauge the step of least norm; numeric derivatives there are noise.
    Eigen::CompleteOrthogonalDecomposition<Eigen::MatrixXd> solver;
    solver.setThreshold(1e-5);
    solver.compute(J);
    model = parameters.perturbed(-solver.solve(r));
  }
  return model;
}

// Maximum likelihood attains the bound where noise is small: Gauss–Newton with numeric derivatives
// over all marker poses, on the same actions again and again.
TEST(CramerRao, IsWhatMaximumLikelihoodReaches) {
  Rng rng(9);
  const SyntheticRobot robot = test::chapter_robot("a", rng);
  constexpr int kSamples = 8, kRuns = 300;
  constexpr double kPosition = 0.002, kRotation = 0.005;
  Vector6d variances;
  variances << Eigen::Vector3d::Constant(kPosition * kPosition),
      Eigen::Vector3d::Constant(kRotation * kRotation);
  std::vector<ActionPoseSample> samples(kSamples);
  for (ActionPoseSample& sample : samples) {
    sample.action = robot.random_action(rng);
    for (const int part : robot.visible_parts()) {
      PartObservation o;
      o.part = part;
      o.covariance = variances.asDiagonal();
      sample.parts.push_back(o);
    }
  }
  CramerRao bound(robot);
  for (const ActionPoseSample& sample : samples) bound.add(sample);
  const Eigen::VectorXd q_test = robot.random_action(rng);
  const Matrix6d expected = bound.bound(1, 5, q_test);

  Matrix6d scatter = Matrix6d::Zero();
  const auto truth = robot.poses_in_camera(q_test);
  const Pose X_true = truth.at(1).inverse() * truth.at(5);
  for (int run = 0; run < kRuns; ++run) {
    std::vector<std::map<int, Pose>> seen(kSamples);
    for (int t = 0; t < kSamples; ++t)
      for (const auto& [part, X] : robot.poses_in_camera(samples[t].action))
        seen[t][part] = X * exp(variances.cwiseSqrt().cwiseProduct(test::gaussian6(rng)));
    const SyntheticRobot model = fitted(robot, samples, seen, variances);
    const auto X = model.poses_in_camera(q_test);
    const Vector6d error = log(X_true.inverse() * (X.at(1).inverse() * X.at(5)));
    scatter += error * error.transpose() / kRuns;
  }
  // Means of squares over 300 runs: 8 % standard deviation each.
  for (int n = 0; n < 6; ++n) EXPECT_NEAR(scatter(n, n) / expected(n, n), 1, 0.25) << n;
  const double ratio = (expected.ldlt().solve(scatter)).trace() / 6;
  EXPECT_NEAR(ratio, 1, 0.1);
}

// The prototype's bound (24 robots of its own): 50, 24.5, 16.9, 9.18 mm at N = 5, 15, 30, 100.
TEST(CramerRao, OfTheTwoAxisRobotInTheChaptersNoiseIsThePrototypes) {
  constexpr int kRobots = 40;
  const std::vector<std::pair<int, double>> prototype = {
      {5, 0.050}, {15, 0.0245}, {30, 0.0169}, {100, 0.00918}};
  std::vector<double> mean(prototype.size());
  for (int seed = 1; seed <= kRobots; ++seed) {
    const Trial trial = make_trial("a", Regime::kChapter, 100, seed);
    CramerRao bound(trial.robot);
    int added = 0;
    for (std::size_t n = 0; n < prototype.size(); ++n) {
      for (; added < prototype[n].first; ++added) bound.add(trial.samples[added]);
      mean[n] += position_bound_rms(bound, 1, 5, trial.test_actions) / kRobots;
    }
  }
  for (std::size_t n = 0; n < prototype.size(); ++n)
    EXPECT_NEAR(mean[n] / prototype[n].second, 1, 0.1) << "N = " << prototype[n].first;
}

}  // namespace
}  // namespace bodyschema::experiments
