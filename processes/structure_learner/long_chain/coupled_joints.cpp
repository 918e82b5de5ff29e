#include "processes/structure_learner/long_chain/coupled_joints.h"

#include <algorithm>
#include <cmath>
#include <optional>
#include <utility>
#include <vector>

#include "processes/structure_learner/long_chain/long_chain.h"
#include "processes/structure_learner/search/model_forest.h"

namespace bodyschema {
namespace {

constexpr int kMostCoupled = 2;
constexpr int kFewIterations = 6, kFitIterations = 60;
constexpr std::size_t kFitted = 3;  // of the best starts

/// With a joint of `signal` about the axis of joint d, next to it, that does not move yet.
LocalModel with_coupling(const LocalModel& model, int d, int signal) {
  LocalModel result = model;
  LocalModel::Joint joint = model.joints[static_cast<std::size_t>(d)];
  joint.signal = signal;
  joint.turn = joint.slide = 0;
  result.joints[static_cast<std::size_t>(d)].X_after = Pose::Identity();
  result.joints.insert(result.joints.begin() + d + 1, joint);
  return result;
}

std::optional<Fit> with_best_coupling(const LocalModel& model, const PairData& pair,
                                      const NormalizedActions& actions) {
  std::vector<Fit> starts;
  for (int d = 0; d < model.num_joints(); ++d)
    for (const int signal : signal_set(model)) {
      if (model.joints[static_cast<std::size_t>(d)].signal == signal) continue;
      starts.push_back(
          fit_local_model(with_coupling(model, d, signal), pair, actions, kFewIterations, 1e-2));
    }
  std::ranges::stable_sort(starts, {}, &Fit::cost);
  if (starts.size() > kFitted) starts.resize(kFitted);
  std::optional<Fit> best;
  for (const Fit& start : starts) {
    Fit fit = fit_local_model(start.model, pair, actions, kFitIterations, 1e-2);
    if (!best || fit.cost < best->cost) best = std::move(fit);
  }
  return best;
}

}  // namespace

Fit with_coupled_joints(Fit fit, const PairData& pair, const NormalizedActions& actions) {
  for (int n = 0; n < kMostCoupled; ++n) {
    std::optional<Fit> coupled = with_best_coupling(fit.model, pair, actions);
    if (!coupled || fit.cost - coupled->cost < price_of_joint(pair)) break;
    fit = *std::move(coupled);
  }
  return fit;
}

}  // namespace bodyschema
