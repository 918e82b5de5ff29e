#include "tests/experiments/figures/experiment.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <stdexcept>
#include <vector>

#include "tests/experiments/figures/robots.h"

namespace bodyschema::experiments {
namespace {

TEST(Table, IsMarkdown) {
  Table table({"N", "mm"});
  table.add({"5", "1.2"});
  EXPECT_EQ(table.markdown(), "| N | mm |\n| --- | --- |\n| 5 | 1.2 |\n");
  EXPECT_THROW(table.add({"5"}), std::logic_error);
}

TEST(ForEachRobot, DoesEveryRobotOnceOnAnyNumberOfThreads) {
  for (const int jobs : {1, 3}) {
    experiments::Setup setup;
    setup.jobs = jobs;
    std::vector<int> done(50);
    double last = 0;
    setup.progress = [&last](const std::string&, double share) { last = share; };
    for_each_robot(setup, "part", 50, [&](int n) { ++done[n]; });
    EXPECT_EQ(done, std::vector<int>(50, 1));
    EXPECT_EQ(last, 1);
  }
}

TEST(ForEachRobot, PassesOnWhatOneOfThemThrows) {
  experiments::Setup setup;
  setup.jobs = 2;
  EXPECT_THROW(for_each_robot(setup, "part", 20,
                              [](int n) {
                                if (n == 7) throw std::runtime_error("seven");
                              }),
               std::runtime_error);
}

TEST(Trials, AreFunctionsOfTheirSeed) {
  const Trial one = make_trial("d", test::Regime::kTag, 5, 4),
              same = make_trial("d", test::Regime::kTag, 5, 4),
              longer = make_trial("d", test::Regime::kTag, 9, 4),
              other = make_trial("d", test::Regime::kTag, 5, 5);
  EXPECT_EQ(one.samples[4].action, same.samples[4].action);
  EXPECT_EQ(one.samples[4].parts[0].X_CB.matrix(), longer.samples[4].parts[0].X_CB.matrix());
  EXPECT_EQ(one.test_actions[9], longer.test_actions[9]);
  EXPECT_NE(one.samples[4].action, other.samples[4].action);
}

TEST(Errors, AreThoseOfTheTrueRobot) {
  const Trial trial = make_trial("a", test::Regime::kFree, 10, 1);
  BodySchema schema = learn(trial.robot.signals, trial.samples).schema;
  EXPECT_LT(end_effector_errors(schema, trial)->position_mean_m, 1e-12);
  // 3 mm beside it, everywhere.
  const auto last = std::find_if(schema.edges.begin(), schema.edges.end(),
                                 [&](const Edge& e) { return e.to == trial.end_effector(); });
  ASSERT_NE(last, schema.edges.end());
  last->right.translation() += Eigen::Vector3d(0.003, 0, 0);
  const auto errors = end_effector_errors(schema, trial);
  EXPECT_NEAR(errors->position_mean_m, 0.003, 1e-12);
  EXPECT_NEAR(errors->position_rms_m, 0.003, 1e-12);
  EXPECT_LT(errors->rotation_mean_rad, 1e-12);
  schema.edges.erase(last);
  EXPECT_FALSE(end_effector_errors(schema, trial).has_value());
}

TEST(BaselineOnTrueStructure, HasTheTrueSignalsOnEveryEdge) {
  const Trial trial = make_trial("d", test::Regime::kFree, 8, 2);
  const BodySchema schema = baseline_on_true_structure(trial, trial.samples);
  EXPECT_TRUE(test::is_right(schema, trial.robot));
  for (const Edge& edge : schema.edges) EXPECT_STREQ(edge.kind(), "matrix_gp");
}

TEST(SyntheticRobots, TheSphericalJointsAxesCrossAtARightAngle) {
  const Trial trial = make_trial("b", test::Regime::kFree, 1, 6);
  const auto& links = trial.robot.links;
  ASSERT_EQ(links.size(), 3u);
  EXPECT_EQ(trial.robot.visible_parts(), (std::vector<int>{1, 2}));
  const Pose between = links[1].X_after * links[2].X_before;
  EXPECT_EQ(between.translation().norm(), 0);
  EXPECT_NEAR(between.linear().col(2).z(), 0, 1e-15);
  EXPECT_EQ(trial.robot.path_signals(1, 2), (std::set<int>{0, 1}));
}

TEST(SyntheticRobots, TheSevenAxisRobotIsOneMetreThirtyLong) {
  const Trial trial = make_trial("d", test::Regime::kFree, 1, 6);
  double longest = 0;
  for (const int finger : {9, 10}) {
    double length = 0;
    for (int part = finger; part != 1;) {
      const auto& link = trial.robot.links.at(static_cast<std::size_t>(part - 1));
      length += link.X_before.translation().norm() + link.X_after.translation().norm();
      part = link.parent;
    }
    longest = std::max(longest, length);
  }
  EXPECT_NEAR(longest, 1.3, 1e-12);
}

}  // namespace
}  // namespace bodyschema::experiments
