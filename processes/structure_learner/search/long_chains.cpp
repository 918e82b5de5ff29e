#include "processes/structure_learner/search/long_chains.h"

#include <algorithm>
#include <tuple>

#include "processes/structure_learner/long_chain/long_chain.h"
#include "processes/structure_learner/residual_fit.h"
#include "processes/structure_learner/screen.h"

namespace bodyschema {
namespace {

// Pairs of two components that are tried, those seen together most often first.
constexpr std::size_t kMaxPairs = 12;
// Components that lie apart. More gaps than kMaxComponents have another reason than hidden parts:
// the noise told, or soft parts. Beyond kMaxSearched no order of joints is searched for: what falls
// into many pieces is no arm that is seen at its ends, and each two of them would cost a second.
constexpr std::size_t kMaxComponents = 6, kMaxSearched = 3;

std::vector<int> without(const std::vector<int>& signals, const std::set<int>& used) {
  std::vector<int> result;
  std::copy_if(signals.begin(), signals.end(), std::back_inserter(result),
               [&](int s) { return !used.contains(s); });
  return result;
}

// A chain on some of the signals, valid by the pair's own data.
std::optional<Candidate> chain_between(int part_i, int part_j, const std::vector<int>& signals,
                                       JointOrder order, PairModels* pairs) {
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
  return pairs->try_start(part_i, part_j, fit->model);
}

std::optional<Candidate> best_chain(const std::vector<std::pair<int, int>>& between,
                                    const std::vector<int>& signals, bool are_few,
                                    PairModels* pairs) {
  // What moves as a stream is often soft: no order is searched for where none may fit.
  const bool is_searched = are_few && between.size() == 1 && !pairs->actions().blocks().is_stream();
  std::optional<Candidate> best;
  const auto rank = [](const Candidate& c) { return std::tuple(c.model.num_joints(), -c.score); };
  for (const auto& [i, j] : between) {
    std::optional<Candidate> found = chain_between(
        i, j, signals, is_searched ? JointOrder::kUnknown : JointOrder::kListed, pairs);
    if (found && (!best || rank(*found) < rank(*best))) best = std::move(found);
  }
  return best;
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

bool connect_long_chains(PairModels* pairs, ModelForest* forest) {
  const int max_joints = std::min(pairs->options().max_signals, kMaxChainJoints);
  if (max_joints <= kMaxScreenedJoints) return false;
  if (pairs->options().unknown_bias > 0 && pairs->actions().blocks().is_stream()) return false;
  const std::size_t num_components = forest->parts().size() - forest->models().size();
  if (num_components > kMaxComponents) return false;
  const bool are_few = num_components <= kMaxSearched;
  std::map<std::pair<int, int>, std::vector<std::pair<int, int>>> open;  // by components
  for (const auto& [ij, record] : pairs->records())
    if (!forest->connected(ij.first, ij.second) && record.num_common > 0)
      open[std::minmax(forest->component(ij.first), forest->component(ij.second))].push_back(ij);
  std::set<int> used;
  for (const AcceptedModel& m : forest->models()) used.merge(signal_set(m.model));
  const std::vector<int>& moving = pairs->actions().moving();
  const std::vector<int> idle = without(moving, used);
  std::vector<std::vector<int>> choices{idle};
  if (idle != moving) choices.push_back(moving);
  std::vector<Candidate> found;
  for (auto& [components, between] : open) {
    std::stable_sort(between.begin(), between.end(), [&](const auto& x, const auto& y) {
      return pairs->record(x.first, x.second).num_common >
             pairs->record(y.first, y.second).num_common;
    });
    if (between.size() > kMaxPairs) between.resize(kMaxPairs);
    for (const std::vector<int>& signals : choices) {
      const int m = static_cast<int>(signals.size());
      if (m <= kMaxScreenedJoints || m > max_joints) continue;
      if (const auto chain = best_chain(between, signals, are_few, pairs)) {
        found.push_back(*chain);
        break;
      }
    }
  }
  std::stable_sort(found.begin(), found.end(), [](const Candidate& x, const Candidate& y) {
    return x.model.num_joints() < y.model.num_joints();
  });
  bool any = false;
  for (Candidate& c : found) {
    if (forest->connected(c.part_i, c.part_j) || !pairs->confirm_on_all_data(&c) ||
        is_rather_soft(c, *pairs))
      continue;
    forest->add(c);
    any = true;
  }
  return any;
}

}  // namespace bodyschema
