#include "processes/structure_learner/soft_parts.h"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <limits>
#include <map>
#include <optional>
#include <set>
#include <tuple>

#include "common/estimation/chi_square.h"
#include "common/estimation/quantile.h"
#include "processes/structure_learner/long_chain/long_chain.h"
#include "processes/structure_learner/noise_estimate.h"
#include "processes/structure_learner/residual_fit.h"
#include "processes/structure_learner/screen.h"
#include "processes/structure_learner/search/look_alikes.h"

namespace bodyschema {
namespace {

constexpr int kMaxFrames = 600;
constexpr int kScreenFrames = 150;
constexpr std::size_t kPairsTried = 3;  // between two components

struct OpenPair {
  double cost;  // of the best screws, a frame
  int i, j;
  LocalModel screws;
};

int count_independent(const PairData& data, const NormalizedActions& actions) {
  return actions.blocks().count(data.frames, [](const PairFrame& f) { return f.sample; });
}

int count_independent(const OpenPair& open, const std::vector<ActionPoseSample>& samples,
                      const NormalizedActions& actions, const SearchOptions& options) {
  return count_independent(make_pair_data(samples, open.i, open.j, options.measurement, kMaxFrames),
                           actions);
}

// The screws that leave least: rigid, the best joint or the best two.
LocalModel best_screws(const PairData& pair, const NormalizedActions& actions, int max_signals,
                       SearchResult* counted) {
  std::vector<Start> starts{screen_rigid(pair, actions)};
  const RelativeMotions motions = relative_motions(pair, 300);
  if (max_signals >= 1) {
    const auto regressions = screen_one_joint(motions, actions);
    if (!regressions.empty())
      starts.push_back(one_joint_start(regressions[0], pair, actions, motions.sigma_rad));
  }
  if (max_signals >= 2) {
    const std::vector<std::vector<double>> turns(actions.num_signals(), default_turns());
    for (Start& s : screen_two_joints(pair, actions, motions, turns, 2))
      starts.push_back(std::move(s));
  }
  std::optional<Fit> best;
  double best_cost = 0;
  for (const Start& start : starts) {
    Fit fit = fit_local_model(start.model, pair, actions, 20, 1e-2);
    ++counted->num_fits;
    const double cost = fit.cost + 6 * fit.model.num_joints() * std::log(6.0 * pair.size());
    if (best && cost >= best_cost) continue;
    best_cost = cost;
    best = std::move(fit);
  }
  return best->model;
}

// The pairs of two components by what the best screws leave of them, least first.
void rank_pairs(const std::vector<ActionPoseSample>& samples, const NormalizedActions& actions,
                const SearchOptions& options, std::vector<OpenPair>* pairs, SearchResult* found) {
  for (OpenPair& o : *pairs) {
    const PairData data = make_pair_data(samples, o.i, o.j, options.measurement, kScreenFrames);
    if (count_independent(data, actions) < kFewestSoftFrames) {
      o.cost = std::numeric_limits<double>::infinity();
      continue;
    }
    o.screws = best_screws(data, actions, options.max_signals, found);
    o.cost = evaluate(o.screws, data, actions).cost / data.size();
  }
  std::stable_sort(pairs->begin(), pairs->end(),
                   [](const OpenPair& x, const OpenPair& y) { return x.cost < y.cost; });
}

// On a rigid base, and on the best screws if these are more.
std::optional<SoftFit> best_soft_fit(const OpenPair& open,
                                     const std::vector<ActionPoseSample>& samples,
                                     const NormalizedActions& actions, const SearchOptions& options,
                                     SearchResult* found) {
  const PairData data = make_pair_data(samples, open.i, open.j, options.measurement, kMaxFrames);
  std::optional<SoftFit> best;
  std::vector<LocalModel> bases{screen_rigid(data, actions).model};
  if (open.screws.num_joints() > 0) bases.push_back(open.screws);
  for (const LocalModel& base : bases) {
    const auto fit = fit_soft_model(fit_local_model(base, data, actions, 30, 1e-3).model, data,
                                    actions, options.validity);
    ++found->num_fits;
    found->records[{open.i, open.j}].was_soft_tried |= fit.has_value();
    if (fit && (!best || fit->log_density > best->log_density)) best = fit;
  }
  return best;
}

// A chain of the process's own signals leaves as little, and as little as a right one does, but has
// joints that do not pay by themselves: they move too little.
bool is_rather_a_chain(const SoftFit& soft, const OpenPair& open,
                       const std::vector<ActionPoseSample>& samples,
                       const NormalizedActions& actions, const SearchOptions& options) {
  std::vector<int> signals = soft.model.signals;
  std::ranges::sort(signals);
  const PairData data = make_pair_data(samples, open.i, open.j, options.measurement, kMaxFrames);
  const auto chain = fit_long_chain(data, actions, signals, JointOrder::kListed,
                                    relative_motions(data, 300).sigma_rad);
  if (!chain || chain->cost >= kRightCost * data.size()) return false;
  return log_density_of_screws(*chain, data, actions) > soft.log_density &&
         without_idle_joints(*chain, data, actions).model.num_joints() <
             static_cast<int>(signals.size());
}

// Log density a frame of what the screws leave, with the noise that suits them best.
double density_of_screws(const OpenPair& open, const std::vector<ActionPoseSample>& samples,
                         const NormalizedActions& actions, const SearchOptions& options) {
  const PairData data = make_pair_data(samples, open.i, open.j, options.measurement, kMaxFrames);
  const Fit screws = fit_local_model(open.screws, data, actions, 15, 1e-2);
  return log_density_of_screws(screws, data, actions) / count_independent(data, actions);
}

// Three coordinates of position and three of rotation gain the log of what their deviations are
// smaller by where these are at most kExplained of others.
const double kFarLess = -3 * std::log(kExplained);

// A process leaves far less than screws of such a density a frame.
bool pays(const SoftFit& soft, int num_independent, double density_of_screws) {
  return soft.log_density / num_independent > density_of_screws + kFarLess;
}

// Of two components: the largest density, and the signals of the fewest joints that leave not far
// more. A guess of the noise does not know how large a bias is: all that they leave may be one.
struct PlausibleScrews {
  double density = -std::numeric_limits<double>::infinity();
  std::set<int> signals = {};
};
PlausibleScrews plausible_screws(const std::vector<OpenPair>& pairs,
                                 const std::vector<ActionPoseSample>& samples,
                                 const NormalizedActions& actions, const SearchOptions& options,
                                 SearchResult* counted) {
  PlausibleScrews result;
  std::vector<std::pair<double, LocalModel>> judged;
  const auto judge = [&](const OpenPair& o) {
    judged.emplace_back(density_of_screws(o, samples, actions, options), o.screws);
    result.density = std::max(result.density, judged.back().first);
  };
  for (const OpenPair& o : pairs) {
    if (!std::isfinite(o.cost)) continue;
    judge(o);
    const PairData data = make_pair_data(samples, o.i, o.j, options.measurement, kScreenFrames);
    for (int k = 0; k < o.screws.num_joints(); ++k)
      judge({0, o.i, o.j, best_screws(data, actions, k, counted)});
  }
  const LocalModel* sparsest = nullptr;
  for (const auto& [density, screws] : judged)
    if (density + kFarLess >= result.density &&
        (!sparsest || screws.num_joints() < sparsest->num_joints()))
      sparsest = &screws;
  if (sparsest) result.signals = signal_set(*sparsest);
  return result;
}

// A process between two components.
struct SoftCandidate {
  AcceptedModel model;
  std::size_t num_needed = 0;  // signals that suffice between them: fewer first, as in the search
  bool is_contested = false;   // screws of other signals may be all there is
};

AcceptedModel to_accepted(const OpenPair& open, const SoftFit& soft) {
  return {open.i, open.j, soft.model.screws, soft.score, soft.model.signals, soft.doubtful_signals};
}

// Those of the pairs that screws explain best. Contested ones only where no other is.
std::vector<SoftCandidate> soft_candidates(std::vector<OpenPair> pairs,
                                           const std::vector<ActionPoseSample>& samples,
                                           const NormalizedActions& actions,
                                           const SearchOptions& options, bool is_noise_guessed,
                                           SearchResult* found) {
  rank_pairs(samples, actions, options, &pairs, found);
  if (pairs.size() > kPairsTried) pairs.resize(kPairsTried);
  std::optional<PlausibleScrews> plausible;
  if (is_noise_guessed) plausible = plausible_screws(pairs, samples, actions, options, found);
  // In a stream, what passes for rigid moves so little that only a process tells how.
  if (plausible && plausible->signals.empty() && actions.blocks().is_stream()) plausible.reset();
  std::vector<SoftCandidate> result;
  for (const OpenPair& o : pairs) {
    if (!std::isfinite(o.cost)) continue;
    const std::optional<SoftFit> best = best_soft_fit(o, samples, actions, options, found);
    if (!best || best->verdict != Verdict::kValid) continue;
    if (is_rather_a_chain(*best, o, samples, actions, options)) {
      found->records[{o.i, o.j}].moves_little = true;
      continue;
    }
    SoftCandidate c{to_accepted(o, *best)};
    if (plausible) {
      const std::set<int> signals(best->model.signals.begin(), best->model.signals.end());
      c.num_needed = signals.size();
      c.is_contested =
          signals != plausible->signals &&
          !pays(*best, count_independent(o, samples, actions, options), plausible->density);
    }
    result.push_back(std::move(c));
  }
  const auto is_contested = [](const SoftCandidate& c) { return c.is_contested; };
  if (!std::ranges::all_of(result, is_contested)) {
    std::erase_if(result, is_contested);
    return result;
  }
  for (SoftCandidate& c : result) {
    c.num_needed = plausible->signals.size();
    found->records[{c.model.part_i, c.model.part_j}].contested =
        ContestedSignals{plausible->signals, c.model.soft_signals};
  }
  return result;
}

// The noise of a stream is guessed or claimed: screws may pass where a process on other signals
// leaves far less. Their models go, and the processes are candidates.
void withdraw_screws(const std::vector<ActionPoseSample>& samples, const NormalizedActions& actions,
                     const SearchOptions& options, SearchResult* found,
                     std::vector<SoftCandidate>* candidates) {
  std::erase_if(found->models, [&](const AcceptedModel& m) {
    if (!m.soft_signals.empty()) return false;
    const auto soft =
        best_soft_fit({0, m.part_i, m.part_j, m.model}, samples, actions, options, found);
    if (!soft || soft->verdict != Verdict::kValid) return false;
    const std::set<int> signals(soft->model.signals.begin(), soft->model.signals.end());
    if (signals == signal_set(m.model)) return false;
    const OpenPair open{0, m.part_i, m.part_j, m.model};
    if (!pays(*soft, count_independent(open, samples, actions, options),
              density_of_screws(open, samples, actions, options)))
      return false;
    candidates->push_back({to_accepted(open, *soft)});
    std::erase(found->redundant, std::pair(m.part_i, m.part_j));
    found->records[{m.part_i, m.part_j}].is_redundant = false;
    found->gave_way = true;
    return true;
  });
}

}  // namespace

void connect_soft_parts(const std::vector<ActionPoseSample>& samples,
                        const NormalizedActions& actions, const std::vector<int>& parts,
                        const SearchOptions& options, bool is_noise_guessed, SearchResult* found) {
  const bool is_stream = actions.blocks().is_stream();
  std::vector<SoftCandidate> candidates;
  if (is_stream) withdraw_screws(samples, actions, options, found, &candidates);
  Components components(parts);
  for (const AcceptedModel& m : found->models) components.join(m.part_i, m.part_j);
  std::map<std::pair<int, int>, std::vector<OpenPair>> open;  // by the two components
  std::set<std::pair<int, int>> undecided;
  for (const auto& [pair, record] : found->records) {
    const int a = components.of(pair.first), b = components.of(pair.second);
    if (a == b) continue;
    // What screws need more data for is no reason to wait where they give way to a process anyway.
    if (!record.undecided.empty() && !is_stream) undecided.insert(std::minmax(a, b));
    if (record.num_common >= kFewestSoftFrames)
      open[std::minmax(a, b)].push_back({0, pair.first, pair.second, {}});
  }
  for (auto& [between, pairs] : open)
    if (!undecided.contains(between))
      std::ranges::move(
          soft_candidates(std::move(pairs), samples, actions, options, is_noise_guessed, found),
          std::back_inserter(candidates));
  const auto rank = [](const SoftCandidate& c) {
    return std::tuple(c.num_needed, -c.model.score, c.model.part_i, c.model.part_j);
  };
  std::ranges::stable_sort(candidates, {}, rank);
  // Nor does a process tell in which order joints follow one another.
  std::set<int> open_order;
  for (const auto& [pair, record] : found->records)
    open_order.insert(record.open_order.begin(), record.open_order.end());
  // Screws may be all that is between two parts: a process on the way around them is none either.
  for (SoftCandidate& c : candidates) {
    if (!components.join(c.model.part_i, c.model.part_j) || c.is_contested) continue;
    std::set<int> signals = signal_set(c.model.model);
    signals.insert(c.model.soft_signals.begin(), c.model.soft_signals.end());
    if (std::ranges::any_of(signals, [&](int s) { return open_order.contains(s); })) continue;
    const auto alike = look_alikes_of(c.model, actions);
    if (alike.empty())
      found->models.push_back(std::move(c.model));
    else
      found->records[{c.model.part_i, c.model.part_j}].look_alikes = alike;
  }
}

}  // namespace bodyschema
