#include "processes/structure_learner/search/long_chains.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>

#include "processes/structure_learner/long_chain/coupled_joints.h"
#include "processes/structure_learner/long_chain/long_chain.h"
#include "processes/structure_learner/residual_fit.h"
#include "processes/structure_learner/screen.h"

namespace bodyschema {
namespace {

// Pairs of two components that are tried, those seen together most often first.
constexpr std::size_t kMaxPairs = 12;
// Components that lie apart, beyond which no order of joints is searched for: what falls into many
// pieces is no arm that is seen at its ends, and each two of them would cost a second.
constexpr std::size_t kMaxSearched = 3;
// Pairs for which one more signal is tried, those that the others explain best, and such signals.
constexpr std::size_t kMaxExtended = 3, kMaxMore = 10;

std::vector<int> without(const std::vector<int>& signals, const std::set<int>& used) {
  std::vector<int> result;
  std::copy_if(signals.begin(), signals.end(), std::back_inserter(result),
               [&](int s) { return !used.contains(s); });
  return result;
}

// Of the pairs. `costs` gets what the chains leave.
std::optional<Candidate> best_chain(const std::vector<Pair>& between,
                                    const std::vector<int>& signals, bool are_few,
                                    PairModels* pairs, std::map<Pair, double>* costs) {
  // What moves as a stream is often soft: no order is searched for where none may fit.
  const bool is_only_pair = are_few && between.size() == 1;
  const bool is_searched = is_only_pair && !pairs->actions().blocks().is_stream();
  std::optional<Candidate> best;
  for (const Pair& ij : between) {
    std::optional<Candidate> found =
        chain_between(ij, signals, is_searched ? JointOrder::kUnknown : JointOrder::kListed, pairs,
                      &(*costs)[ij], is_only_pair);
    if (found && (!best || rank(*found) < rank(*best))) best = std::move(found);
  }
  return best;
}

// With one more joint, of a signal that moves other parts, too: those of a hidden one that carries
// them. None if another signal does as well.
std::optional<Candidate> best_extended(std::vector<Pair> between, std::map<Pair, double> costs,
                                       const std::vector<int>& signals, std::vector<int> more,
                                       PairModels* pairs) {
  std::ranges::stable_sort(between, {}, [&](const Pair& ij) { return costs[ij]; });
  if (between.size() > kMaxExtended) between.resize(kMaxExtended);
  if (more.size() > kMaxMore) more.resize(kMaxMore);
  std::vector<Candidate> found;
  double cost = 0;
  for (const Pair& ij : between) {
    if (!shows_any_joint(ij, pairs)) continue;
    for (const int s : more) {
      std::vector<int> all = signals;
      all.insert(std::ranges::upper_bound(all, s), s);
      auto c = chain_between(ij, all, JointOrder::kListed, pairs, &cost);
      // With fewer joints the layers have searched for it.
      if (c && !c->doubtful && c->model.num_joints() > kMaxScreenedJoints)
        found.push_back(*std::move(c));
    }
  }
  const std::optional<Candidate> best = pairs->only_best(found);
  return best ? std::optional(with_searched_order(*best, pairs)) : std::nullopt;
}

// A soft body, too, moves like a chain of many joints, roughly: where a Gaussian process predicts
// the blocks that were left out better, it is for connect_soft_parts().
bool is_rather_soft(const Candidate& chain, const PairModels& pairs) {
  constexpr int kMaxFrames = 600;
  const NormalizedActions& actions = pairs.actions();
  const PairData pair = pairs.pair_data(chain.part_i, chain.part_j, kMaxFrames);
  const LocalModel rigid = screen_rigid(pair, actions).model;
  const auto soft = fit_soft_model(fit_local_model(rigid, pair, actions, 30, 1e-3).model, pair,
                                   actions, pairs.options().validity);
  if (!soft || soft->verdict != Verdict::kValid) return false;
  const Fit fit = fit_local_model(chain.model, pair, actions, 15, 1e-2);
  return soft->log_density > log_density_of_screws(fit, pair, actions);
}

}  // namespace

std::map<Pair, std::vector<Pair>> pairs_between_components(PairModels* pairs,
                                                           const ModelForest& forest) {
  std::map<Pair, std::vector<Pair>> result;
  for (const auto& [ij, record] : pairs->records())
    if (!forest.connected(ij.first, ij.second) && record.num_common > 0)
      result[std::minmax(forest.component(ij.first), forest.component(ij.second))].push_back(ij);
  return result;
}

std::optional<Candidate> chain_between(const Pair& ij, const std::vector<int>& signals,
                                       JointOrder order, PairModels* pairs, double* cost,
                                       bool may_be_coupled) {
  const auto [part_i, part_j] = ij;
  *cost = std::numeric_limits<double>::infinity();
  const PairData& pair = pairs->pair(part_i, part_j);
  const NormalizedActions& actions = pairs->actions();
  const int num_independent =
      actions.blocks().count(pair.frames, [](const PairFrame& frame) { return frame.sample; });
  if (num_independent < kPosesPerJoint * static_cast<int>(signals.size())) {
    pairs->record(part_i, part_j).note_undecided(static_cast<int>(signals.size()), 0);
    return std::nullopt;
  }
  const double sigma_rad = pairs->motions(part_i, part_j).sigma_rad;
  std::optional<Fit> fit = fit_long_chain(pair, actions, signals, order, sigma_rad);
  ++pairs->num_fits;
  if (!fit) return std::nullopt;
  fit = without_idle_joints(with_pure_slides(*std::move(fit), pair, actions), pair, actions);
  fit = with_settled_order(*std::move(fit), pair, actions);
  if ((order == JointOrder::kUnknown || may_be_coupled) && fit->cost > kRightCost * pair.size())
    fit = with_coupled_joints(*std::move(fit), pair, actions);
  std::optional<Candidate> chain = pairs->try_start(part_i, part_j, fit->model);
  *cost = pairs->last_cost();
  return chain;
}

bool shows_any_joint(const Pair& ij, PairModels* pairs) {
  constexpr double kClear = 10;
  const auto [part_i, part_j] = ij;
  return kLeastTurn / std::sqrt(3.0) * std::sqrt(pairs->pair(part_i, part_j).size()) >
         kClear * pairs->motions(part_i, part_j).sigma_rad;
}

bool add_chains(std::vector<Candidate> chains, PairModels* pairs, ModelForest* forest) {
  bool any = false;
  for (Candidate& c : chains) {
    if (forest->connected(c.part_i, c.part_j) || !pairs->confirm_on_all_data(&c) ||
        is_rather_soft(c, *pairs))
      continue;
    forest->add(c);
    any = true;
  }
  return any;
}

Candidate with_searched_order(const Candidate& chain, PairModels* pairs) {
  double cost = 0;
  const std::set<int> signals = signal_set(chain.model);
  auto searched = chain_between({chain.part_i, chain.part_j}, {signals.begin(), signals.end()},
                                JointOrder::kUnknown, pairs, &cost);
  return searched && rank(*searched) < rank(chain) ? *std::move(searched) : chain;
}

bool connect_long_chains(PairModels* pairs, ModelForest* forest) {
  const int max_joints = std::min(pairs->options().max_signals, kMaxChainJoints);
  if (max_joints <= kMaxScreenedJoints) return false;
  if (pairs->options().unknown_bias > 0 && pairs->actions().blocks().is_stream()) return false;
  const std::size_t num_components = forest->parts().size() - forest->models().size();
  if (num_components > kMaxChainedComponents) return false;
  const bool are_few = num_components <= kMaxSearched;
  const std::set<int> used = forest->used_signals();
  const std::vector<int>& moving = pairs->actions().moving();
  const std::vector<int> idle = without(moving, used);
  const bool is_extended = are_few && !forest->models().empty() && !idle.empty() &&
                           !pairs->actions().blocks().is_stream();
  const auto is_possible = [&](std::size_t m) {
    return static_cast<int>(m) > kMaxScreenedJoints && static_cast<int>(m) <= max_joints;
  };
  std::vector<Candidate> found;
  for (auto& [components, between] : pairs_between_components(pairs, *forest)) {
    std::stable_sort(between.begin(), between.end(), [&](const auto& x, const auto& y) {
      return pairs->record(x.first, x.second).num_common >
             pairs->record(y.first, y.second).num_common;
    });
    if (between.size() > kMaxPairs) between.resize(kMaxPairs);
    std::map<Pair, double> costs, ignored;
    std::optional<Candidate> chain;
    const bool may_extend = is_extended && is_possible(idle.size() + 1);
    if (is_possible(idle.size()) || may_extend)
      chain = best_chain(between, idle, are_few, pairs, &costs);
    if (chain && !is_possible(idle.size())) chain.reset();  // LayeredSearch has them
    if (!chain && may_extend)
      chain = best_extended(between, costs, idle, std::vector(used.begin(), used.end()), pairs);
    if (!chain && idle != moving && is_possible(moving.size()))
      chain = best_chain(between, moving, are_few, pairs, &ignored);
    if (chain) found.push_back(*std::move(chain));
  }
  std::stable_sort(found.begin(), found.end(), [](const Candidate& x, const Candidate& y) {
    return x.model.num_joints() < y.model.num_joints();
  });
  return add_chains(std::move(found), pairs, forest);
}

}  // namespace bodyschema
