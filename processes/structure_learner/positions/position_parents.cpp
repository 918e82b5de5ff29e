#include "processes/structure_learner/positions/position_parents.h"

#include <algorithm>
#include <functional>
#include <iterator>
#include <map>
#include <numeric>
#include <utility>

#include "processes/structure_learner/long_chain/coupled_joints.h"
#include "processes/structure_learner/positions/position_screen.h"
#include "processes/structure_learner/search/model_forest.h"

namespace bodyschema {
namespace {

/// Starts that are fitted: of two signals at one parent, and in all for a number of joints.
constexpr int kFitsOfSignals = 4;
constexpr std::size_t kMaxFits = 32;
/// Mean robust cost of a frame beyond which a local fit does not mend a start (positions, below the
/// 26 of poses in the share of their residuals).
constexpr double kMaxStartCost = 20;
/// Joints of a chain up to which one of its signals may move one more.
constexpr int kMostRepeated = 4;
/// Parents below which a chain is looked for, those seen most often with the leaf.
constexpr std::size_t kMaxChainParents = 3;

}  // namespace

std::vector<int> parts_with_rotation(const std::vector<ActionPoseSample>& samples) {
  const std::vector<int> all = seen_parts(samples), alone = parts_without_rotation(samples);
  std::vector<int> parts;
  std::set_difference(all.begin(), all.end(), alone.begin(), alone.end(),
                      std::back_inserter(parts));
  return parts;
}

PositionParents::PositionParents(const std::vector<ActionPoseSample>& samples,
                                 const NormalizedActions& actions, int root,
                                 const std::set<int>& resting, const MeasurementModel& measurement)
    : samples_(samples), measurement_(measurement) {
  if (!resting.empty()) at_rest_ = resting.contains(root) ? root : *resting.begin();
  for (const int part : parts_with_rotation(samples))
    if (part == at_rest_ || !resting.contains(part)) parts_.push_back(part);
  if (at_rest_ < 0) return;
  const PairData seen = make_part_data(samples, at_rest_, measurement, kMaxPositionFrames);
  X_at_rest_ =
      fit_local_model(screen_rigid(seen, actions).model, seen, actions, 20, 1e-6).model.first;
}

std::vector<StartAt> starts_of(const std::vector<PairData>& pairs, const NormalizedActions& actions,
                               int num_joints, int* num_screens) {
  std::vector<StartAt> starts;
  for (std::size_t p = 0; p < pairs.size(); ++p)
    for (Start& start : position_starts(pairs[p], actions, num_joints, num_screens))
      if (start.score < kMaxStartCost) starts.push_back({p, std::move(start)});
  std::stable_sort(starts.begin(), starts.end(), [](const StartAt& x, const StartAt& y) {
    return x.start.score < y.start.score;
  });
  std::map<std::pair<std::size_t, std::set<int>>, int> taken;
  std::erase_if(starts, [&](const StartAt& s) {
    return ++taken[{s.parent, signal_set(s.start.model)}] > kFitsOfSignals;
  });
  starts.resize(std::min(starts.size(), kMaxFits));
  return starts;
}

std::vector<std::size_t> most_often_seen(const std::vector<PairData>& pairs) {
  std::vector<std::size_t> result(pairs.size());
  std::iota(result.begin(), result.end(), 0);
  std::ranges::stable_sort(result, std::greater(), [&](std::size_t p) { return pairs[p].size(); });
  result.resize(std::min(result.size(), kMaxChainParents));
  return result;
}

JointOrder order_of_chains(const PositionParents& parents, const NormalizedActions& actions) {
  const bool is_searched = parents.parts().size() == 1 && !actions.blocks().is_stream();
  return is_searched ? JointOrder::kUnknown : JointOrder::kListed;
}

std::optional<Fit> fit_position_chain(const PairData& pair, const NormalizedActions& actions,
                                      const std::vector<int>& signals, JointOrder order,
                                      double noise_m) {
  const int m = static_cast<int>(signals.size());
  const int num_independent =
      actions.blocks().count(pair.frames, [](const PairFrame& frame) { return frame.sample; });
  if (num_independent < kPositionsPerJoint * m) return std::nullopt;
  std::optional<Fit> fit = fit_long_chain(pair, actions, signals, order, noise_m);
  if (!fit) return fit;
  fit = without_idle_joints(with_pure_slides(*std::move(fit), pair, actions), pair, actions);
  if (fit->model.num_joints() <= kMostRepeated)
    fit = with_repeated_signal(*std::move(fit), pair, actions);
  return fit;
}

}  // namespace bodyschema
