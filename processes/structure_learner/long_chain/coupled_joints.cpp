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

/// With a joint of `signal` before joint d, or at the end, about an axis of its own that does not
/// move yet: z of `axes` as the frame there has it.
LocalModel with_joint(const LocalModel& model, int d, int signal, const Eigen::Matrix3d& axes) {
  LocalModel result = model;
  Pose turned = Pose::Identity();
  turned.linear() = axes;
  result.transform(d) = result.transform(d) * turned;
  result.joints.insert(result.joints.begin() + d,
                       LocalModel::Joint{.signal = signal, .X_after = turned.inverse()});
  return result;
}

std::optional<Fit> best_of(const std::vector<LocalModel>& models, const PairData& pair,
                           const NormalizedActions& actions) {
  std::vector<Fit> starts;
  for (const LocalModel& model : models)
    starts.push_back(fit_local_model(model, pair, actions, kFewIterations, 1e-2));
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
    std::vector<LocalModel> models;
    for (int d = 0; d < fit.model.num_joints(); ++d)
      for (const int signal : signal_set(fit.model))
        if (fit.model.joints[static_cast<std::size_t>(d)].signal != signal)
          models.push_back(with_coupling(fit.model, d, signal));
    std::optional<Fit> coupled = best_of(models, pair, actions);
    if (!coupled || fit.cost - coupled->cost < price_of_joint(pair)) break;
    fit = *std::move(coupled);
  }
  return fit;
}

Fit with_repeated_signal(Fit fit, const PairData& pair, const NormalizedActions& actions) {
  std::vector<LocalModel> models;
  for (int d = 0; d <= fit.model.num_joints(); ++d)
    for (const int signal : signal_set(fit.model))
      for (int axis = 0; axis < 3; ++axis) {
        Eigen::Matrix3d axes;
        for (int n = 0; n < 3; ++n) axes.col(n) = Eigen::Vector3d::Unit((axis + n + 1) % 3);
        models.push_back(with_joint(fit.model, d, signal, axes));
      }
  std::optional<Fit> repeated = best_of(models, pair, actions);
  return repeated && fit.cost - repeated->cost > price_of_joint(pair) ? *std::move(repeated) : fit;
}

}  // namespace bodyschema
