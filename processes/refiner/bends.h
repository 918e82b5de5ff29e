#pragma once

#include <vector>

#include "processes/refiner/refine.h"

namespace bodyschema {

/// A command that is linear in a schema and bent in the samples.
struct FoundBend {
  int signal = 0;       ///< index
  double evidence = 0;  ///< [nats] over a linear command
};

struct BentSchema {
  BodySchema schema;             ///< with the bends, its other parameters as they were
  std::vector<FoundBend> bends;  ///< in the order in which they were found
  /// Signals that moved, but were read at too few positions for bends of theirs to be looked for.
  std::vector<int> too_few_positions;
};

/// Adds bends to a schema, of signals that are bendable. Where a fit to the parts' poses has its
/// best, the log likelihood of a signal's weights (Signal::warp), all other parameters free, is
/// quadratic: warp_processes() tell how much likelier the weights of a process are than none. Bends
/// that beat the line by kWarpEvidence are added, the likeliest first, each with those before it
/// free. A fit with them must be as much likelier, else the likeliest alone is tried. A signal is
/// linear where parts beyond its joints were seen at fewer than kFewestWarpPositions.
///
/// To poses also where corners are fitted: with joints that may be off their commands at every
/// sample the evidence of bends is not that of the commands, but that of the joints' droop.
BentSchema with_bends(const BodySchema& schema, const std::vector<RefinerSample>& samples,
                      const RefineOptions& options, bool root_moves);

}  // namespace bodyschema
