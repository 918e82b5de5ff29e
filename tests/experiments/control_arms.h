#pragma once

#include <string>
#include <vector>

#include "tests/support/synthetic_robot.h"

namespace bodyschema::test {

inline constexpr int kWayPoints = 30;
inline constexpr int kRoot = 1, kEndEffector = 5, kMiddle = 3;

enum class Body { kWhole, kBent, kLonger };

struct Arms {
  SyntheticRobot whole, bent, longer;
  std::vector<Eigen::Vector3d> path;  ///< of the end effector, in the root's frame [m]

  const SyntheticRobot& of(Body body) const {
    return body == Body::kWhole ? whole : body == Body::kBent ? bent : longer;
  }
};

/// A closed path that the whole arm and the bent one can follow.
Arms arms_of(Rng& rng);

/// The arms of Table 2, one a line: each part hangs on the one before it, part 2 on part 1, by
/// X_before · Rot_z(q) · X_after; bent, part 3 by another X_after; and the way points of part 5 in
/// part 1.
void write_geometry(int num_runs, const std::string& file);

}  // namespace bodyschema::test
