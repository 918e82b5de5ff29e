#include "processes/structure_learner/search/mimic_joints.h"

#include <algorithm>
#include <limits>
#include <map>
#include <optional>
#include <utility>
#include <vector>

#include "processes/structure_learner/search/long_chains.h"

namespace bodyschema {
namespace {

// Components that lie apart and signals that move nothing in the forest, beyond which the words are
// too many to tell by one pair's poses.
constexpr std::size_t kMaxComponents = 3, kMaxIdle = 4;
// Pairs of two components: those of which one joint leaves least, and of these those of which two
// joints of one signal do.
constexpr std::size_t kMaxPairs = 12, kMaxPairsOfThree = 3;

using Word = std::vector<int>;  // signals in the order of the joints

std::vector<Word> words_of_three(const std::vector<int>& signals) {
  std::vector<Word> words;
  for (const int a : signals)
    for (const int b : signals)
      if (a != b) words.insert(words.end(), {{a, a, b}, {a, b, a}, {b, a, a}});
  return words;
}

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

// Valid and not doubtful, into `valid`; what the best of them leaves a frame.
double try_words(const Pair& ij, const std::vector<Word>& words, PairModels* pairs,
                 std::vector<Candidate>* valid) {
  double least = std::numeric_limits<double>::infinity();
  for (const Word& word : words) {
    double cost = 0;
    std::optional<Candidate> c = chain_between(ij, word, JointOrder::kListed, pairs, &cost);
    least = std::min(least, cost);
    if (c && !c->doubtful) valid->push_back(*std::move(c));
  }
  return least;
}

std::optional<Candidate> best_between(std::vector<Pair> between, const std::vector<int>& idle,
                                      PairModels* pairs) {
  std::erase_if(between, [&](const Pair& ij) { return !shows_any_joint(ij, pairs); });
  keep_least(&between, kMaxPairs, [&](const Pair& ij) { return one_joint_score(ij, pairs); });
  std::vector<Word> twice;
  for (const int a : idle) twice.push_back({a, a});
  std::vector<Candidate> valid;
  keep_least(&between, kMaxPairsOfThree,
             [&](const Pair& ij) { return try_words(ij, twice, pairs, &valid); });
  if (valid.empty() && pairs->options().max_signals > 2)
    for (const Pair& ij : between) try_words(ij, words_of_three(idle), pairs, &valid);
  return pairs->only_best(valid);
}

}  // namespace

bool connect_mimic_joints(PairModels* pairs, ModelForest* forest) {
  const std::size_t num_components = forest->parts().size() - forest->models().size();
  std::vector<int> idle = pairs->actions().moving();
  std::erase_if(idle, [used = forest->used_signals()](int s) { return used.contains(s); });
  if (num_components > kMaxComponents || idle.size() > kMaxIdle ||
      pairs->options().max_signals < 2 || pairs->actions().blocks().is_stream())
    return false;
  std::vector<Candidate> found;
  for (const auto& [components, between] : pairs_between_components(pairs, *forest))
    if (auto best = best_between(between, idle, pairs)) found.push_back(*std::move(best));
  std::ranges::stable_sort(found, {}, rank);
  return add_chains(std::move(found), pairs, forest);
}

}  // namespace bodyschema
