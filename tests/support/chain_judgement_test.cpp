#include "tests/support/chain_judgement.h"

#include <gtest/gtest.h>

#include <algorithm>

#include "common/bus/convert.h"
#include "common/scene/scene.h"
#include "tests/support/rig_truth.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema::test {
namespace {

const std::filesystem::path kConfig = BODYSCHEMA_CONFIG;

TEST(TrueEdge, IsTheMotionOfTheSimulatedRig) {
  Rng rng(1);
  for (const char* name : {"arm2", "arm4", "arm6_ends", "arm7"}) {
    const Scene scene(kConfig / name);
    const RigTruth truth(kConfig / name);
    for (int n = 0; n < 3; ++n) {
      const Eigen::VectorXd action = random_action(scene.signals().signals, rng);
      const sim_state_t state = scene.state_at(action, 0, 0);
      for (int a = 0; a < state.num_parts; ++a)
        for (int b = 0; b < state.num_parts; ++b) {
          const Pose X_AB = from_message(state.X_WB[a]).inverse() * from_message(state.X_WB[b]);
          const Edge edge = truth.true_edge(state.true_part[a], state.true_part[b]);
          EXPECT_LT((edge.predict(action).matrix() - X_AB.matrix()).norm(), 1e-9) << name;
        }
    }
  }
}

TEST(TrueEdge, IsTheMotionOfTheSyntheticRobot) {
  for (std::uint64_t seed = 0; seed < 5; ++seed) {
    Rng rng(seed);
    const SyntheticRobot robot = random_tree({}, rng);
    const Eigen::VectorXd action = robot.random_action(rng);
    const auto X_CB = robot.poses_in_camera(action);
    for (const auto& [a, X_CA] : X_CB)
      for (const auto& [b, X_CB_b] : X_CB)
        EXPECT_TRUE(robot.true_edge(a, b).predict(action).isApprox(X_CA.inverse() * X_CB_b, 1e-9));
  }
}

/// What is true of arm6_ends.
class LongEdge : public testing::Test {
 protected:
  LongEdge() : truth_(kConfig / "arm6_ends") {
    schema_.signals = load_signals(kConfig / "arm6_ends").signals;
    schema_.parts = {1, 2};
    schema_.root = 1;
    schema_.complete = true;
    schema_.edges = {truth_.true_edge(1, 2)};
  }
  std::string objection() const { return truth_.objection(schema_, {1, 2}); }
  std::vector<ScrewJoint>& joints() { return schema_.edges[0].joints; }

  const RigTruth truth_;
  BodySchema schema_;
};

TEST_F(LongEdge, IsRightInTheOrderOfTheJointsFromEitherEnd) {
  EXPECT_EQ(truth_.path_joints(1, 2), (std::vector<int>{0, 1, 2, 3, 4, 5}));
  EXPECT_EQ(truth_.path_joints(2, 1), (std::vector<int>{5, 4, 3, 2, 1, 0}));
  EXPECT_EQ(objection(), "");
  schema_.edges = {truth_.true_edge(2, 1)};
  EXPECT_EQ(objection(), "");
}

TEST_F(LongEdge, IsWrongInAnyOtherOrderAlsoOfParallelAxes) {
  for (std::size_t d = 0; d + 1 < 6; ++d) {
    std::swap(joints()[d], joints()[d + 1]);
    EXPECT_EQ(objection(), "edge 1-2 has q" + std::to_string(d + 1) + " and q" +
                               std::to_string(d + 2) + " in the wrong order");
    std::swap(joints()[d], joints()[d + 1]);
  }
  std::reverse(joints().begin(), joints().end());
  EXPECT_NE(objection(), "");
}

TEST_F(LongEdge, WhoseOrderIsLeftOpenIsNotRight) {
  joints()[1].order_group = joints()[2].order_group = 0;
  EXPECT_EQ(objection(), "edge 1-2 leaves the order of q2 and q3 open");
  std::swap(joints()[1], joints()[2]);
  EXPECT_EQ(objection(), "edge 1-2 leaves the order of q2 and q3 open");
  // Another group is another order.
  joints()[2].order_group = 1;
  EXPECT_EQ(objection(), "edge 1-2 has q2 and q3 in the wrong order");
}

TEST_F(LongEdge, NeedsEveryGainWithinFivePercentWhateverItsSign) {
  joints()[3].turn *= -1.04;
  EXPECT_EQ(objection(), "");
  joints()[3].gain *= 1.04;
  EXPECT_EQ(objection(), "edge 1-2 has a wrong gain of q4");
}

TEST_F(LongEdge, NeedsEachJointOnce) {
  joints()[3].signal = 4;
  EXPECT_NE(objection(), "");
  joints().pop_back();
  EXPECT_NE(objection(), "");
}

// 1 –slide a, slide b, turn c about b's axis, turn d, turn e– 2
TEST(JudgeChain, JointsThatCommuteMayChangePlaces) {
  Rng rng(2);
  TrueChain chain(1, 2);
  chain.move(random_pose(rng, 0.1, 0.2));
  chain.add(0, 0.1, 0, 0);
  chain.move(random_pose(rng, 0.1, 0.2));
  chain.add(1, 0.1, 0, 0.2);
  chain.add(2, 0, 0.7, 0.1);
  chain.move(random_pose(rng, 0.1, 0.2));
  chain.add(3, 0, -0.4, 0);
  chain.move(random_pose(rng, 0.1, 0.2));
  chain.add(4, 0, 1.1, 0);
  const Edge truth = chain.edge();
  std::vector<Signal> signals;
  for (const char* name : {"a", "b", "c", "d", "e"}) signals.push_back({name, -1, 1});
  const auto judged = [&](const std::vector<int>& order) {
    Edge edge = truth;
    edge.joints.clear();
    for (const int signal : order) edge.joints.push_back(truth.joints[signal]);
    return judge_chain(edge, truth, signals).rightness;
  };
  EXPECT_EQ(judged({0, 1, 2, 3, 4}), Rightness::kRight);
  EXPECT_EQ(judged({1, 0, 2, 3, 4}), Rightness::kRight);  // two slides
  EXPECT_EQ(judged({0, 2, 1, 3, 4}), Rightness::kRight);  // along the axis that turns
  EXPECT_EQ(judged({1, 2, 0, 3, 4}), Rightness::kWrong);  // c turns a's direction
  EXPECT_EQ(judged({0, 1, 2, 4, 3}), Rightness::kWrong);
  Edge open = truth;
  open.joints[0].order_group = open.joints[1].order_group = 7;
  EXPECT_EQ(judge_chain(open, truth, signals).rightness, Rightness::kRight);
  open.joints[3].order_group = open.joints[4].order_group = 8;
  EXPECT_EQ(judge_chain(open, truth, signals).rightness, Rightness::kIncomplete);
}

// 1 –q1– (2) –q2– 3, (2) –q3– (4) –q4– 5: 2 and 4 are hidden.
TEST(JudgeChain, AHiddenBranchIsRightByEitherOfItsLongEdges) {
  Rng rng(3);
  SyntheticRobot robot;
  robot.links.push_back({.part = 1});
  for (const auto& [part, parent] : {std::pair{2, 1}, {3, 2}, {4, 2}, {5, 4}}) {
    TrueLink link{.part = part, .parent = parent};
    link.X_before = random_pose(rng, 0.06, 0.16);
    link.X_after = random_pose(rng, 0.06, 0.16);
    link.signal = static_cast<int>(robot.signals.size());
    link.turn = 1;
    link.hidden = part == 2 || part == 4;
    std::string name = "q";
    robot.signals.push_back({name += std::to_string(part - 1), -1, 1});
    robot.links.push_back(link);
  }
  BodySchema schema;
  schema.signals = robot.signals;
  schema.parts = {1, 3, 5};
  schema.root = 1;
  schema.complete = true;
  for (const auto& [from, to] : {std::pair{1, 5}, {5, 1}, {3, 5}}) {
    schema.edges = {robot.true_edge(1, 3), robot.true_edge(from, to)};
    EXPECT_EQ(schema.edges[1].joints.size(), 3U);
    EXPECT_EQ(judge(schema, robot), Rightness::kRight);
    std::vector<ScrewJoint>& joints = schema.edges[1].joints;
    joints[0].order_group = joints[1].order_group = 0;
    EXPECT_EQ(judge(schema, robot), Rightness::kIncomplete);
    joints[0].order_group = joints[1].order_group = -1;
    std::swap(joints[0], joints[1]);
    EXPECT_EQ(judge(schema, robot), Rightness::kWrong);
  }
  // Two long edges where one of two joints is enough.
  schema.edges = {robot.true_edge(1, 5), robot.true_edge(3, 5)};
  EXPECT_EQ(judge(schema, robot), Rightness::kWrong);
}

}  // namespace
}  // namespace bodyschema::test
