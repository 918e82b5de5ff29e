#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "common/schema/body_schema.h"

namespace bodyschema {

/// The engineered model (Section 5.2 of the chapter) as a body schema: the joints of a URDF between
/// the links that carry parts, and where on their links these are. `placement` is a YAML file:
///
///   root: 1                    # the root part
///   uncertainty: {position_m: 0.002, rotation_deg: 0.5}   # of every edge, per axis
///   signals:     # in the order of the actions; joint position = gain·command + offset
///     - {name: q1, joint: j1, gain: 0.8727, offset: 0.14, lower: -1, upper: 1}
///     - {name: q2, lower: 0, upper: 1}                      # moves nothing
///   parts:                     # X_LB: the part in the frame of its link
///     - {part: 1, link: base, X_LB: {position_m: [0, 0, 0.1], rpy_deg: [0, 0, 0]}}
///
/// Joints are in rad and m; what no signal moves stands at 0. X_CR is left unknown: identity with
/// a covariance of 0. `joints`, if given, receives the URDF's names of the joints, in the order of
/// the edges.
/// @throws ConfigError, std::runtime_error if the URDF cannot be read or has a joint that no screw
/// is.
BodySchema engineered_model(const std::filesystem::path& urdf,
                            const std::filesystem::path& placement,
                            std::vector<std::string>* joints = nullptr);

}  // namespace bodyschema
