#include <gtest/gtest.h>

#include <cmath>

#include "processes/structure_learner/joints/missing_joint_test.h"
#include "processes/structure_learner/placed_screw.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

// 1 ─ 2 = 3 ─ 4: nodes 0 to 3, a rigid edge between 2 and 3, two joints on the way to 4.
std::vector<TreeNode> chain() {
  std::vector<TreeNode> nodes;
  for (int n = 0; n < 4; ++n) {
    TreeNode& node = nodes.emplace_back(TreeNode{n + 1, n - 1, {}});
    const int k = n == 1 ? 1 : n == 3 ? 2 : 0;
    for (int d = 0; d < k; ++d) node.model.joints.push_back({.signal = n + d, .turn = 0.5});
    for (int d = 0; d <= k; ++d) node.model.transform(d).translation() << 0.1, 0.02 * n, 0;
  }
  return nodes;
}

TEST(InsertJoint, PartsARigidClusterAndLeavesEachBranchOnItsSide) {
  const std::vector<TreeNode> nodes = chain();
  EXPECT_EQ(cluster_of(nodes, 1), (std::vector<int>{1, 2}));
  MissingJoint joint{.top = 1, .signal = 7, .members = {2}, .branches = {3}};
  joint.xi << 0, 0, 0, 0, 0.5, 0;
  const auto edges = insert_joint(nodes, joint);
  ASSERT_TRUE(edges);
  ASSERT_EQ(edges->size(), 3u);
  const TreeEdge& parted = edges->front();
  EXPECT_EQ(std::minmax(parted.a, parted.b), std::minmax(1, 2));
  EXPECT_EQ(parted.model.joints[0].signal, 7);
  EXPECT_EQ(parted.model.num_joints(), 1);
  EXPECT_TRUE(full_edges(nodes, joint).empty());
  // At q = 0 the new edge is the rigid one.
  Pose X = parted.model.first * parted.model.joints[0].X_after;
  EXPECT_TRUE(X.isApprox(nodes[2].model.first, 1e-12));
  // Only the branch moves: its edge would have three joints.
  joint.members = {};
  EXPECT_FALSE(insert_joint(nodes, joint));
  EXPECT_EQ(full_edges(nodes, joint), std::vector<int>{3});
}

TEST(InsertJoint, WhateverMovesAllPosesAreAsBeforeAtTheMiddleOfTheSignal) {
  const std::vector<TreeNode> nodes = chain();
  const Pose X_23 = nodes[2].model.first, X_24 = X_23 * nodes[3].model.first;
  MissingJoint joint{.top = 1, .signal = 7, .members = {1}};
  joint.xi << 0, 0, 0, 0, 0.5, 0;
  auto edges = insert_joint(nodes, joint);  // from part 3, which rests, to part 2
  ASSERT_TRUE(edges);
  const LocalModel& model = edges->front().model;
  EXPECT_TRUE((model.first * model.joints[0].X_after).isApprox(X_23.inverse(), 1e-12));
  joint.members = {2};  // part 4 comes to part 2
  edges = insert_joint(nodes, joint);
  ASSERT_TRUE(edges);
  EXPECT_EQ(edges->back().a, 1);
  EXPECT_TRUE(edges->back().model.first.isApprox(X_24, 1e-12));
}

TEST(PlacedScrew, IsTheTwistInItsFrame) {
  test::Rng rng(3);
  for (const bool slides : {false, true}) {
    Vector6d xi = 0.3 * test::gaussian6(rng);
    if (slides) xi.tail<3>().setZero();
    const PlacedScrew placed = PlacedScrew::of(xi, slides);
    Vector6d screw = Vector6d::Zero();
    screw(2) = placed.screw.slide;
    screw(5) = placed.screw.turn;
    EXPECT_TRUE((placed.X * exp(screw) * placed.X.inverse()).isApprox(exp(xi), 1e-9));
  }
}

TEST(MostSignificant, CorrectsForAllThatWasTriedAndForTheNumberOfFrames) {
  const double limit = std::log(0.002 / 4);  // two joints, the better of two tests
  std::vector<MissingJoint> joints{{.signal = 0, .log_tail = limit - 0.01},
                                   {.signal = 1, .log_tail = -1}};
  ASSERT_TRUE(most_significant(joints, 20, {}));
  EXPECT_EQ(most_significant(joints, 20, {})->signal, 0);
  EXPECT_FALSE(most_significant(joints, 22, {}));
  joints[0].log_tail = limit + 0.01;
  EXPECT_FALSE(most_significant(joints, 20, {}));
  // An idle signal is one hypothesis of its own, at a rate of its own.
  joints[0].log_tail = std::log(0.003 / 2) - 0.01;
  EXPECT_TRUE(most_significant(joints, 20, {0}));
}

}  // namespace
}  // namespace bodyschema
