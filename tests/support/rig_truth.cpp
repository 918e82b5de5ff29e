#include "tests/support/rig_truth.h"

#include <algorithm>
#include <map>
#include <stdexcept>

namespace bodyschema::test {

RigTruth::RigTruth(const std::filesystem::path& rig_folder)
    : robot_(load_robot(rig_folder, load_signals(rig_folder), load_markers(rig_folder))) {}

std::vector<int> RigTruth::parts() const {
  std::vector<int> parts;
  for (const PartPlacement& part : robot_.parts) parts.push_back(part.part);
  return parts;
}

const PartPlacement& RigTruth::placement_of(int part) const {
  for (const PartPlacement& placement : robot_.parts) {
    if (placement.part == part) return placement;
  }
  throw std::out_of_range("no part " + std::to_string(part));
}

/// Links from `link` to the world, itself included.
std::vector<int> RigTruth::ancestors(int link) const {
  std::vector<int> chain;
  for (;;) {
    chain.push_back(link);
    const std::string& parent = robot_.links[link].parent;
    if (parent == "world") return chain;
    link = static_cast<int>(std::find_if(robot_.links.begin(), robot_.links.end(),
                                         [&](const Link& other) { return other.name == parent; }) -
                            robot_.links.begin());
  }
}

Edge RigTruth::true_edge(int from, int to) const {
  std::vector<int> up = ancestors(placement_of(from).link), down = ancestors(placement_of(to).link);
  while (!up.empty() && !down.empty() && up.back() == down.back()) {
    up.pop_back();
    down.pop_back();
  }
  std::reverse(down.begin(), down.end());
  TrueChain chain(from, to);
  const auto cross = [&](const Link& link, double sense) {
    if (!link.joint) return;
    const RobotJoint& joint = robot_.joints[static_cast<std::size_t>(*link.joint)];
    Pose X_LZ = Pose::Identity();  // its z axis along the joint's
    X_LZ.linear() = rotation_of_z_to(joint.axis);
    const bool turns = joint.kind == RobotJoint::Kind::kRevolute;
    chain.move(X_LZ);
    chain.add(joint.signal, turns ? 0 : sense * joint.gain, turns ? sense * joint.gain : 0,
              -joint.offset / joint.gain);
    chain.move(X_LZ.inverse());
  };
  chain.move(placement_of(from).X_LB.inverse());
  for (const int index : up) {
    const Link& link = robot_.links[static_cast<std::size_t>(index)];
    cross(link, -1);
    chain.move(link.X_PL.inverse());
  }
  for (const int index : down) {
    const Link& link = robot_.links[static_cast<std::size_t>(index)];
    chain.move(link.X_PL);
    cross(link, 1);
  }
  chain.move(placement_of(to).X_LB);
  return chain.edge();
}

std::vector<int> RigTruth::path_joints(int part_a, int part_b) const {
  std::vector<int> signals;
  for (const ScrewJoint& joint : true_edge(part_a, part_b).joints) signals.push_back(joint.signal);
  return signals;
}

std::set<int> RigTruth::path_signals(int part_a, int part_b) const {
  const std::vector<int> joints = path_joints(part_a, part_b);
  return {joints.begin(), joints.end()};
}

std::string RigTruth::objection(const BodySchema& schema, const std::vector<int>& observed) const {
  std::map<int, int> component;
  for (const int part : observed) component[part] = part;
  const auto join = [&](int a, int b) {
    const int from = component.at(a), to = component.at(b);
    for (auto& [part, c] : component) {
      if (c == from) c = to;
    }
    return from != to;
  };

  std::size_t num_joints = 0;
  std::size_t num_joined = 0;
  for (const Edge& edge : schema.edges) {
    const std::vector<int> used = edge.signals();
    const std::string name = "edge " + std::to_string(edge.from) + "-" + std::to_string(edge.to);
    if (!component.contains(edge.from) || !component.contains(edge.to))
      return name + " names an unseen part";
    if (std::set<int>(used.begin(), used.end()) != path_signals(edge.from, edge.to)) {
      return name + " has the wrong signals";
    }
    const std::size_t num_true = path_joints(edge.from, edge.to).size();
    if (edge.joints.size() != num_true)
      return name + " has " + std::to_string(edge.joints.size()) + " joints, not " +
             std::to_string(num_true);
    const ChainVerdict verdict = judge_chain(edge, true_edge(edge.from, edge.to), schema.signals);
    if (!verdict.reason.empty()) return name + " " + verdict.reason;
    num_joints += num_true;
    if (!join(edge.from, edge.to)) return name + " closes a loop";
    ++num_joined;
  }
  if (num_joined + 1 != observed.size()) {
    return std::to_string(num_joined + 1) + " of " + std::to_string(observed.size()) +
           " parts joined";
  }

  // The least number of joints: Kruskal over the true path lengths.
  std::vector<std::tuple<std::size_t, int, int>> pairs;
  for (const int a : observed) {
    for (const int b : observed) {
      if (a < b) pairs.emplace_back(path_joints(a, b).size(), a, b);
    }
  }
  std::sort(pairs.begin(), pairs.end());
  for (const int part : observed) component[part] = part;
  std::size_t least = 0;
  for (const auto& [length, a, b] : pairs) {
    if (join(a, b)) least += length;
  }
  if (num_joints != least) {
    return std::to_string(num_joints) + " joints on the edges where " + std::to_string(least) +
           " suffice";
  }
  return "";
}

}  // namespace bodyschema::test
