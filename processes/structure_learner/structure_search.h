#pragma once

#include <map>
#include <set>
#include <utility>
#include <vector>

#include "processes/structure_learner/local_model.h"
#include "processes/structure_learner/screen.h"
#include "processes/structure_learner/validity.h"

namespace bodyschema {

/// χ² that a joint must put into the residuals to be noticed: against χ²₆ beyond 25, the threshold
/// of V2 (check_validity()), a noncentrality of 48 has a power of 97.7 %.
inline constexpr double kNoticed = 48;

struct SearchOptions {
  MeasurementModel measurement;
  ValidityOptions validity;
  int max_signals = 2;  ///< largest k, at most kMaxJoints
};

/// An accepted local model between parts i < j.
struct AcceptedModel {
  int part_i = 0;
  int part_j = 0;
  LocalModel model;
  double score = 0;
  /// Q of a soft model (residual_fit.h), whose screws `model` then are; empty: screws alone.
  std::vector<int> soft_signals = {};
};

/// What the search tried between two parts.
struct PairRecord {
  int num_common = 0;  ///< instants at which both were seen
  /// The models that were not refuted but that the data are too few to trust: mean of min(d², 2c)
  /// of the best, by k.
  std::map<int, double> undecided;
  bool was_soft_tried = false;  ///< a Gaussian process on the screws' rest was fitted too
  /// Signals that moved too little while both were seen to tell whether they move the one against
  /// the other: why a model was taken back.
  std::set<int> untold_signals = {};
};

struct SearchResult {
  std::vector<AcceptedModel> models;  ///< the forest, in the order of acceptance
  std::map<std::pair<int, int>, PairRecord> records;
  /// Of all poses, each tree fitted as a whole, Student-t [nats]; up to a constant. Of a forest
  /// that spans: from one with gaps models may have been taken since.
  double log_likelihood = 0;
  /// Of each signal that moved: how clearly a joint on it would show in that edge which would show
  /// it least (TreeFit::joint_information() [per (rad per half range)²]); of edges that have it
  /// already, nothing. Infinite where there is no edge to judge.
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
/// models unevaluated.
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
/// smaller motions. So where a score test finds a joint missing, a valid model that was left over
/// takes the place of one on its path if all poses then cost less; else the joint is put in; models
/// that have no room for it are dropped and the layers run again, and components that narrowly refuted models keep
/// apart are joined if that costs no more than noise does.
///
/// In the end an edge stands only if its data could have refuted it: if a joint on any other signal
/// that moved would have been noticed (kNoticed). Else it is taken back, and more samples are
/// needed.
///
/// Hypotheses are screened and fitted on an even subset of the instants, and so are trees. What a
/// layer is about to accept must be valid on all of them; what the fits of trees put in or join is
/// judged by all markers of the subset instead.
SearchResult search_structure(const std::vector<ActionPoseSample>& samples,
                              const NormalizedActions& actions, const std::vector<int>& parts,
                              const SearchOptions& options);

}  // namespace bodyschema
