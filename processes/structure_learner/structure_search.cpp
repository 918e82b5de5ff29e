#include "processes/structure_learner/structure_search.h"

#include "processes/structure_learner/search/bridging.h"
#include "processes/structure_learner/search/hidden_bodies.h"
#include "processes/structure_learner/search/layered_search.h"
#include "processes/structure_learner/search/long_chains.h"
#include "processes/structure_learner/search/look_alikes.h"
#include "processes/structure_learner/search/mimic_joints.h"
#include "processes/structure_learner/search/open_orders.h"
#include "processes/structure_learner/search/settling.h"
#include "processes/structure_learner/search/withdrawal.h"

namespace bodyschema {

SearchResult search_structure(const std::vector<ActionPoseSample>& samples,
                              const NormalizedActions& actions, const std::vector<int>& parts,
                              const SearchOptions& options) {
  constexpr int kMaxRounds = 4;
  PairModels pairs(samples, actions, parts, options);
  ModelForest forest(parts);
  LayeredSearch layers(&pairs, &forest);
  Settled settled;
  for (int round = 0; round < kMaxRounds; ++round) {
    layers.run(round == 0 ? 0 : 1);
    // Models that all markers together refute leave gaps, which others may fill.
    settled = settle_trees(&layers.spare(), &pairs, &forest);
    if (!settled.any_refuted) break;
  }
  if (!forest.spans() && bridge(&pairs, &forest))
    settled = settle_trees(&layers.spare(), &pairs, &forest);
  if (!forest.spans() && connect_hidden_bodies(&pairs, &forest))
    settled = settle_trees(&layers.spare(), &pairs, &forest);
  if (!forest.spans() && connect_long_chains(&pairs, &forest))
    settled = settle_trees(&layers.spare(), &pairs, &forest);
  if (!forest.spans() && connect_mimic_joints(&pairs, &forest))
    settled = settle_trees(&layers.spare(), &pairs, &forest);
  const bool has_other_signals = settle_look_alikes(&pairs, &forest);
  const bool has_other_orders = withdraw_open_orders(&pairs, &forest);
  if (std::vector<Candidate> none; has_other_signals || has_other_orders)
    settled = settle_trees(&none, &pairs, &forest);
  SearchResult result;
  result.joint_information = withdraw_untold_edges(&pairs, &forest);
  result.unknown_gains = chains_with_unknown_gains(&pairs, forest);
  result.redundant = redundant_edges(&pairs, forest);
  result.couplings = couplings(&pairs, forest);
  result.models = forest.models();
  result.records = std::move(pairs.records());
  for (const int part : parts)
    if (pairs.rests(part)) result.resting.insert(part);
  result.log_likelihood = settled.log_likelihood;
  result.residual_scale = settled.residual_scale;
  result.num_screens = pairs.num_screens;
  result.num_fits = pairs.num_fits;
  return result;
}

}  // namespace bodyschema
