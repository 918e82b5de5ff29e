#pragma once

#include <string>
#include <vector>

#include "common/schema/body_schema.h"

namespace bodyschema {

/// A body schema as the two files that engineered_model() reads, and what is to be known of them.
struct UrdfModel {
  std::string urdf;
  std::string placement;  ///< YAML
  int num_links = 0;
  int num_moving_joints = 0;
  /// In what the URDF differs from the schema; its comments say the same. For people.
  std::vector<std::string> remarks;
};

/// The inverse of engineered_model(): a URDF whose links move as the schema's parts [m, rad], and
/// the action signals on its joints. Its engineered model predicts what pure_joints() of the
/// schema do, to rounding.
///
/// Link part_<id> is the frame of the part; the root part's link is the root. Each joint before a
/// part moves a link of its own, part_<id>_link_<n>, unless it can move the part's link itself.
/// Frames are canonical: with joint positions of 0 a link is turned as the part that follows; the
/// origin of a turning link is the point of its axis nearest to the next origin, that of a sliding
/// one is the next origin. Joint positions are the schema's, (slide or turn) · (gain·θ + offset).
/// The first joint of a signal (parts by depth, then id) has its name; the others mimic it. Turning
/// joints of a signal without a range are continuous, stuck joints fixed. Comments hold standard
/// deviations, what is open, and what was left out.
/// @throws std::invalid_argument if the schema is incomplete, and as pure_joints().
UrdfModel urdf_model(const BodySchema& schema, bool nominal);

}  // namespace bodyschema
