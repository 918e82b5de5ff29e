#include "processes/structure_learner/edge_fit.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <vector>

#include "common/geometry/angle.h"
#include "processes/structure_learner/learn.h"
#include "processes/structure_learner/wrong_commands.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Regime;

// Parts 1 – 2 – 3 in a row, hinges q0 and q1; q2 moves nothing.
test::SyntheticRobot two_hinges(test::Rng& rng) {
  test::SyntheticRobot robot;
  robot.signals = {{"q0", -1, 1}, {"q1", -1, 1}, {"q2", -1, 1}};
  robot.X_CR.translation().z() = 2;
  robot.links.push_back({.part = 1});
  for (int n = 0; n < 2; ++n)
    robot.links.push_back({.part = n + 2,
                           .parent = n + 1,
                           .X_before = test::random_pose(rng, 0.06, 0.16),
                           .X_after = test::random_pose(rng, 0.06, 0.16),
                           .signal = n,
                           .turn = 1});
  return robot;
}

// A hinge on `signal` anywhere.
LocalModel hinge(int signal, test::Rng& rng) {
  LocalModel model;
  model.first = test::random_pose(rng, 0.06, 0.16);
  LocalModel::Joint joint;
  joint.signal = signal;
  joint.turn = 1;
  joint.X_after = test::random_pose(rng, 0.06, 0.16);
  model.joints.push_back(joint);
  return model;
}

// Parts 2 and 3 are seen together twice alone: any model of one joint fits that exactly.
TEST(FitJointly, DropsAnEdgeThatTheOtherPartsContradict) {
  for (const int signal : {1, 2}) {
    test::Rng rng(5);
    const test::SyntheticRobot robot = two_hinges(rng);
    std::vector<ActionPoseSample> samples;
    for (int t = 0; t < 40; ++t) {
      samples.push_back(test::observe(robot, robot.random_action(rng), {Regime::kTagIso}, t, rng));
      if (t >= 2)
        std::erase_if(samples.back().parts,
                      [t](const PartObservation& o) { return o.part == 2 + t % 2; });
    }
    const NormalizedActions actions(samples, 3);
    const MeasurementModel measurement{.noise = test::nominal_noise(Regime::kTagIso)};
    const EdgeData data{samples, actions, measurement, measurement, {}};
    LocalModel true_first = hinge(0, rng), last = hinge(signal, rng);
    const Edge of_2 = robot.true_edge(1, 2), of_3 = robot.true_edge(2, 3);
    true_first.first = of_2.left;
    true_first.joints[0].X_after = of_2.joints[0].X_after;
    true_first.joints[0].turn = of_2.joints[0].turn;
    last.first = of_3.left;
    last.joints[0].X_after = of_3.joints[0].X_after;
    std::vector<FittedEdge> fitted{
        fit_edge({.part_i = 1, .part_j = 2, .model = true_first}, 1, 2, data, false),
        fit_edge({.part_i = 2, .part_j = 3, .model = last}, 2, 3, data, false)};
    ASSERT_EQ(fitted[1].frames.size(), 2U);
    BodySchema schema;
    schema.root = 1;
    schema.signals = robot.signals;
    Refusals refused;
    fit_jointly(data, &fitted, &schema, &refused);
    ASSERT_EQ(fitted.size(), signal == 1 ? 2U : 1U) << signal;
    if (signal != 1) EXPECT_EQ(refused.at({2, 3}), Refusal::kContradicted);
    EXPECT_EQ(fitted[0].edge.to, 2);
  }
}

// The joints of an edge as the joint fit of parts 1 and 2 leaves it, by signal; none: it was
// dropped.
std::vector<int> joints_left(const test::SyntheticRobot& robot,
                             const std::vector<ActionPoseSample>& samples, LocalModel start) {
  const NormalizedActions actions(samples, 3);
  const MeasurementModel measurement{.noise = test::nominal_noise(Regime::kTagIso)};
  const EdgeData data{samples, actions, measurement, measurement, {}};
  const Edge truth = robot.true_edge(1, 2);
  start.first = truth.left;
  start.joints.back().X_after = truth.joints[0].X_after;
  std::vector<FittedEdge> fitted{
      fit_edge({.part_i = 1, .part_j = 2, .model = start}, 1, 2, data, false)};
  BodySchema schema;
  schema.root = 1;
  schema.signals = robot.signals;
  Refusals refused;
  fit_jointly(data, &fitted, &schema, &refused);
  EXPECT_EQ(refused.empty(), !fitted.empty());
  std::vector<int> signals;
  if (!fitted.empty())
    for (const ScrewJoint& joint : fitted[0].edge.joints) signals.push_back(joint.signal);
  return signals;
}

// What a motor misses its command by passes for a little joint of an idle signal.
TEST(FitJointly, DropsAJointThatMayBeNone) {
  test::Rng rng(6);
  const test::SyntheticRobot robot = two_hinges(rng);
  std::vector<ActionPoseSample> samples;
  for (int t = 0; t < 60; ++t) {
    const Eigen::VectorXd command = robot.random_action(rng);
    Eigen::VectorXd reached = command;
    reached(0) += 0.03 * test::gaussian(rng);
    samples.push_back(test::observe(robot, reached, {Regime::kTagIso}, t, rng));
    samples.back().action = command;
  }
  LocalModel two = hinge(2, rng);
  two.joints[0].turn = 0.01;
  two.joints[0].X_after = Pose::Identity();
  two.joints.push_back(hinge(0, rng).joints[0]);
  EXPECT_EQ(joints_left(robot, samples, two), std::vector<int>{0});
}

// A hinge that turns steeply at the end of its range: what is not seen is not wrong there.
TEST(FitJointly, DropsAnEdgeThatIsWrongAtOneEndOfACommand) {
  for (const double steep : {0.0, 2.0}) {
    test::Rng rng(7);
    const test::SyntheticRobot robot = two_hinges(rng);
    std::vector<ActionPoseSample> samples;
    for (int t = 0; t < 80; ++t) {
      const Eigen::VectorXd command = robot.random_action(rng);
      Eigen::VectorXd reached = command;
      reached(0) += steep * std::min(command(0) + 0.8, 0.0);
      samples.push_back(test::observe(robot, reached, {Regime::kTagIso}, t, rng));
      samples.back().action = command;
    }
    EXPECT_EQ(joints_left(robot, samples, hinge(0, rng)).size(), steep == 0 ? 1U : 0U);
  }
}

TEST(IsWrongAtSomeCommands, WhereOutliersStandTogetherAndNotWhereTheyAreScattered) {
  std::vector<ActionPoseSample> samples(60);
  test::Rng rng(8);
  for (ActionPoseSample& sample : samples)
    sample.action = Eigen::Vector2d(test::uniform(rng, -1, 1), test::uniform(rng, -1, 1));
  const NormalizedActions actions(samples, 2);
  FittedEdge fitted;
  fitted.edge.joints.push_back({.signal = 0});
  for (const bool is_together : {false, true}) {
    fitted.frames.clear();
    fitted.outlying.clear();
    for (int t = 0; t < 60; ++t) {
      fitted.frames.push_back(t);
      fitted.outlying.push_back(is_together ? samples[t].action(0) < -0.4 : t % 5 == 0);
    }
    EXPECT_EQ(is_wrong_at_some_commands(fitted, actions), is_together);
  }
  // Be it a command of the model's own signals or not; and with some poses right there, too.
  fitted.edge.joints.clear();
  EXPECT_TRUE(is_wrong_at_some_commands(fitted, actions));
  const auto wrong = std::ranges::find(fitted.outlying, true);
  *std::find(wrong + 1, fitted.outlying.end(), true) = false;
  EXPECT_TRUE(is_wrong_at_some_commands(fitted, actions));
  // Few, if they are all in a row.
  std::vector<int> order = fitted.frames;
  std::ranges::sort(order, {}, [&](int t) { return samples[t].action(1); });
  fitted.outlying.assign(samples.size(), false);
  for (int n = 0; n < 7; ++n) fitted.outlying[order[n]] = true;
  EXPECT_TRUE(is_wrong_at_some_commands(fitted, actions));
  fitted.outlying[order[3]] = false;
  EXPECT_FALSE(is_wrong_at_some_commands(fitted, actions));
}

TEST(IsWrongAtSomeCommands, WhereOutliersAreAllPosesAtWhichASignalMoved) {
  test::Rng rng(4);
  std::vector<ActionPoseSample> samples(60);
  std::vector<int> frames;
  for (int t = 0; t < 60; ++t) {
    samples[t].action = Eigen::Vector2d(test::uniform(rng, -1, 1), 1e-4 * test::gaussian(rng));
    frames.push_back(t);
  }
  samples[20].action(1) = 0.4;
  samples[40].action(1) = -0.7;
  const NormalizedActions actions(samples, 2);
  std::vector<bool> outlying(60, false);
  outlying[5] = outlying[20] = true;
  EXPECT_FALSE(is_wrong_at_some_commands(frames, outlying, actions));
  outlying[40] = true;
  EXPECT_TRUE(is_wrong_at_some_commands(frames, outlying, actions));
}

// A hinge that rests at most poses is no rigid edge whose markers are misread at the others.
TEST(FitJointly, LeavesNoHingeThatMovedInFewPosesRigid) {
  for (int seed = 1; seed <= 4; ++seed) {
    test::Rng rng(seed);
    const test::SyntheticRobot robot = two_hinges(rng);
    std::vector<ActionPoseSample> samples;
    for (int t = 0; t < 70; ++t) {
      Eigen::VectorXd action = robot.random_action(rng);
      if (t % 30 != 9) action(1) = 0;
      samples.push_back(test::observe(robot, action, {Regime::kTagIso}, t, rng));
    }
    LearnOptions options;
    options.measurement.noise = Noise{0.003, 1 * kDegree};
    const LearnResult result = learn(robot.signals, samples, options);
    for (const Edge& edge : result.schema.edges)
      if (edge.from != robot.visible_parts()[0] || edge.to != robot.visible_parts()[1])
        EXPECT_FALSE(edge.joints.empty()) << seed;
  }
}

TEST(IsWrongAtAnEnd, WhereOutliersFollowOneAnotherThereAndNotElsewhere) {
  const auto is_wrong = [](auto is_outlier) {
    FittedEdge fitted;
    for (int t = 0; t < 100; ++t) {
      fitted.frames.push_back(t);
      fitted.outlying.push_back(is_outlier(t));
    }
    return is_wrong_at_an_end(fitted, TimeBlocks());
  };
  EXPECT_TRUE(is_wrong([](int t) { return t >= 97; }));
  EXPECT_TRUE(is_wrong([](int t) { return t < 3; }));
  EXPECT_TRUE(is_wrong([](int t) { return t % 5 == 0 || t > 90; }));
  EXPECT_FALSE(is_wrong([](int t) { return t >= 98; }));
  EXPECT_FALSE(is_wrong([](int t) { return t >= 60 && t < 75; }));
  EXPECT_FALSE(is_wrong([](int t) { return t % 3 == 0 || t > 95; }));
  EXPECT_FALSE(is_wrong([](int) { return false; }));
}

}  // namespace
}  // namespace bodyschema
