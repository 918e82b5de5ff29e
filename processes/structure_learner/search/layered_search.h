#pragma once

#include <cstddef>
#include <map>
#include <utility>
#include <vector>

#include "processes/structure_learner/search/pair_models.h"

namespace bodyschema {

/// Joint ranges to assume of each signal [rad per half range]: those of its joints where the forest
/// has some, else `grid`.
std::vector<std::vector<double>> known_turns(const ModelForest& forest, int num_signals,
                                             const std::vector<double>& grid);

/// Kruskal on the layers k = 0, 1, … joints: the models that each two parts' own data make valid
/// (search_structure() says what waits for what).
class LayeredSearch {
 public:
  LayeredSearch(PairModels* pairs, ModelForest* forest) : pairs_(*pairs), forest_(*forest) {}

  /// The layers from `first_layer` joints on for what the forest does not connect, then what was
  /// doubtful in them: the simplest first.
  void run(int first_layer);

  /// Valid models between parts that were connected already.
  std::vector<Candidate>& spare() { return spare_; }

  /// Adds the best of the valid models of one pair to `candidates`, unless another signal set
  /// explains its data as well.
  void decide(std::vector<Candidate> valid, std::vector<Candidate>* candidates);
  /// One layer's candidates, best first: into the forest, to the doubtful or to the spare ones.
  void connect(std::vector<Candidate> candidates);

 private:
  using Turns = std::vector<std::vector<double>>;  // joint ranges to assume, by signal

  template <typename Visitor>
  void for_each_open_pair(Visitor&& visit);
  bool is_smaller_undecided(const Candidate& c);
  void layer_rigid();
  void layer_one_joint();
  void layer_two_joints();
  std::vector<std::pair<int, int>> open_pairs(std::size_t most, bool* is_all);
  // Of open_pairs(), without those of two components that a doubtful model joins if they are
  // skipped. True if no pair was left out for their number.
  bool two_joints_pass(const Turns& turns, std::size_t most_pairs, bool skips_doubtful);

  PairModels& pairs_;
  ModelForest& forest_;
  std::vector<Candidate> doubtful_;
  std::vector<Candidate> spare_;
  std::map<std::pair<int, int>, double> one_joint_score_;  // of the best, by pair
  int num_judged_ = 0;  // frames of the valid models found so far, and the outliers among them
  int num_outliers_ = 0;
  bool is_clean_ = false;
};

}  // namespace bodyschema
