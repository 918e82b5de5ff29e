#pragma once

#include <compare>
#include <utility>
#include <vector>

#include "processes/structure_learner/search/pair_models.h"

namespace bodyschema {

/// Edges with a signal that the tree does not need: two edges use it, but the parts at the far ends
/// of both, as these models predict them, do not move with it by more than the noise of one sight
/// (that of the loudest marker, if more is told: no systematic error is as large). So there is an
/// edge of fewer joints between those parts, and that the data refuted it has another reason than
/// motion: outliers, or a bias of views. Of the two edges the one with more joints is returned, by
/// its parts, and its record says so. O(E² N) for E edges that share a signal and N frames of a
/// pair. And chains of more than two joints that turn to a part that, by the rotations, one joint
/// would hang on another: its positions have an error of another kind, as of a marker of another
/// size. O(N) for each such chain, node and signal.
std::vector<std::pair<int, int>> redundant_edges(PairModels* pairs, ModelForest forest);

/// A joint of a signal that has another one, and that adds far less than the signal moves there:
/// without it, all else of its edge adapted, predictions are off by so little. Arms are rarely
/// built so: it may be how that motion loads the other joints, or what a view biases.
struct Coupling {
  int part_i = 0, part_j = 0;
  int signal = 0;
  bool is_needless = false;  ///< adds less than that noise
  friend auto operator<=>(const Coupling&, const Coupling&) = default;
};
/// In the order of the forest's models; then of each tree one joint that an edge on another way
/// between parts would not have, for these move as little. One fit for each joint of a signal with
/// several, else O(E² N). The records of edges with needless ones say so.
std::vector<Coupling> couplings(PairModels* pairs, const ModelForest& forest);

}  // namespace bodyschema
