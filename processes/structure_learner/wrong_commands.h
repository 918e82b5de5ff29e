#pragma once

#include <vector>

#include "processes/structure_learner/pair_data.h"

namespace bodyschema {

/// Whether in the order of one of the signals that moved, be it one of the model's or not, so many
/// outliers stand together that chance does not explain it, one after the other or many with few
/// others between (hypergeometric): there the model is wrong, and not its poses. So it is where
/// outliers are those at which a signal is farthest from the value that it has at half of the
/// poses, or all that are away from that: nothing tells then what the signal does. `outlying`: by
/// sample of `samples`, which ascend. Of a stream, where outliers last, it is motions of signals
/// that mostly rest that count, two at least, and visits to a stretch of a signal's range.
/// O(D (K² + N log N)) of K outliers among N and D signals; of a stream O(D N), some 500 stretches.
bool is_wrong_at_some_commands(const std::vector<int>& samples, const std::vector<bool>& outlying,
                               const NormalizedActions& actions);
/// `squared_distance`: by frame of the pair.
bool is_wrong_at_some_commands(const PairData& pair, const std::vector<double>& squared_distance,
                               const NormalizedActions& actions);

/// log of the chance that of so many drawn from `total`, `marked` of which are marked, so many are.
double log_hypergeometric(int drawn_marked, int drawn, int marked, int total);

}  // namespace bodyschema
