#pragma once

#include <optional>
#include <vector>

#include "processes/structure_learner/local_model.h"

namespace bodyschema {

/// One part of a kinematic tree with the local model that carries it.
struct TreeNode {
  int part = 0;
  int parent = -1;   ///< index into the nodes, below the node's own; −1: the tree's root
  LocalModel model;  ///< Δ of this part in its parent; unused at the root
};

/// A joint that the tree lacks: part of a rigid cluster (and of what hangs on it) moves with a
/// signal relative to the rest of it.
struct MissingJoint {
  int top = 0;  ///< the cluster's node next to the tree's root
  int signal = 0;
  /// Nodes of the cluster, and nodes joined to it by their own edges, that move. What the cluster
  /// itself hangs on does not.
  std::vector<int> members, branches;
  /// Most likely screw in the frame of `top`, Exp(ξ q), per half range of the signal.
  Vector6d xi = Vector6d::Zero();
  bool slides = false;  ///< ξ is a translation, which explains the data as well as a general screw
  double statistic = 0;  ///< score statistic: χ² of ξ = 0
  double log_tail = 0;   ///< log of the χ² tail beyond the statistic
  /// log of the number of ways to part this cluster: for the significance of the best of them.
  double log_ways = 0;
};

/// An edge between two nodes of a tree.
struct TreeEdge {
  int a = 0, b = 0;
  LocalModel model;  ///< Δ of b in a
};

/// Nodes from `top` down that rigid edges connect. `nodes`: parents before children.
std::vector<int> cluster_of(const std::vector<TreeNode>& nodes, int top);

/// The tree's edges with that joint. Where only branches move, each of their edges gets it. Edges
/// between the two sides are moved to the right one. std::nullopt if an edge had more than
/// kMaxScreenedJoints.
std::optional<std::vector<TreeEdge>> insert_joint(const std::vector<TreeNode>& nodes,
                                                  const MissingJoint& joint);
/// The nodes whose edges to their parents have no room for the joint: why insert_joint() fails.
std::vector<int> full_edges(const std::vector<TreeNode>& nodes, const MissingJoint& joint);

}  // namespace bodyschema
