#include <algorithm>

#include "common/kinematics/screw_chain.h"
#include "processes/structure_learner/tree_fit.h"

namespace bodyschema {
namespace {

// X Exp(ŝ) X⁻¹ = Exp(ξ): a screw in its frame X.
struct PlacedScrew {
  Pose X = Pose::Identity();
  Screw screw;
};

PlacedScrew screw_of(const Vector6d& xi, bool slides) {
  const Eigen::Vector3d v = xi.head<3>(), w = xi.tail<3>();
  PlacedScrew placed;
  const Eigen::Vector3d direction = slides ? v : w;
  if (!(direction.norm() > 1e-12)) return placed;
  placed.X.linear().col(2) = direction.normalized();
  placed.X.linear().col(0) = placed.X.linear().col(2).unitOrthogonal();
  placed.X.linear().col(1) =
      Eigen::Vector3d(placed.X.linear().col(2)).cross(Eigen::Vector3d(placed.X.linear().col(0)));
  if (slides) {
    placed.screw.slide = v.norm();
  } else {
    placed.X.translation() = w.cross(v) / w.squaredNorm();
    placed.screw.turn = w.norm();
    placed.screw.slide = direction.normalized().dot(v);
  }
  return placed;
}

LocalModel rigid(const Pose& X) {
  LocalModel model;
  model.A[0] = X;
  return model;
}

// Δ_N,T Exp(±ξ q) Δ_T,N · model.
LocalModel with_screw_in_front(const PlacedScrew& placed, int signal, const Pose& X_NT,
                               double sense, const LocalModel& model) {
  LocalModel r;
  r.num_joints = model.num_joints + 1;
  r.signal[0] = signal;
  r.slide[0] = sense * placed.screw.slide;
  r.turn[0] = sense * placed.screw.turn;
  r.A[0] = X_NT * placed.X;
  r.A[1] = placed.X.inverse() * X_NT.inverse() * model.A[0];
  for (int d = 0; d < model.num_joints; ++d) {
    r.signal[d + 1] = model.signal[d];
    r.slide[d + 1] = model.slide[d];
    r.turn[d + 1] = model.turn[d];
    r.A[d + 2] = model.A[d + 1];
  }
  return r;
}

}  // namespace

std::vector<int> TreeFit::full_edges(const MissingJoint& joint) const {
  std::vector<int> result;
  const bool is_full = nodes_[joint.top].model.num_joints == kMaxJoints;
  const std::vector<int> cluster = cluster_of(joint.top);
  const auto unmoved = static_cast<std::ptrdiff_t>(joint.members.size()) < std::ssize(cluster);
  if (!unmoved && is_full && joint.top > 0) result.push_back(joint.top);
  for (int k = 1; k < static_cast<int>(nodes_.size()); ++k) {
    if (nodes_[k].model.num_joints < kMaxJoints ||
        !std::count(cluster.begin(), cluster.end(), nodes_[k].parent))
      continue;
    const bool moves = std::count(joint.branches.begin(), joint.branches.end(), k) > 0;
    if (moves ? joint.members.empty() : !unmoved) result.push_back(k);
  }
  return result;
}

// Nodes from `top` down that rigid edges connect.
std::vector<int> TreeFit::cluster_of(int top) const {
  std::vector<bool> in(nodes_.size(), false);
  std::vector<int> members{top};
  in[top] = true;
  for (int k = top + 1; k < static_cast<int>(nodes_.size()); ++k)
    if (nodes_[k].parent >= 0 && in[nodes_[k].parent] && nodes_[k].model.num_joints == 0) {
      in[k] = true;
      members.push_back(k);
    }
  return members;
}

std::optional<std::vector<TreeEdge>> TreeFit::with_joint(const MissingJoint& joint) const {
  const int n = static_cast<int>(nodes_.size());
  const std::vector<int> cluster = cluster_of(joint.top);
  std::vector<Pose> X_TN(n, Pose::Identity());  // of the cluster's nodes in its top's frame
  std::vector<int> side(n, -1);                 // 1 moves, 0 rests
  for (const int k : cluster) {
    if (k != joint.top) X_TN[k] = X_TN[nodes_[k].parent] * nodes_[k].model.A[0];
    side[k] = static_cast<int>(std::count(joint.members.begin(), joint.members.end(), k));
  }
  const PlacedScrew screw = screw_of(joint.xi, joint.slides);
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
    else if (k != joint.top && side[nodes_[k].parent] == side[k])
      edges.push_back({nodes_[k].parent, k, nodes_[k].model});
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
      model.A[0] = X_TN[to].inverse() * X_TN[parent] * model.A[0];
      edges.push_back({to, node, model});
      return true;
    }
    if (model.num_joints == kMaxJoints) return false;
    edges.push_back({parent, node, in_front(X_TN[parent].inverse(), moves ? 1 : -1, model)});
    return true;
  };
  for (int k = 1; k < n; ++k) {
    if (k == joint.top) {
      // The part that the cluster hangs on rests.
      if (!attach(nodes_[k].parent, nodes_[k].model.inverse(), k, false)) return std::nullopt;
    } else if (side[k] < 0 && side[nodes_[k].parent] >= 0) {
      const bool moves = std::count(joint.branches.begin(), joint.branches.end(), k) > 0;
      if (!attach(k, nodes_[k].model, nodes_[k].parent, moves)) return std::nullopt;
    } else if (side[k] < 0) {
      edges.push_back({nodes_[k].parent, k, nodes_[k].model});
    }
  }
  return edges;
}

}  // namespace bodyschema
