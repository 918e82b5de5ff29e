#include "common/kinematics/kinematic_tree.h"

#include <algorithm>

namespace bodyschema {

KinematicTree::KinematicTree(const std::vector<std::pair<int, int>>& edges, int root)
    : nodes_{Node{root}} {
  for (std::size_t n = 0; n < nodes_.size(); ++n)
    for (std::size_t e = 0; e < edges.size(); ++e) {
      const auto [from, to] = edges[e];
      const bool is_forward = from == nodes_[n].part;
      if (!is_forward && to != nodes_[n].part) continue;
      const int other = is_forward ? to : from;
      if (node_of(other) >= 0) continue;
      nodes_[n].children.push_back(static_cast<int>(nodes_.size()));
      nodes_.push_back({other, static_cast<int>(n), static_cast<int>(e), is_forward});
    }
}

int KinematicTree::node_of(int part) const {
  const auto node =
      std::find_if(nodes_.begin(), nodes_.end(), [part](const Node& n) { return n.part == part; });
  return node == nodes_.end() ? -1 : static_cast<int>(node - nodes_.begin());
}

std::vector<int> KinematicTree::path_to(int node) const {
  std::vector<int> path;
  for (; nodes_[node].parent >= 0; node = nodes_[node].parent) path.push_back(node);
  std::reverse(path.begin(), path.end());
  return path;
}

}  // namespace bodyschema
