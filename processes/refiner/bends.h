#pragma once

#include <vector>

#include "processes/refiner/refine.h"

namespace bodyschema {

/// A command that is linear in a schema and that samples show to be bent.
struct FoundBend {
  int signal = 0;       ///< index
  double evidence = 0;  ///< [nats] over a linear command
};

struct BentSchema {
  BodySchema schema;             ///< with the bends, its other parameters as they were
  std::vector<FoundBend> bends;  ///< in the order in which they were found
};

/// Adds bends to a schema whose edges are of screws alone, one at a time, the likeliest first:
/// where commands go together, one that bends makes others seem to. At a fit to the parts' poses
/// the log likelihood of a signal's weights, all other parameters free, is quadratic, and that of
/// warp_processes(). A bend must beat the line by kWarpEvidence, there and when all is fitted with
/// it, and its command be read at kFewestWarpPositions.
///
/// Of poses, for where corners are fitted joints may be off their commands at every sample, and
/// what droops would do so by bends.
BentSchema with_bends(const BodySchema& schema, const std::vector<RefinerSample>& samples,
                      const RefineOptions& options, bool root_moves);

}  // namespace bodyschema
