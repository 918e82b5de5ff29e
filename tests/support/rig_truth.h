#pragma once

#include <filesystem>
#include <set>
#include <vector>

#include "common/scene/robot.h"
#include "common/schema/body_schema.h"

namespace bodyschema::test {

/// The structure of a simulated rig, from robot.yaml, for judging alone.
class RigTruth {
 public:
  explicit RigTruth(const std::filesystem::path& rig_folder);

  /// Indices of the signals whose joints lie on the path between two parts.
  std::set<int> path_signals(int part_a, int part_b) const;
  std::vector<int> parts() const;
  /// Exact pose of every part in the world for an action.
  const Robot& robot() const { return robot_; }

  /// "" if `schema` is right: it spans `observed` parts, every edge's signals are exactly those on
  /// the true path between its two parts, and their number is the least possible. Else what is
  /// wrong.
  std::string objection(const BodySchema& schema, const std::vector<int>& observed) const;

 private:
  std::vector<int> ancestors(int link) const;
  int link_of(int part) const;

  Robot robot_;
};

}  // namespace bodyschema::test
