#pragma once

#include <optional>
#include <set>
#include <vector>

#include "common/schema/body_schema.h"
#include "common/schema/sample.h"

namespace bodyschema {

/// Noise per axis of one marker, as what the residuals of two edges have in common that meet at its
/// part: there an error of the marker is in both, an error of the body in one. So it tells them
/// apart where the noise is not known otherwise, as what the edges leave does not. The largest that
/// one standard error allows: where a body is off by much the mean itself may be any, below 0 too.
///
/// Residuals of the fit are enlarged to the leave-one-out residuals. `displaced`: samples whose
/// actions are displacements. std::nullopt: no two edges meet at a part that is measured
/// (fixed_parts()), or too few samples show both.
std::optional<Noise> noise_in_common(const BodySchema& schema,
                                     const std::vector<ActionPoseSample>& displaced);

/// Adds to the covariance of each edge of screws what it leaves that neither this noise nor the
/// scatter of its joints explains: what it stands on moves, or it gives way. At the edge's end,
/// alike along all axes. `fixed_parts` have no noise. True if there was any.
bool add_unexplained(const Noise& noise, const std::set<int>& fixed_parts, BodySchema* schema);

/// What the edges leave is the markers' noise or the body's: where schema->noise, estimated from
/// it, is much more than `of_markers`, it is that instead; what an edge leaves beside that is the
/// body's (add_unexplained()). True if there is any.
bool tell_noise_from_body(Noise of_markers, const std::set<int>& fixed_parts, BodySchema* schema);

}  // namespace bodyschema
