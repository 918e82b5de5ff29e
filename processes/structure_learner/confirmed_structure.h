#pragma once

#include <functional>
#include <vector>

#include "processes/structure_learner/learn.h"

namespace bodyschema {

/// How to search: with all standard deviations of the noise `factor` times as large, where every
/// marker may have a bias that nobody told (SearchOptions::unknown_bias), beginning with commands
/// that are bent like these; none: with straight ones.
struct StructureQuery {
  double factor = 1, unknown_bias = 0;
  std::vector<Signal> bent = {};
};
using FindStructure = std::function<LearnedStructure(const StructureQuery&)>;
/// Connects what no screws do, with Gaussian processes beside them.
using ConnectSoftParts = std::function<void(LearnedStructure*)>;

/// The structure as it is with the noise told, unless the residuals refute that noise. What no
/// model describes (a bias of views, a tag that is not where it should be) looks like more joints
/// to whoever believes too small a noise: these go when the noise is doubled, joints that move
/// several times the noise stay.
///
/// So where the residuals are larger than the noise explains, or edges have joints that they do not
/// need (SearchResult::redundant) or that may be none (SearchResult::couplings), or no structure
/// spans although data are enough, the noise is doubled until two structures in a row are the same
/// (parts that are fixed to each other are one body, whichever of them bears a joint) and without
/// such joints; that of the smaller noise, at most four times the told one, is the answer. Noise
/// that was guessed from residuals is doubled where edges have such joints, or where neither screws
/// nor processes span, and then only up to kLoudestMarker. It ends where more noise connects no
/// more parts. Where a signal that the first structure uses is used no more with larger noise, size
/// alone does not tell a small joint from a bias: what the two do not share is left open
/// (LearnedStructure::is_contested). So are redundant edges of the answer, chains with unknown
/// gains, and soft parts that screws describe with noise of which the residuals show less than
/// half, unless these are screws with bent commands, which show only by a model: with these it is
/// searched with less noise again. Parts that screws do not connect are soft only where more noise
/// is no answer; where the noise is a guess, it is the other way round.
///
/// Noise of a stream that was estimated from residuals is raised by a fifth, at most twice, until a
/// structure spans.
LearnedStructure confirmed_structure(const FindStructure& find,
                                     const ConnectSoftParts& connect_soft_parts);

}  // namespace bodyschema
