#pragma once

#include <utility>
#include <vector>

namespace bodyschema {

/// The component of a forest that a part belongs to, seen from that part as the root. Breadth
/// first, so that parents come before their children.
class KinematicTree {
 public:
  struct Node {
    int part = 0;
    int parent = -1;         ///< index of a node; −1: the root
    int edge = -1;           ///< index of the edge between the parent and this node
    bool is_forward = true;  ///< the edge leads from the parent to this node
    std::vector<int> children = {};
  };

  /// `edges`: the parts (from, to) of each, in any order and direction.
  KinematicTree(const std::vector<std::pair<int, int>>& edges, int root);
  /// `edges`: those of a schema, or anything with `from` and `to`.
  template <class Edge>
  KinematicTree(const std::vector<Edge>& edges, int root) : KinematicTree(ends_of(edges), root) {}

  /// The root is node 0.
  const std::vector<Node>& nodes() const { return nodes_; }
  /// −1: not connected to the root.
  int node_of(int part) const;
  /// The nodes after the root down to `node`: one for every edge on the way.
  std::vector<int> path_to(int node) const;

 private:
  template <class Edge>
  static std::vector<std::pair<int, int>> ends_of(const std::vector<Edge>& edges) {
    std::vector<std::pair<int, int>> ends;
    for (const Edge& edge : edges) ends.emplace_back(edge.from, edge.to);
    return ends;
  }

  std::vector<Node> nodes_;
};

}  // namespace bodyschema
