#include "processes/structure_learner/screen.h"

#include <gtest/gtest.h>

#include "processes/structure_learner/axis_screen.h"
#include "processes/structure_learner/turn_scan.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Regime;
using test::Rng;

enum class Joint { kRevolute, kPrismatic, kHelical };

// Parts 1 and 3 with the joints given between them on signals 1 and 3 of four; part 2 hidden.
test::SyntheticRobot two_joint_robot(Joint a, Joint b, bool parallel, Rng& rng) {
  test::SyntheticRobot robot;
  for (int s = 0; s < 4; ++s) robot.signals.push_back({"q", -100, 300});
  robot.links.push_back({.part = 1});
  const auto link = [&](int part, int parent, int signal, Joint type) {
    test::TrueLink l;
    l.part = part;
    l.parent = parent;
    l.signal = signal;
    l.X_before = test::random_pose(rng, 0.05, 0.15);
    l.X_after = test::random_pose(rng, 0.05, 0.15);
    if (type != Joint::kPrismatic) l.turn = test::uniform(rng, 0.5, 1.2) / 200;
    if (type == Joint::kPrismatic) l.slide = 0.05 / 200;
    if (type == Joint::kHelical) l.slide = 0.03 / 200;
    return l;
  };
  robot.links.push_back(link(2, 1, 1, a));
  robot.links.push_back(link(3, 2, 3, b));
  if (parallel) robot.links[2].X_before.linear() = robot.links[1].X_after.linear().transpose();
  robot.links[1].hidden = true;
  return robot;
}

struct Case {
  const char* name;
  Joint a, b;
  bool parallel;
};

class TwoJointScreen : public ::testing::TestWithParam<Case> {};

TEST_P(TwoJointScreen, LeadsAFitToTheTruth) {
  for (int seed = 1; seed <= 5; ++seed) {
    Rng rng(seed);
    const auto robot = two_joint_robot(GetParam().a, GetParam().b, GetParam().parallel, rng);
    const auto samples = test::babble(robot, 15, {}, rng);
    const NormalizedActions actions(samples, 4);
    const PairData pair = make_pair_data(samples, 1, 3, {Noise{1e-4, 3e-4}, {}}, 100);
    const auto starts = screen_two_joints(pair, actions, relative_motions(pair, 300),
                                          std::vector(4, default_turns()), 10);
    double best = 1e9;
    for (const Start& start : starts) {
      const Fit fit = fit_local_model(start.model, pair, actions, 60);
      if (fit.cost > 1e-9) continue;
      best = fit.cost;
      EXPECT_TRUE(fit.model.uses(1) && fit.model.uses(3));
    }
    EXPECT_LT(best, 1e-9) << "seed " << seed;
  }
}

INSTANTIATE_TEST_SUITE_P(
    Joints, TwoJointScreen,
    ::testing::Values(Case{"revolute_revolute", Joint::kRevolute, Joint::kRevolute, false},
                      Case{"parallel_axes", Joint::kRevolute, Joint::kRevolute, true},
                      Case{"revolute_prismatic", Joint::kRevolute, Joint::kPrismatic, false},
                      Case{"prismatic_revolute", Joint::kPrismatic, Joint::kRevolute, false},
                      Case{"prismatic_prismatic", Joint::kPrismatic, Joint::kPrismatic, false},
                      Case{"helical_revolute", Joint::kHelical, Joint::kRevolute, false},
                      Case{"revolute_helical", Joint::kRevolute, Joint::kHelical, false}),
    [](const auto& info) { return info.param.name; });

TEST(OneJointScreen, PutsTheTrueSignalFirstAndStartsAtTheTruth) {
  for (int seed = 1; seed <= 10; ++seed) {
    Rng rng(seed);
    auto robot = two_joint_robot(seed % 2 ? Joint::kRevolute : Joint::kPrismatic, Joint::kRevolute,
                                 false, rng);
    robot.links[1].hidden = false;
    const auto samples = test::babble(robot, 6, {}, rng);
    const NormalizedActions actions(samples, 4);
    const PairData pair = make_pair_data(samples, 1, 2, {Noise{1e-4, 3e-4}, {}}, 100);
    const RelativeMotions motions = relative_motions(pair, 300);
    const auto regressions = screen_one_joint(motions, actions);
    ASSERT_FALSE(regressions.empty());
    EXPECT_EQ(regressions.front().signal, 1);
    const Start start = one_joint_start(regressions.front(), pair, actions, motions.sigma_rad);
    EXPECT_LT(start.score, 1e-3);
  }
}

TEST(AxisScreen, ATurnOfOneJointLeavesNothingAtItsSignalWhateverTheOtherDoes) {
  Rng rng(2);
  const auto robot = two_joint_robot(Joint::kRevolute, Joint::kRevolute, false, rng);
  const auto samples = test::babble(robot, 15, {}, rng);
  const NormalizedActions actions(samples, 4);
  std::vector<Eigen::Matrix3d> R;
  std::vector<int> index;
  for (const ActionPoseSample& s : samples) {
    R.push_back((s.find(1)->X_CB.inverse() * s.find(3)->X_CB).linear());
    index.push_back(static_cast<int>(index.size()));
  }
  AxisScreen screen(R, index, 1e-3, actions);
  const AxisFit fit = screen.fit(1, robot.links[1].turn * actions.half_range(1), 4);
  EXPECT_LT(fit.score, 1e-6);
  // The axis of the other joint, seen from part 3.
  const Eigen::Vector3d axis = robot.links[2].X_after.linear().transpose().col(2);
  EXPECT_NEAR(std::abs(fit.axis.dot(axis)), 1, 1e-6);
  EXPECT_GT(screen.fit(0, robot.links[1].turn * actions.half_range(1), 4).score, 1);
}

TEST(OneJointScreen, CoversAFullTurn) {
  Rng rng(3);
  auto robot = two_joint_robot(Joint::kRevolute, Joint::kRevolute, false, rng);
  robot.links[1].hidden = false;
  robot.links[1].turn = 2 * M_PI / 400;
  const auto samples = test::babble(robot, 30, {}, rng);
  const NormalizedActions actions(samples, 4);
  const PairData pair = make_pair_data(samples, 1, 2, {Noise{1e-4, 3e-4}, {}}, 100);
  const auto regressions = screen_one_joint(relative_motions(pair, 300), actions);
  EXPECT_EQ(regressions.front().signal, 1);
  EXPECT_NEAR(regressions.front().xi.tail<3>().norm() / actions.half_range(1), 2 * M_PI / 400,
              1e-4);
}

// Part 2 on part 1 by signal 1, which sweeps so far [rad, half range]; part 3 beyond, on signal 3.
test::SyntheticRobot wheel(double sweep, Joint type, Rng& rng) {
  auto robot = two_joint_robot(type, Joint::kRevolute, false, rng);
  robot.links[1].hidden = false;
  robot.links[1].turn = sweep / 200;
  return robot;
}

TEST(WideJointScreen, LeadsAFitToTheTurnOfAWheelEitherWay) {
  for (const double sweep : {4.0, 6.0, -6.0, 12.0, -12.0}) {
    for (int seed = 1; seed <= 5; ++seed) {
      Rng rng(seed);
      const auto robot = wheel(sweep, seed % 2 ? Joint::kRevolute : Joint::kHelical, rng);
      const auto samples = test::babble(robot, 30, {Regime::kTagIso}, rng);
      const NormalizedActions actions(samples, 4);
      const PairData pair =
          make_pair_data(samples, 1, 2, {test::nominal_noise(Regime::kTagIso), {}}, 100);
      const auto starts = screen_wide_joint(pair, actions, relative_motions(pair, 300));
      ASSERT_FALSE(starts.empty()) << sweep << " seed " << seed;
      const Fit fit = fit_local_model(starts.front().model, pair, actions, 60);
      EXPECT_EQ(fit.model.joints[0].signal, 1);
      EXPECT_NEAR(std::abs(fit.model.joints[0].turn) / actions.half_range(1) * 200, std::abs(sweep),
                  0.05);
      EXPECT_LT(fit.cost, 9 * pair.size());
    }
  }
}

TEST(WideJointScreen, ManyFramesLeadToManyTurns) {
  for (const double sweep : {30.0, -75.0})
    for (int seed = 1; seed <= 5; ++seed) {
      Rng rng(seed);
      const auto robot = wheel(sweep, Joint::kRevolute, rng);
      const auto samples = test::babble(robot, 60, {Regime::kTagIso}, rng);
      const NormalizedActions actions(samples, 4);
      const PairData pair =
          make_pair_data(samples, 1, 2, {test::nominal_noise(Regime::kTagIso), {}}, 100);
      const auto starts = screen_wide_joint(pair, actions, relative_motions(pair, 300));
      ASSERT_FALSE(starts.empty()) << sweep << " seed " << seed;
      const Fit fit = fit_local_model(starts.front().model, pair, actions, 60);
      EXPECT_NEAR(std::abs(fit.model.joints[0].turn) / actions.half_range(1) * 200, std::abs(sweep),
                  0.05);
    }
}

TEST(WideJointScreen, OfTurnsThatFewEqualStepsDoNotTellApartNoneIsTaken) {
  Rng rng(4);
  const auto robot = wheel(5, Joint::kRevolute, rng);
  std::vector<ActionPoseSample> samples;
  for (int n = 0; n < 30; ++n) {
    Eigen::VectorXd action = robot.random_action(rng);
    action(1) = -100 + 80 * (n % 6);  // 5 and −10.7 rad are one
    samples.push_back(test::observe(robot, action, {Regime::kTagIso}, n, rng));
  }
  const NormalizedActions actions(samples, 4);
  const PairData pair =
      make_pair_data(samples, 1, 2, {test::nominal_noise(Regime::kTagIso), {}}, 100);
  EXPECT_TRUE(screen_wide_joint(pair, actions, relative_motions(pair, 300)).empty());
}

TEST(WideJointScreen, TwoJointsOfWhichOneTurnsMoreThanOnceAreFound) {
  for (const bool parallel : {false, true}) {
    for (int seed = 1; seed <= 5; ++seed) {
      Rng rng(seed);
      auto robot = two_joint_robot(Joint::kRevolute, Joint::kRevolute, parallel, rng);
      robot.links[seed % 2 ? 1 : 2].turn = 7.3 / 200;
      const auto samples = test::babble(robot, 40, {}, rng);
      const NormalizedActions actions(samples, 4);
      const PairData pair = make_pair_data(samples, 1, 3, {Noise{1e-3, 6e-3}, {}}, 100);
      double least = 1e9;
      for (const Start& start : screen_two_joints(pair, actions, relative_motions(pair, 300),
                                                  std::vector(4, wide_turns()), 10))
        least = std::min(least, fit_local_model(start.model, pair, actions, 60).cost);
      EXPECT_LT(least, 1e-6) << parallel << " seed " << seed;
    }
  }
}

}  // namespace
}  // namespace bodyschema
