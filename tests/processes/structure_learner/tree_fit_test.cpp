#include "processes/structure_learner/tree_fit.h"

#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <utility>

#include "common/geometry/angle.h"
#include "processes/structure_learner/joints/missing_joint_test.h"
#include "processes/structure_learner/screen.h"
#include "processes/structure_learner/validity.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Regime;
using test::Rng;
using test::SyntheticRobot;
using test::TrueLink;

// A chain of seven parts: 5 and 6 are rigid, between 3 and 4 slides q4 by ± slide_m, the other
// joints turn by ± 1 rad.
SyntheticRobot chain(double slide_m, Rng& rng) {
  SyntheticRobot robot;
  robot.X_CR.translation() << 0, 0, 2;
  robot.links.push_back({.part = 1});
  const int signals[] = {0, 1, 3, 2, -1, 4};
  for (int n = 0; n < 6; ++n) {
    TrueLink link;
    link.part = n + 2;
    link.parent = n + 1;
    link.X_before = test::random_pose(rng, 0.06, 0.16);
    link.X_after = test::random_pose(rng, 0.06, 0.16);
    link.signal = signals[n];
    if (n == 2)
      link.slide = slide_m;
    else if (link.signal >= 0)
      link.turn = 1;
    robot.links.push_back(link);
  }
  for (int s = 0; s < 5; ++s)
    robot.signals.push_back({.name = "q", .lower = -1, .upper = 1, .warp = {}});
  return robot;
}

struct Case {
  Case(const SyntheticRobot& robot, int num_samples, Regime regime, bool root_moves, Rng& rng)
      : Case(robot, babbled(robot, num_samples, regime, root_moves, rng), {}) {}

  Case(const SyntheticRobot& robot, std::vector<ActionPoseSample> seen,
       const MeasurementModel& measurement)
      : measurement(measurement),
        samples(std::move(seen)),
        actions(samples, static_cast<int>(robot.signals.size())) {
    for (const TrueLink& link : robot.links) {
      TreeNode node;
      node.part = link.part;
      node.parent = link.parent - 1 < 0 ? -1 : link.parent - 1;
      const double q = link.signal < 0 ? 0 : actions.centre(link.signal) - link.zero;
      Pose X = Pose::Identity();
      X.linear() = Eigen::AngleAxisd(link.turn * q, Eigen::Vector3d::UnitZ()).toRotationMatrix();
      X.translation().z() = link.slide * q;
      node.model.first = link.X_before * X;
      if (link.signal < 0) {
        node.model.first = node.model.first * link.X_after;
      } else {
        const double range = actions.half_range(link.signal);
        node.model.joints = {{link.signal, link.slide * range, link.turn * range, link.X_after}};
      }
      nodes.push_back(node);
      data.push_back(
          make_part_data(samples, link.part, measurement, std::numeric_limits<int>::max()));
    }
  }

  static std::vector<ActionPoseSample> babbled(const SyntheticRobot& robot, int num_samples,
                                               Regime regime, bool root_moves, Rng& rng) {
    auto samples =
        test::babble(robot, num_samples, {.regime = regime, .with_covariances = true}, rng);
    if (root_moves)
      for (ActionPoseSample& sample : samples) {
        const Pose X = test::random_pose(rng, 0, 0.5);
        for (PartObservation& o : sample.parts) o.X_CB = X * o.X_CB;
      }
    return samples;
  }

  // The tree without the joint of one node.
  std::vector<TreeNode> without(int node) const {
    std::vector<TreeNode> result = nodes;
    LocalModel rigid;
    rigid.first = nodes[node].model.first * nodes[node].model.joints[0].X_after;
    result[node].model = rigid;
    return result;
  }

  MeasurementModel measurement;
  std::vector<ActionPoseSample> samples;
  NormalizedActions actions;
  std::vector<TreeNode> nodes;
  std::vector<PairData> data;
};

TEST(TreeFit, FindsTheTruthFromAPerturbedStart) {
  for (const bool root_moves : {false, true}) {
    Rng rng(1);
    Case c(chain(0.2, rng), 12, Regime::kFree, root_moves, rng);
    std::vector<TreeNode> nodes = c.nodes;
    for (std::size_t n = 1; n < nodes.size(); ++n)
      for (int d = 0; d <= nodes[n].model.num_joints(); ++d)
        nodes[n].model.transform(d) =
            nodes[n].model.transform(d) * exp(Vector6d(0.02 * test::gaussian6(rng)));
    TreeFit fit(nodes, c.data, c.actions, !root_moves);
    const double before = fit.cost();
    fit.fit(30, 1e-12);
    EXPECT_GT(before, 1000);
    EXPECT_LT(fit.cost(), 1e-9);
  }
}

TEST(TreeFit, ATrueTreeLacksNoJoint) {
  // 7 clusters × 5 signals in 25 robots: under a true tree the log tails are those of uniform
  // numbers, apart from the choice of the best parting and of the better of two tests.
  for (const bool root_moves : {false, true}) {
    int num_tests = 0, num_below = 0;
    double least = 0;
    for (int seed = 0; seed < 25; ++seed) {
      Rng rng(seed);
      Case c(chain(0.2, rng), 25, Regime::kChapter, root_moves, rng);
      TreeFit fit(c.nodes, c.data, c.actions, !root_moves);
      fit.fit(20, 1e-3);
      for (const MissingJoint& joint : missing_joints(fit, {})) {
        ++num_tests;
        const double corrected = joint.log_tail + std::log(2.0) + joint.log_ways;
        num_below += corrected < std::log(0.05);
        least = std::min(least, corrected);
      }
    }
    EXPECT_GT(num_tests, 500);
    EXPECT_LT(num_below, 0.05 * num_tests);
    EXPECT_GT(least, std::log(0.1 / num_tests));
  }
}

TEST(TreeFit, AllMarkersTogetherShowAJointThatNoPairShows) {
  int num_rigid = 0, num_found = 0;
  constexpr int kRobots = 20;
  for (int seed = 0; seed < kRobots; ++seed) {
    Rng rng(seed);
    Case c(chain(0.04, rng), 30, Regime::kChapter, false, rng);
    // Part 4 rigid on part 3: the two markers have nothing against it.
    const PairData pair = make_pair_data(c.samples, 3, 4, c.measurement, 1000);
    const Fit rigid = fit_local_model(screen_rigid(pair, c.actions).model, pair, c.actions, 30);
    num_rigid +=
        check_validity(rigid, leave_one_out(rigid, pair, c.actions), pair, c.actions, {}).verdict ==
        Verdict::kValid;
    TreeFit fit(c.without(3), c.data, c.actions, true);
    fit.fit(20, 1e-3);
    const auto missing = missing_joints(fit, {});
    ASSERT_FALSE(missing.empty());
    const MissingJoint& best = missing.front();
    if (best.log_tail > -13 || best.signal != 3) continue;
    // Part 4 and what hangs on it against part 3 and what that hangs on.
    if (best.members != std::vector<int>{3} || best.branches != std::vector<int>{4}) continue;
    ++num_found;
    EXPECT_NEAR(best.xi.head<3>().norm(), 0.04, 0.02);

    const auto edges = insert_joint(fit.nodes(), best);
    ASSERT_TRUE(edges.has_value());
    std::vector<TreeNode> grown = c.nodes;
    ASSERT_EQ(edges->size(), grown.size() - 1);
    for (const TreeEdge& e : *edges) {
      const int child = std::max(e.a, e.b);
      EXPECT_EQ(std::min(e.a, e.b), grown[child].parent);
      grown[child].model = e.a < e.b ? e.model : e.model.inverse();
    }
    EXPECT_EQ(grown[3].model.joints[0].signal, 3);
    TreeFit with(grown, c.data, c.actions, true);
    with.fit(20, 1e-3);
    // The score statistic is twice the gain in log likelihood, to second order.
    EXPECT_NEAR(fit.cost() - with.cost(), 0.5 * best.statistic, 0.35 * best.statistic);
  }
  EXPECT_GE(num_rigid, kRobots / 2);
  EXPECT_GE(num_found, kRobots * 3 / 4);
}

TEST(TreeFit, AMarkersOwnBiasIsNoJoint) {
  // Read 3 mm aside at the ends of the first signal's range: with samples enough that is
  // significant.
  Rng rng(1);
  Case c(chain(0.2, rng), 400, Regime::kTagIso, false, rng);
  for (ActionPoseSample& sample : c.samples)
    for (PartObservation& o : sample.parts)
      if (o.part == 4) o.X_CB = o.X_CB * Eigen::Translation3d(0, 0.003 * sample.action(0), 0);
  c.data[3] = make_part_data(c.samples, 4, c.measurement, std::numeric_limits<int>::max());
  TreeFit fit(c.nodes, c.data, c.actions, true);
  fit.fit(20, 1e-3);
  const auto worst = [&](const Noise& bias) {
    const auto missing = missing_joints(fit, bias);
    return *std::min_element(missing.begin(), missing.end(),
                             [](const auto& x, const auto& y) { return x.log_tail < y.log_tail; });
  };
  EXPECT_LT(worst({}).log_tail, -20);
  EXPECT_EQ(worst({}).signal, 0);
  EXPECT_EQ(worst({}).members, std::vector<int>{3});
  EXPECT_GT(worst({0.003, 0.2 * kDegree}).log_tail, -10);

  // A true joint is far beyond the bias.
  TreeFit lacking(c.without(3), c.data, c.actions, true);
  lacking.fit(20, 1e-3);
  const auto missing = missing_joints(lacking, {0.003, 0.2 * kDegree});
  ASSERT_FALSE(missing.empty());
  EXPECT_LT(missing.front().log_tail, -100);
}

TEST(TreeFit, AJointThatMovesBranchesOnlyIsPutIntoTheirEdges) {
  Rng rng(1);
  Case c(chain(0.2, rng), 5, Regime::kFree, false, rng);
  const TreeFit fit(c.nodes, c.data, c.actions, true);
  MissingJoint joint;
  joint.top = 1;
  joint.signal = 4;
  joint.branches = {2};
  joint.xi << 0, 0, 0, 0, 0.5, 0;
  const auto edges = insert_joint(fit.nodes(), joint);
  ASSERT_TRUE(edges.has_value());
  int num_joints = 0;
  for (const TreeEdge& e : *edges) num_joints += e.model.num_joints();
  EXPECT_EQ(num_joints, 6);  // five of the chain and the new one
  // Twice is too much for one edge.
  std::vector<TreeNode> nodes = c.nodes;
  for (const TreeEdge& e : *edges)
    if (std::max(e.a, e.b) == 2) nodes[2].model = e.a < e.b ? e.model : e.model.inverse();
  joint.signal = 3;
  const TreeFit full(nodes, c.data, c.actions, true);
  EXPECT_FALSE(insert_joint(full.nodes(), joint).has_value());
  EXPECT_EQ(full_edges(full.nodes(), joint), std::vector<int>{2});
}

struct SquaredDistances {
  double of_root = 0;
  double of_edge = 0;  ///< with the last joint, at the last pose
};

/// Of what the fit finds from the truth that `c` begins with, by the covariances it tells: χ²₆ if
/// they are true.
SquaredDistances squared_distances(const Case& c, const Pose& X_CR,
                                   const MeasurementModel& measurement, double view_share) {
  TreeFit fit(c.nodes, c.data, c.actions, true);
  fit.fit(30, 1e-9);
  const auto covariance = fit.covariance(measurement, view_share);
  if (!covariance) throw std::runtime_error("no covariance");
  const Vector6d root = log(fit.root_pose().inverse() * X_CR);
  const int last = static_cast<int>(c.samples.size()) - 1;
  ParameterJacobian J;
  const Pose X = predict_with_jacobian(fit.nodes()[6].model, c.actions, last, &J);
  const Vector6d edge = log(X.inverse() * c.nodes[6].model.predict(c.actions, last));
  return {root.dot(covariance->root.ldlt().solve(root)),
          edge.dot((J * covariance->models[6] * J.transpose()).ldlt().solve(edge))};
}

// Ten poses, each seen once or four times: what a view biases is the same each time.
TEST(TreeFit, CovariancesAreTrueHoweverOftenAViewIsRepeated) {
  constexpr double kShare = 0.3;
  constexpr int kPoses = 10, kRobots = 40;
  const MeasurementModel measurement{.systematic = {.position_m = 0.001, .rotation_rad = 0.004}};
  const Matrix6d noise = isotropic({.position_m = 0.0015, .rotation_rad = 0.006});
  const Matrix6d M = measurement.systematic_covariance();
  for (const int repeats : {1, 4}) {
    double of_root = 0, of_edge = 0;
    for (int seed = 1; seed <= kRobots; ++seed) {
      Rng rng(seed);
      const SyntheticRobot robot = chain(0.1, rng);
      const auto drawn = [&](const Matrix6d& covariance) -> Vector6d {
        return covariance.diagonal().cwiseSqrt().cwiseProduct(
            Vector6d::NullaryExpr([&] { return test::gaussian(rng); }));
      };
      std::vector<ActionPoseSample> samples;
      const Vector6d root_bias = drawn(M + kShare * noise);  // the root rests: one view
      for (int pose = 0; pose < kPoses; ++pose) {
        const Eigen::VectorXd action = robot.random_action(rng);
        const auto truth = robot.poses_in_camera(action);
        std::map<int, Vector6d> bias;
        for (const auto& [part, X] : truth)
          bias[part] = part == 1 ? root_bias : drawn(M + kShare * noise);
        for (int n = 0; n < repeats; ++n) {
          ActionPoseSample& sample = samples.emplace_back();
          sample.sample_index = static_cast<std::int64_t>(samples.size()) - 1;
          sample.action = action;
          for (const auto& [part, X] : truth) {
            PartObservation& seen = sample.parts.emplace_back();
            seen.part = part;
            seen.X_CB = X * exp(bias[part] + drawn((1 - kShare) * noise));
            seen.covariance = noise;
          }
        }
      }
      Case c(robot, samples, measurement);
      const auto [root, edge] = squared_distances(c, robot.X_CR, measurement, kShare);
      of_root += root / kRobots;
      of_edge += edge / kRobots;
    }
    EXPECT_NEAR(of_root, 6, 3 * std::sqrt(12.0 / kRobots)) << repeats;
    EXPECT_NEAR(of_edge, 6, 3 * std::sqrt(12.0 / kRobots)) << repeats;
  }
}

// Each part has two tags, which sit elsewhere and are larger than told; one or both are seen.
TEST(TreeFit, CovariancesAreTrueHoweverOftenATagIsSeen) {
  constexpr int kRobots = 40;
  const MeasurementModel measurement{
      .tags = {.position_m = 0.002, .rotation_rad = 0.01, .size_share = 0.003}};
  const Matrix6d noise = isotropic({.position_m = 0.001, .rotation_rad = 0.004});
  for (const int num_poses : {10, 60}) {
    double of_root = 0, of_edge = 0;
    for (int seed = 1; seed <= kRobots; ++seed) {
      Rng rng(seed);
      const SyntheticRobot robot = chain(0.1, rng);
      const auto drawn = [&](auto size) -> Eigen::Matrix<double, size(), 1> {
        return Eigen::Matrix<double, size(), 1>::NullaryExpr([&] { return test::gaussian(rng); });
      };
      std::map<int, Eigen::Matrix<double, 7, 1>> of_tag;
      std::vector<ActionPoseSample> samples(static_cast<std::size_t>(num_poses));
      for (std::size_t t = 0; t < samples.size(); ++t) {
        samples[t].sample_index = static_cast<std::int64_t>(t);
        samples[t].action = robot.random_action(rng);
        for (const auto& [part, X] : robot.poses_in_camera(samples[t].action)) {
          PartObservation& seen = samples[t].parts.emplace_back();
          seen.part = part;
          seen.tags = {2 * part, 2 * part + 1};
          if (test::uniform(rng, 0, 1) < 0.5) seen.tags.pop_back();
          const auto effect = measurement.effect_of_tag(X, seen.tags.size());
          Vector6d error = noise.llt().matrixL() * drawn(std::integral_constant<int, 6>{});
          seen.covariance = noise;
          for (const int tag : seen.tags) {
            if (!of_tag.contains(tag)) of_tag[tag] = drawn(std::integral_constant<int, 7>{});
            error += effect * of_tag[tag];
            seen.covariance += effect * effect.transpose();
          }
          seen.X_CB = X * exp(error);
        }
      }
      Case c(robot, samples, measurement);
      const auto [root, edge] = squared_distances(c, robot.X_CR, measurement, 0);
      of_root += root / kRobots;
      of_edge += edge / kRobots;
    }
    EXPECT_NEAR(of_root, 6, 3 * std::sqrt(12.0 / kRobots)) << num_poses;
    EXPECT_NEAR(of_edge, 6, 3 * std::sqrt(12.0 / kRobots)) << num_poses;
  }
}

// A screw frame may turn about its axis and slide along it: no prediction tells how far.
TEST(TreeFit, WhatNoPredictionDependsOnIsAsSureAsTheRest) {
  Rng rng(5);
  const SyntheticRobot robot = chain(0.1, rng);
  const Case c(robot, 40, Regime::kTagIso, false, rng);
  TreeFit fit(c.nodes, c.data, c.actions, true);
  fit.fit(30, 1e-9);
  const auto covariance = fit.covariance(c.measurement, 0.1);
  ASSERT_TRUE(covariance);
  for (std::size_t k = 1; k < c.nodes.size(); ++k)
    if (c.nodes[k].model.num_joints() > 0 && c.nodes[k].model.joints[0].turn != 0)
      EXPECT_LT(covariance->models[k].diagonal().maxCoeff(), 1e-3) << k;
}

TEST(TreeFit, ATreeWhoseRootMovesHasNoCovariance) {
  Rng rng(5);
  const Case c(chain(0.1, rng), 20, Regime::kTag, true, rng);
  const TreeFit fit(c.nodes, c.data, c.actions, false);
  EXPECT_FALSE(fit.covariance(c.measurement, 0.1));
}

}  // namespace
}  // namespace bodyschema
