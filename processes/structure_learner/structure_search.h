#pragma once

#include <map>
#include <set>
#include <utility>
#include <vector>

#include "processes/structure_learner/search/pair_models.h"
#include "processes/structure_learner/search/redundancy.h"

namespace bodyschema {

struct SearchResult {
  std::vector<AcceptedModel> models;  ///< the forest, in the order of acceptance
  /// Of the models, by their parts: those with joints that the forest does not need
  /// (redundant_edges()).
  std::vector<std::pair<int, int>> redundant;
  /// Of the models, by their parts (chains_with_unknown_gains()).
  std::vector<std::pair<int, int>> unknown_gains;
  std::vector<Coupling> couplings;  ///< joints of the models that may be none
  bool gave_way = false;            ///< screws to soft models (connect_soft_parts())
  std::map<std::pair<int, int>, PairRecord> records;
  std::set<int> resting;  ///< parts that keep their pose in the camera's frame
  /// All poses', each tree fitted as a whole, Student-t [nats]; up to a constant. It holds for a
  /// forest that spans: from one with gaps models may have been taken since.
  double log_likelihood = 0;
  /// Variance of what the forest leaves, over that of the noise assumed.
  double residual_scale = 0;
  /// By signal that moved: how clearly a joint on it would show in that edge which would show it
  /// least (missing_joint_information() [per (rad per half range)²]), edges that have it already
  /// apart. Infinite if there is no edge to judge.
  std::map<int, double> joint_information;
  int num_screens = 0;  ///< closed-form starts and regressions
  int num_fits = 0;     ///< Levenberg–Marquardt fits, of pairs and of whole trees
};

/// Layered search for the minimum spanning forest of valid local models (Section 3.2.1, Algorithm
/// 1).
///
/// The quality q(M) = s(M) − kΛ with Λ above the spread of s is the lexicographic order (k, −s). So
/// Kruskal may work layer by layer: k = 0 first, then k = 1 for the pairs that the forest has not
/// yet connected, then k = 2. That is exact (the spanning forests are a matroid) and leaves most
/// models unevaluated. Of more than 14 parts not all pairs are searched for two joints.
///
/// With few frames a true model may be kept out by bad luck (too many outliers) and would come back
/// as a superset of its signals: so no larger model is accepted between two components while a
/// smaller one is undecided. A wrong one may pass by calling what it cannot explain outliers: so
/// where the data as a whole show fewer outliers than assumed, models with many wait until the
/// layers are through, and a larger model takes their place if it explains the data better by more
/// than its parameters are worth (6 log 6N a signal).
///
/// When the layers are through, each tree is fitted to all its poses at once (TreeFit). A pair
/// shows only what exceeds the noise of two markers; all markers beyond a joint together show far
/// smaller motions: settle_trees() puts in the joints that are missing. What it drops leaves gaps,
/// so the layers run again. Components that narrowly refuted models keep apart are joined by
/// bridge(). In the end an edge stands only if its data could have refuted it:
/// withdraw_untold_edges() takes the others back, and more samples are needed; and only if no
/// signal that moves as its own explains it as well (settle_look_alikes()), nor another order of
/// its joints (withdraw_open_orders()).
///
/// Hypotheses are screened and fitted on an even subset of the instants, and so are trees. What a
/// layer is about to accept must be valid on all of them; what the fits of trees put in or join is
/// judged by all markers of the subset instead.
SearchResult search_structure(const std::vector<ActionPoseSample>& samples,
                              const NormalizedActions& actions, const std::vector<int>& parts,
                              const SearchOptions& options);

}  // namespace bodyschema
