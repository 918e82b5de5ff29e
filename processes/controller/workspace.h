#pragma once

#include <Eigen/Geometry>
#include <string>
#include <vector>

#include "common/config/yaml.h"
#include "common/schema/body_schema.h"

namespace bodyschema {

/// Where the origins of all parts may be, as boxes along the axes of the root's frame R [m].
struct Workspace {
  Eigen::AlignedBox3d within;  ///< empty: everywhere
  std::vector<Eigen::AlignedBox3d> keep_out;

  /// Reads `lowest`, `highest` and, if it is there, `keep_out`, a list of the same. @throws
  /// ConfigError.
  static Workspace load(const Yaml& yaml);

  /// "" or which part would leave it, by the schema, where all signals move evenly from one action
  /// to another: looked at in steps of at most a hundredth of each signal's range and of 5 mm of
  /// each part's origin. A part that is outside, or in a box, may go no deeper, and once back
  /// stays.
  std::string objection(const BodySchema& schema, const Eigen::VectorXd& from,
                        const Eigen::VectorXd& to) const;
  /// "" or why nothing may be brought there, in R [m].
  std::string objection(const Eigen::Vector3d& p_RT) const;
};

}  // namespace bodyschema
