#pragma once

#include <vector>

#include "processes/structure_learner/search/pair_models.h"

namespace bodyschema {

struct Settled {
  double log_likelihood = 0;  ///< of all poses, each tree fitted as a whole [nats]
  bool any_refuted = false;   ///< models were removed, and left a gap
  double residual_scale = 0;  ///< variance of a tree's residuals over the noise assumed, largest
};

/// Puts in the joints that only all markers together show, until nothing is left to explain. Where
/// a joint is missing, a spare model takes the place of one on its path that is not simpler, if all
/// poses then cost less; else what moves is parted by the joint. Models that cannot take up the
/// joint are refuted and removed.
Settled settle_trees(std::vector<Candidate>* spare, PairModels* pairs, ModelForest* forest);

}  // namespace bodyschema
