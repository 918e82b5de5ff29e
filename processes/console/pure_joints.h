#pragma once

#include <map>
#include <string>
#include <vector>

#include "common/schema/body_schema.h"

namespace bodyschema {

/// A schema all joints of which are revolute, prismatic or stuck, and how it differs from the one
/// that it was made from, for people.
struct PureJoints {
  BodySchema schema;
  std::vector<std::string> about_signals;
  std::map<std::size_t, std::vector<std::string>> about_edges;  ///< by index of the edge
};

/// The schema with the pure joint that is nearest to each of its own: no edge has a Gaussian
/// process, no signal a warp.
///
/// A screw that slides and turns keeps what moves its part more in units of the noise of one
/// marker (1 mm and 0.2° where the schema has none). The other is set to 0, and the parameters of
/// its edge to their mean given that, by Edge::parameter_covariance: least squares, to first order.
/// Where that is not known, the joint stands at ϑ(θ_mid) in the other, θ_mid the action with every
/// signal in the middle of its range. All that is left out without `nominal` is within three
/// standard deviations of 0. The rest needs `nominal`:
/// - a screw that slides and turns by more: the same;
/// - a warp: the straight line of least squares through θ(q) between the limits;
/// - a residual Gaussian process: the screws, and its constant value ρ(θ_mid);
/// - a matrix Gaussian process: a screw for each signal, in their order, by the derivative at
///   θ_mid.
/// @throws std::invalid_argument without `nominal`, naming all that need it.
PureJoints pure_joints(const BodySchema& schema, bool nominal);

}  // namespace bodyschema
