#include "processes/structure_learner/search/mimic_joints.h"

#include <algorithm>
#include <limits>
#include <map>
#include <optional>
#include <utility>
#include <vector>

#include "processes/structure_learner/search/long_chains.h"
#include "processes/structure_learner/search/redundancy.h"

namespace bodyschema {
namespace {

// Components that lie apart and signals that move nothing in the forest, beyond which the words are
// too many to tell by one pair's poses.
constexpr std::size_t kMaxComponents = 3, kMaxIdle = 4;
// Pairs of two components: those of which one joint leaves least, and of these those of which two
// joints of one signal do.
constexpr std::size_t kMaxPairs = 12, kMaxPairsOfThree = 3;

// A frame, above which another order of the joints is no remedy either (chosen: a right model
// costs 4 to 7 nats, one without the second joint of a signal 20).
constexpr double kHopelessCost = 16;

using Word = std::vector<int>;  // signals in the order of the joints

double one_joint_score(const Pair& ij, PairModels* pairs) {
  const auto regressions = screen_one_joint(pairs->motions(ij.first, ij.second), pairs->actions());
  pairs->num_screens += static_cast<int>(regressions.size());
  return regressions.empty() ? std::numeric_limits<double>::infinity() : regressions.front().score;
}

// The first `most` of the pairs by what `score` says of them.
template <typename Score>
void keep_least(std::vector<Pair>* between, std::size_t most, Score&& score) {
  std::map<Pair, double> scores;
  for (const Pair& ij : *between) scores[ij] = score(ij);
  std::ranges::stable_sort(*between, {}, [&](const Pair& ij) { return scores[ij]; });
  if (between->size() > most) between->resize(most);
}

class MimicSearch {
 public:
  MimicSearch(const std::vector<int>& idle, PairModels* pairs) : idle_(idle), pairs_(*pairs) {}

  std::optional<Candidate> best(std::vector<Pair> between) {
    std::erase_if(between, [&](const Pair& ij) { return !shows_any_joint(ij, &pairs_); });
    keep_least(&between, kMaxPairs, [&](const Pair& ij) { return one_joint_score(ij, &pairs_); });
    keep_least(&between, kMaxPairsOfThree, [&](const Pair& ij) { return try_two(ij); });
    if (valid_.empty() && pairs_.options().max_signals > 2)
      for (const Pair& ij : between) try_three(ij);
    std::optional<Candidate> best = pairs_.only_best(valid_);
    if (best && is_coupled(*best)) best.reset();
    return best;
  }

 private:
  // A second joint of a signal that adds little is how one joint is imperfect.
  bool is_coupled(const Candidate& c) {
    ModelForest alone({c.part_i, c.part_j});
    alone.add(c);
    return !couplings(&pairs_, alone).empty();
  }

  // What the chain leaves a frame. If it is valid and not doubtful, it is kept.
  double try_word(const Pair& ij, const Word& word) {
    double cost = 0;
    std::optional<Candidate> c = chain_between(ij, word, JointOrder::kListed, &pairs_, &cost);
    if (c && !c->doubtful) valid_.push_back(*std::move(c));
    return cost;
  }

  double try_two(const Pair& ij) {
    double least = std::numeric_limits<double>::infinity();
    for (const int a : idle_) least = std::min(least, try_word(ij, {a, a}));
    return least;
  }

  // On the two signals of which single joints leave least; in another order where the first one
  // leaves little.
  void try_three(const Pair& ij) {
    std::optional<std::pair<int, int>> signals;
    double least = std::numeric_limits<double>::infinity(), cost = 0;
    for (std::size_t k = 0; k < idle_.size(); ++k)
      for (std::size_t l = k + 1; l < idle_.size(); ++l) {
        chain_between(ij, {idle_[k], idle_[l]}, JointOrder::kListed, &pairs_, &cost);
        if (cost >= least) continue;
        least = cost;
        signals = {idle_[k], idle_[l]};
      }
    if (!signals) return;
    for (const auto& [a, b] : {*signals, std::pair(signals->second, signals->first)}) {
      if (try_word(ij, {a, a, b}) > kHopelessCost) continue;
      try_word(ij, {a, b, a});
      try_word(ij, {b, a, a});
    }
  }

  const std::vector<int>& idle_;
  PairModels& pairs_;
  std::vector<Candidate> valid_;
};

}  // namespace

bool connect_mimic_joints(PairModels* pairs, ModelForest* forest) {
  const std::size_t num_components = forest->parts().size() - forest->models().size();
  std::vector<int> idle = pairs->actions().moving();
  std::erase_if(idle, [used = forest->used_signals()](int s) { return used.contains(s); });
  if (num_components > kMaxComponents || idle.empty() || idle.size() > kMaxIdle ||
      pairs->options().max_signals < 2 || pairs->options().unknown_bias > 0 ||
      pairs->actions().blocks().is_stream())
    return false;
  const std::map<Pair, PairRecord> records = pairs->records();
  std::vector<Candidate> found;
  for (const auto& [components, between] : pairs_between_components(pairs, *forest))
    if (auto best = MimicSearch(idle, pairs).best(between)) found.push_back(*std::move(best));
  // Pairs left undecided here do not stop the search for other models.
  pairs->records() = records;
  std::ranges::stable_sort(found, {}, rank);
  return add_chains(std::move(found), pairs, forest);
}

}  // namespace bodyschema
