#include "common/kinematics/kinematic_tree.h"

#include <gtest/gtest.h>

namespace bodyschema {
namespace {

/// 1 carries 2 and 3, 3 carries 4; 7 and 8 are apart. In no order, two edges the other way round.
const std::vector<std::pair<int, int>> kEdges{{4, 3}, {1, 2}, {7, 8}, {3, 1}};

TEST(KinematicTree, ParentsComeBeforeChildrenWhateverTheEdgesOrderAndDirection) {
  const KinematicTree tree(kEdges, 1);
  ASSERT_EQ(tree.nodes().size(), 4u);
  for (std::size_t n = 1; n < tree.nodes().size(); ++n) {
    const KinematicTree::Node& node = tree.nodes()[n];
    ASSERT_LT(node.parent, static_cast<int>(n));
    const auto& [from, to] = kEdges[node.edge];
    EXPECT_EQ(node.is_forward ? to : from, node.part);
    EXPECT_EQ(node.is_forward ? from : to, tree.nodes()[node.parent].part);
  }
  EXPECT_EQ(tree.nodes()[0].children, (std::vector<int>{tree.node_of(2), tree.node_of(3)}));
  EXPECT_EQ(tree.nodes()[tree.node_of(3)].children, std::vector<int>{tree.node_of(4)});
}

TEST(KinematicTree, APathLeadsFromTheRootsChildToTheNode) {
  const KinematicTree tree(kEdges, 2);
  const std::vector<int> path = tree.path_to(tree.node_of(4));
  EXPECT_EQ(path, (std::vector<int>{tree.node_of(1), tree.node_of(3), tree.node_of(4)}));
  EXPECT_TRUE(tree.path_to(0).empty());
}

TEST(KinematicTree, APartOfAnotherComponentIsNotInIt) {
  const KinematicTree tree(kEdges, 1);
  EXPECT_EQ(tree.node_of(7), -1);
  EXPECT_EQ(tree.node_of(9), -1);
  EXPECT_EQ(KinematicTree(kEdges, 9).nodes().size(), 1u);
}

}  // namespace
}  // namespace bodyschema
