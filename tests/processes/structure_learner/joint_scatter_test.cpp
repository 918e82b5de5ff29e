#include "processes/structure_learner/joint_scatter.h"

#include <gtest/gtest.h>

#include <cmath>
#include <string>
#include <vector>

#include "processes/structure_learner/learn.h"
#include "processes/structure_learner/screen.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Regime;
using test::Rng;

// Of the hinge between parts 1 and 2 (±1 rad) whose motor misses the command by `scatter_rad`.
std::vector<ActionPoseSample> samples_of_hinge(double scatter_rad, int num_samples, int seed) {
  Rng rng(static_cast<Rng::result_type>(seed));
  test::SyntheticRobot robot;
  robot.signals = {{"q1", -1, 1}};
  robot.X_CR.translation().z() = 2;
  robot.links.push_back({.part = 1});
  robot.links.push_back({.part = 2,
                         .parent = 1,
                         .X_before = test::random_pose(rng, 0.06, 0.16),
                         .X_after = test::random_pose(rng, 0.06, 0.16),
                         .signal = 0,
                         .turn = 1});
  std::vector<ActionPoseSample> samples;
  for (int t = 0; t < num_samples; ++t) {
    const Eigen::VectorXd command = robot.random_action(rng);
    Eigen::VectorXd reached = command;
    reached(0) += scatter_rad * test::gaussian(rng);
    samples.push_back(test::observe(robot, reached, {Regime::kChapter}, t, rng));
    samples.back().action = command;
  }
  return samples;
}

// `scale`: of the noise that the structure was found with; `told`: of the noise that is told.
double found_scatter(double scatter_rad, int num_samples, int seed, double scale = 1,
                     double told = 1) {
  const auto samples = samples_of_hinge(scatter_rad, num_samples, seed);
  const NormalizedActions actions(samples, 1);
  const auto pair_at = [&](double factor) {
    return make_pair_data(samples, 1, 2,
                          {.noise = test::nominal_noise(Regime::kChapter), .scale = factor}, 2000);
  };
  const PairData pair = pair_at(scale);
  const RelativeMotions motions = relative_motions(pair, 300);
  const Start start =
      one_joint_start(screen_one_joint(motions, actions).at(0), pair, actions, motions.sigma_rad);
  const Fit fit = fit_local_model(start.model, pair, actions, 40);
  return joint_scatter(fit, leave_one_out(fit, pair, actions), pair, pair_at(told), actions)(0) *
         actions.half_range(0);
}

TEST(JointScatter, IsWhatTheMotorMissesTheCommandBy) {
  const double noise_rad = test::nominal_noise(Regime::kChapter).rotation_rad;
  for (const double scatter_rad : {1.5 * noise_rad, 3 * noise_rad}) {
    double mean = 0;
    for (int seed = 1; seed <= 10; ++seed) mean += found_scatter(scatter_rad, 100, seed) / 10;
    EXPECT_NEAR(mean, scatter_rad, 0.15 * scatter_rad);
  }
}

TEST(JointScatter, IsZeroOfAnExactJoint) {
  int zero = 0;
  for (int seed = 1; seed <= 40; ++seed) zero += found_scatter(0, 40, seed) == 0;
  EXPECT_GE(zero, 37);
}

TEST(JointScatter, OfAStructureWithMoreNoiseIsThatBesideTheToldNoise) {
  const double noise_rad = test::nominal_noise(Regime::kChapter).rotation_rad;
  double mean = 0;
  for (int seed = 1; seed <= 10; ++seed)
    mean += found_scatter(3 * noise_rad, 100, seed, /*scale=*/4) / 10;
  EXPECT_NEAR(mean, 3 * noise_rad, 0.45 * noise_rad);
}

TEST(JointScatter, IsZeroWhereTheNoiseIsMoreThanTold) {
  int zero = 0;
  for (int seed = 1; seed <= 40; ++seed)
    zero += found_scatter(0, 40, seed, /*scale=*/1, /*told=*/0.5) == 0;
  EXPECT_GE(zero, 37);
}

TEST(JointScatter, IsInTheLearnedSchema) {
  const double noise_rad = test::nominal_noise(Regime::kChapter).rotation_rad;
  LearnOptions options;
  options.measurement.noise = test::nominal_noise(Regime::kChapter);
  const BodySchema schema =
      learn({{"q1", -1, 1}}, samples_of_hinge(1.5 * noise_rad, 100, 1), options).schema;
  ASSERT_EQ(schema.edges.size(), 1U);
  ASSERT_EQ(schema.edges[0].joints.size(), 1U);
  const ScrewJoint& joint = schema.edges[0].joints[0];
  EXPECT_NEAR(joint.scatter * std::abs(joint.turn), 1.5 * noise_rad, 0.5 * noise_rad);
}

// A chain of hinges (±1 rad), each of which misses its command by `scatter_rad`, less than two
// markers tell of one pose.
std::vector<ActionPoseSample> samples_of_chain(int num_joints, double scatter_rad, int num_samples,
                                               int seed, double outlier_share,
                                               std::vector<Signal>* signals) {
  Rng rng(static_cast<Rng::result_type>(seed));
  test::SyntheticRobot robot;
  robot.X_CR.translation().z() = 2;
  robot.links.push_back({.part = 1});
  for (int n = 0; n < num_joints; ++n) {
    robot.signals.push_back({"q" + std::to_string(n), -1, 1});
    robot.links.push_back({.part = n + 2,
                           .parent = n + 1,
                           .X_before = test::random_pose(rng, 0.06, 0.16),
                           .X_after = test::random_pose(rng, 0.06, 0.16),
                           .signal = n,
                           .turn = 1});
  }
  std::vector<ActionPoseSample> samples;
  for (int t = 0; t < num_samples; ++t) {
    const Eigen::VectorXd command = robot.random_action(rng);
    Eigen::VectorXd reached = command;
    for (double& q : reached) q += scatter_rad * test::gaussian(rng);
    samples.push_back(test::observe(robot, reached, {Regime::kChapter}, t, rng));
    samples.back().action = command;
    for (PartObservation& o : samples.back().parts)
      if (test::uniform(rng, 0, 1) < outlier_share) o.X_CB = test::random_pose(rng, 0.2, 1);
  }
  *signals = robot.signals;
  return samples;
}

// All parts beyond a joint are its witnesses. Pairs alone find none of these.
TEST(JointScatter, OfAChainIsFoundBelowTheNoiseOfItsPairs) {
  const double noise_rad = test::nominal_noise(Regime::kChapter).rotation_rad;
  const double scatter_rad = 0.6 * noise_rad;
  for (const double outlier_share : {0.0, 0.05}) {
    double sum = 0;
    int num_joints = 0;
    for (int seed = 1; seed <= 5; ++seed) {
      LearnOptions options;
      options.measurement.noise = test::nominal_noise(Regime::kChapter);
      std::vector<Signal> signals;
      const auto samples = samples_of_chain(6, scatter_rad, 100, seed, outlier_share, &signals);
      const BodySchema schema = learn(signals, samples, options).schema;
      if (!schema.complete) continue;
      for (const Edge& edge : schema.edges)
        if (edge.to <= 4)  // the first half, which many witness
          for (const ScrewJoint& joint : edge.joints) {
            sum += joint.scatter * std::abs(joint.turn);
            ++num_joints;
          }
    }
    ASSERT_GE(num_joints, 9) << outlier_share;
    EXPECT_NEAR(sum / num_joints, scatter_rad, 0.35 * scatter_rad) << outlier_share;
  }
}

TEST(JointScatter, OfAnExactChainIsZero) {
  int zero = 0;
  for (int seed = 1; seed <= 10; ++seed) {
    LearnOptions options;
    options.measurement.noise = test::nominal_noise(Regime::kChapter);
    std::vector<Signal> signals;
    const auto samples = samples_of_chain(4, 0, 40, seed, 0, &signals);
    for (const Edge& edge : learn(signals, samples, options).schema.edges)
      for (const ScrewJoint& joint : edge.joints) zero += joint.scatter == 0;
  }
  EXPECT_GE(zero, 37);  // of 40
}

}  // namespace
}  // namespace bodyschema
