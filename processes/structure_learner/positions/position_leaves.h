#pragma once

#include <map>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "processes/structure_learner/structure_search.h"

namespace bodyschema {

/// Why a part that has positions alone hangs on nothing yet.
struct OpenLeaf {
  bool is_data_missing = false;
  std::string reason;
};

struct PositionLeaves {
  std::vector<AcceptedModel> models;  ///< part_i has poses, part_j is the leaf
  std::map<int, OpenLeaf> open;       ///< by part: those without a model
};

/// The edges to parts that have positions alone. Such a part is a leaf below one that has poses. Of
/// parts that rest only one is asked, in the camera's frame: that it rests says more of its pose
/// than each sight of it.
///
/// Models of all parents, signals and up to two joints compete: each that is valid
/// (check_validity(), with three residuals a sample) by what it leaves and by its number of
/// parameters. Of those within a few nats of the best the one with the fewest signals between the
/// root and the leaf stands: a joint that the position hardly shows is none. Where another one's
/// signals do not include these, both are named and the leaf stays open; so it does where the data
/// could not have shown a joint that moves it by 65 mm. Where none is valid a chain of any number
/// of joints is looked for (fit_long_chain()), below the few parents that are seen most often with
/// it: of the signals that move no part with poses, then of all that do not move the parent.
/// Independent positions must be four times as many as these signals. Their order is searched for
/// where one part alone can be the parent, from poses at rest, of up to eight.
///
/// `samples` as of with_uniform_parts(), of which `actions` are; `root` is where the signals of a
/// leaf are counted from; names of the signals are for people. Updates `found`'s number of fits,
/// screens and joint_information.
PositionLeaves find_position_leaves(const std::vector<ActionPoseSample>& samples,
                                    const NormalizedActions& actions, int root,
                                    const std::vector<Signal>& signals,
                                    const SearchOptions& options, SearchResult* found);

}  // namespace bodyschema
