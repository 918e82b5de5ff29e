#include "processes/structure_learner/joints/joint_insertion.h"

#include <algorithm>

#include "processes/structure_learner/placed_screw.h"

namespace bodyschema {
namespace {

LocalModel rigid(const Pose& X) {
  LocalModel model;
  model.first = X;
  return model;
}

// Δ_N,T Exp(±ξ q) Δ_T,N · model.
LocalModel with_screw_in_front(const PlacedScrew& placed, int signal, const Pose& X_NT,
                               double sense, const LocalModel& model) {
  LocalModel r = model;
  r.first = X_NT * placed.X;
  r.joints.insert(r.joints.begin(), {signal, sense * placed.screw.slide, sense * placed.screw.turn,
                                     placed.X.inverse() * X_NT.inverse() * model.first});
  return r;
}

}  // namespace

std::vector<int> cluster_of(const std::vector<TreeNode>& nodes, int top) {
  std::vector<bool> in(nodes.size(), false);
  std::vector<int> members{top};
  in[top] = true;
  for (int k = top + 1; k < static_cast<int>(nodes.size()); ++k)
    if (nodes[k].parent >= 0 && in[nodes[k].parent] && nodes[k].model.num_joints() == 0) {
      in[k] = true;
      members.push_back(k);
    }
  return members;
}

std::optional<std::vector<TreeEdge>> insert_joint(const std::vector<TreeNode>& nodes,
                                                  const MissingJoint& joint) {
  const int n = static_cast<int>(nodes.size());
  const std::vector<int> cluster = cluster_of(nodes, joint.top);
  std::vector<Pose> X_TN(n, Pose::Identity());  // of the cluster's nodes in its top's frame
  std::vector<int> side(n, -1);                 // 1 moves, 0 rests
  for (const int k : cluster) {
    if (k != joint.top) X_TN[k] = X_TN[nodes[k].parent] * nodes[k].model.first;
    side[k] = static_cast<int>(std::count(joint.members.begin(), joint.members.end(), k));
  }
  const PlacedScrew screw = PlacedScrew::of(joint.xi, joint.slides);
  const auto in_front = [&](const Pose& X_NT, double sense, const LocalModel& model) {
    return with_screw_in_front(screw, joint.signal, X_NT, sense, model);
  };
  // The cluster's two sides, each rigid, and a joint between them.
  int base[2] = {-1, -1};
  std::vector<TreeEdge> edges;
  for (const int k : cluster) {
    int& b = base[side[k]];
    if (b < 0)
      b = k;
    else if (k != joint.top && side[nodes[k].parent] == side[k])
      edges.push_back({nodes[k].parent, k, nodes[k].model});
    else
      edges.push_back({b, k, rigid(X_TN[b].inverse() * X_TN[k])});
  }
  if (base[0] >= 0 && base[1] >= 0)
    edges.push_back(
        {base[0], base[1],
         in_front(X_TN[base[0]].inverse(), 1, rigid(X_TN[base[0]].inverse() * X_TN[base[1]]))});
  // A branch goes to its own side; where that has no part, its edge gets the joint.
  const auto attach = [&](int node, LocalModel model, int parent, bool moves) {
    const int own = base[moves];
    if (own >= 0) {
      const int to = side[parent] == static_cast<int>(moves) ? parent : own;
      model.first = X_TN[to].inverse() * X_TN[parent] * model.first;
      edges.push_back({to, node, model});
      return true;
    }
    if (model.num_joints() == kMaxScreenedJoints) return false;
    edges.push_back({parent, node, in_front(X_TN[parent].inverse(), moves ? 1 : -1, model)});
    return true;
  };
  for (int k = 1; k < n; ++k) {
    if (k == joint.top) {
      // The part that the cluster hangs on rests.
      if (!attach(nodes[k].parent, nodes[k].model.inverse(), k, false)) return std::nullopt;
    } else if (side[k] < 0 && side[nodes[k].parent] >= 0) {
      const bool moves = std::count(joint.branches.begin(), joint.branches.end(), k) > 0;
      if (!attach(k, nodes[k].model, nodes[k].parent, moves)) return std::nullopt;
    } else if (side[k] < 0) {
      edges.push_back({nodes[k].parent, k, nodes[k].model});
    }
  }
  return edges;
}

std::vector<int> full_edges(const std::vector<TreeNode>& nodes, const MissingJoint& joint) {
  std::vector<int> result;
  const bool is_full = nodes[joint.top].model.num_joints() == kMaxScreenedJoints;
  const std::vector<int> cluster = cluster_of(nodes, joint.top);
  const auto unmoved = static_cast<std::ptrdiff_t>(joint.members.size()) < std::ssize(cluster);
  if (!unmoved && is_full && joint.top > 0) result.push_back(joint.top);
  for (int k = 1; k < static_cast<int>(nodes.size()); ++k) {
    if (nodes[k].model.num_joints() < kMaxScreenedJoints ||
        !std::count(cluster.begin(), cluster.end(), nodes[k].parent))
      continue;
    const bool moves = std::count(joint.branches.begin(), joint.branches.end(), k) > 0;
    if (moves ? joint.members.empty() : !unmoved) result.push_back(k);
  }
  return result;
}

}  // namespace bodyschema
