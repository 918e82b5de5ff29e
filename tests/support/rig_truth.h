#pragma once

#include <filesystem>
#include <set>
#include <vector>

#include "common/scene/robot.h"
#include "common/schema/body_schema.h"
#include "tests/support/chain_judgement.h"

namespace bodyschema::test {

/// The structure of a simulated rig, from robot.yaml, for judging alone.
class RigTruth {
 public:
  explicit RigTruth(const std::filesystem::path& rig_folder);

  /// The chain of joints between two parts.
  Edge true_edge(int from, int to) const;
  /// The signal of each joint on the path between two parts, in its order: two joints may share
  /// one, as the fingers of a gripper do.
  std::vector<int> path_joints(int part_a, int part_b) const;
  /// Indices of the signals whose joints lie on the path between two parts.
  std::set<int> path_signals(int part_a, int part_b) const;
  std::vector<int> parts() const;
  /// Exact pose of every part in the world for an action.
  const Robot& robot() const { return robot_; }

  /// "" if `schema` is right: it spans `observed` parts, every edge's signals, and the number of
  /// its joints, are those of the true path between its two parts, long edges are right
  /// (judge_chain), and the joints are the least possible
  /// (a gripper's fingers, without the part that carries them, are two joints apart, which no screw
  /// on their one signal is). Else the reason why it is wrong.
  std::string objection(const BodySchema& schema, const std::vector<int>& observed) const;

 private:
  std::vector<int> ancestors(int link) const;
  const PartPlacement& placement_of(int part) const;

  Robot robot_;
};

}  // namespace bodyschema::test
