#include "processes/structure_learner/search/redundancy.h"

#include <algorithm>
#include <map>
#include <optional>
#include <set>
#include <utility>
#include <vector>

#include "common/geometry/pose.h"
#include "processes/structure_learner/noise_estimate.h"
#include "processes/structure_learner/search/component_tree.h"

namespace bodyschema {
namespace {

// d² of one sight.
constexpr double kNoiseOfOneSight = 6;
// Of the mean squares of the motions of two joints of one signal: their gains may differ fourfold
// (RandomTreeOptions), droop of 3° is a twentieth of what a joint of 60° moves.
constexpr double kCoupling = 1.0 / 36;

using Nodes = std::vector<TreeNode>;

enum class MotionOf { kPose, kRotation };

// d² of a motion as large as an error of one sight may be: by its noise, but of a noise that is
// told to be louder than any marker's no systematic error need be as large.
double squared_size(Vector6d moved, const PairHypothesis& sight, MotionOf of = MotionOf::kPose) {
  if (of == MotionOf::kRotation) moved.head<3>().setZero();
  double of_errors = (moved.head<3>() / kLoudestMarker.position_m).squaredNorm();
  if (sight.num_residuals == 6)
    of_errors += (moved.tail<3>() / kLoudestMarker.rotation_rad).squaredNorm();
  return std::max((sight.whitening * moved).squaredNorm(), of_errors);
}

bool is_below(const Nodes& nodes, int node, int ancestor) {
  for (; node >= 0; node = nodes[node].parent)
    if (node == ancestor) return true;
  return false;
}

// Pose of a node in the tree's root and ∂/∂q of the signal, right perturbation.
struct Motion {
  Pose X = Pose::Identity();
  Vector6d by_signal = Vector6d::Zero();
};
Motion motion_of(const Nodes& nodes, int node, int signal, const NormalizedActions& actions,
                 int sample) {
  if (nodes[node].parent < 0) return {};
  Motion motion = motion_of(nodes, nodes[node].parent, signal, actions, sample);
  const LocalModel& model = nodes[node].model;
  const Pose X = model.predict(actions, sample);
  motion.X = motion.X * X;
  motion.by_signal = adjoint(X.inverse()) * motion.by_signal;
  if (!model.uses(signal)) return motion;
  const MotionJacobian J = motion_jacobian(model, actions, sample);
  for (int d = 0; d < model.num_joints(); ++d)
    if (model.joints[d].signal == signal) motion.by_signal += J.col(d);
  return motion;
}

// Mean square, over the frames of both, of how far the signal moves one node against the other,
// in the noise of one sight (squared_size()).
std::optional<double> mean_square_motion(const Nodes& nodes, int a, int b, int signal,
                                         PairModels* pairs, MotionOf of = MotionOf::kPose) {
  if (nodes[a].part > nodes[b].part) std::swap(a, b);
  const PairData& pair = pairs->pair(nodes[a].part, nodes[b].part);
  if (pair.size() == 0) return std::nullopt;
  const NormalizedActions& actions = pairs->actions();
  double sum = 0;
  for (int t = 0; t < pair.size(); ++t) {
    const int sample = pair.frames[t].sample;
    const Motion of_a = motion_of(nodes, a, signal, actions, sample);
    const Motion of_b = motion_of(nodes, b, signal, actions, sample);
    const Pose X_ba = of_b.X.inverse() * of_a.X;
    const Vector6d moved =
        (of_b.by_signal - adjoint(X_ba) * of_a.by_signal) * actions(sample, signal);
    sum += squared_size(moved, pair.primary(t), of);
  }
  return sum / pair.size();
}

// How many signals beside this one move node b against node a.
int num_others_between(const Nodes& nodes, int a, int b, int signal, PairModels* pairs) {
  int count = 0;
  for (const int other : pairs->actions().moving()) {
    if (other == signal) continue;
    const auto moved = mean_square_motion(nodes, a, b, other, pairs);
    count += !moved || *moved >= kNoiseOfOneSight;
  }
  return count;
}

// A node whose edge to its parent has a joint that it does not need, for the parts at the far ends
// of it and of another edge with that joint move with its signal by less than `least`: an edge of
// fewer joints would do between these.
struct Detour {
  int node = 0, signal = 0;
};
template <typename Least>
std::optional<Detour> find_detour(const Nodes& nodes, PairModels* pairs, Least&& least) {
  const int n = static_cast<int>(nodes.size());
  for (const int signal : pairs->actions().moving())
    for (int k = 1; k < n; ++k)
      for (int l = k + 1; l < n; ++l) {
        if (!nodes[k].model.uses(signal) || !nodes[l].model.uses(signal)) continue;
        const int far = is_below(nodes, l, k) ? nodes[k].parent : k;
        const auto moved = mean_square_motion(nodes, far, l, signal, pairs);
        if (!moved || *moved >= least(signal)) continue;
        const int larger = nodes[k].model.num_joints() > nodes[l].model.num_joints() ? k : l;
        if (num_others_between(nodes, far, l, signal, pairs) < nodes[larger].model.num_joints())
          return Detour{larger, signal};
      }
  return std::nullopt;
}

// Whether a signal moves the position of node b against a by more than a marker of another size
// than is told explains: at a distance d from the camera it stands off by a share of d, which the
// turn of a moves, and moves by the same share too far.
bool moves_apart(const Nodes& nodes, int a, int b, int signal, PairModels* pairs) {
  constexpr double kSizeError = 0.05;
  const NormalizedActions& actions = pairs->actions();
  const PairData seen = pairs->part_data(nodes[b].part);
  double apart = 0, explained = 0;
  for (int t = 0; t < seen.size(); ++t) {
    const int sample = seen.frames[t].sample;
    const Motion of_a = motion_of(nodes, a, signal, actions, sample);
    const Motion of_b = motion_of(nodes, b, signal, actions, sample);
    const Vector6d relative = of_b.by_signal - adjoint(of_b.X.inverse() * of_a.X) * of_a.by_signal;
    const double square = actions(sample, signal) * actions(sample, signal);
    apart += square * relative.head<3>().squaredNorm();
    explained += square * (of_b.by_signal.head<3>().squaredNorm() +
                           seen.primary(t).z.translation().squaredNorm() *
                               of_a.by_signal.tail<3>().squaredNorm());
  }
  return apart > kSizeError * kSizeError * explained;
}

// A node at the end of a chain of three or more joints that turn, while at most one signal turns it
// against another node or moves it as far as that: one joint between these would do. Positions that
// say otherwise are wrong in a way of their own, as by a marker of another size than is told.
std::optional<Detour> find_turned_alike(const Nodes& nodes, PairModels* pairs) {
  const auto turns = [&](int a, int b, int signal) {
    return mean_square_motion(nodes, a, b, signal, pairs, MotionOf::kRotation)
               .value_or(kNoiseOfOneSight) >= kNoiseOfOneSight;
  };
  const int n = static_cast<int>(nodes.size());
  for (int l = 1; l < n; ++l) {
    const std::set<int> signals = signal_set(nodes[l].model);
    if (signals.size() <= kMaxScreenedJoints ||
        !std::ranges::all_of(signals, [&](int s) { return turns(l, nodes[l].parent, s); }))
      continue;
    for (int k = 1; k < n; ++k)
      if (k != l && !is_below(nodes, k, l) &&
          std::ranges::count_if(pairs->actions().moving(), [&](int s) {
            return turns(k, l, s) || moves_apart(nodes, k, l, s, pairs);
          }) <= 1)
        return Detour{l, *signals.begin()};
  }
  return std::nullopt;
}

// Mean square of what a signal moves one end of a model against the other, whitened by the noise of
// one sight.
double mean_square_motion(const AcceptedModel& m, int signal, PairModels* pairs) {
  const PairData& pair = pairs->pair(m.part_i, m.part_j);
  double sum = 0;
  for (int t = 0; t < pair.size(); ++t) {
    const int sample = pair.frames[t].sample;
    const MotionJacobian J = motion_jacobian(m.model, pairs->actions(), sample);
    Vector6d moved = Vector6d::Zero();
    for (int d = 0; d < m.model.num_joints(); ++d)
      if (m.model.joints[d].signal == signal) moved += J.col(d);
    moved *= pairs->actions()(sample, signal);
    sum += squared_size(moved, pair.primary(t));
  }
  return sum / std::max(pair.size(), 1);
}

LocalModel without_joint(LocalModel model, int d) {
  model.transform(d) = model.transform(d) * model.joints[d].X_after;
  model.joints.erase(model.joints.begin() + d);
  return model;
}

// What a joint adds to a model: mean square of how far off its predictions are when all else adapts
// to do without it, in the noise of one sight (squared_size()).
double added_motion(const AcceptedModel& m, int joint, PairModels* pairs) {
  const PairData& pair = pairs->pair(m.part_i, m.part_j);
  const NormalizedActions& actions = pairs->actions();
  const LocalModel without =
      fit_local_model(without_joint(m.model, joint), pair, actions, 40, 1e-2).model;
  ++pairs->num_fits;
  double sum = 0;
  for (int t = 0; t < pair.size(); ++t) {
    const int sample = pair.frames[t].sample;
    const Vector6d off =
        log(without.predict(actions, sample).inverse() * m.model.predict(actions, sample));
    sum += squared_size(off, pair.primary(t));
  }
  return sum / std::max(pair.size(), 1);
}

}  // namespace

std::vector<Coupling> couplings(PairModels* pairs, const ModelForest& forest) {
  std::map<int, int> num_joints;
  std::map<int, double> largest;
  for (const AcceptedModel& m : forest.models()) {
    for (const LocalModel::Joint& joint : m.model.joints) ++num_joints[joint.signal];
    for (const int signal : signal_set(m.model)) {
      double& most = largest[signal];
      most = std::max(most, mean_square_motion(m, signal, pairs));
    }
  }
  std::vector<Coupling> result;
  for (const AcceptedModel& m : forest.models())
    for (int d = 0; d < m.model.num_joints(); ++d) {
      const int signal = m.model.joints[d].signal;
      if (num_joints[signal] < 2) continue;
      const double added = added_motion(m, d, pairs);
      if (added >= kCoupling * largest[signal]) continue;
      const bool is_needless = added < kNoiseOfOneSight;
      if (is_needless) pairs->record(m.part_i, m.part_j).is_redundant = true;
      result.push_back({m.part_i, m.part_j, signal, is_needless});
    }
  for (const int part : forest.parts()) {
    if (forest.component(part) != part) continue;
    const ComponentTree tree(forest, part, pairs);
    const auto detour = find_detour(tree.nodes(), pairs,
                                    [&](int signal) { return kCoupling * largest.at(signal); });
    if (!detour) continue;
    const AcceptedModel& m = forest.models()[static_cast<std::size_t>(tree.model_of(detour->node))];
    result.push_back({m.part_i, m.part_j, detour->signal});
  }
  return result;
}

std::vector<std::pair<int, int>> redundant_edges(PairModels* pairs, ModelForest forest) {
  std::vector<std::pair<int, int>> result;
  const std::vector<int> parts = forest.parts();
  for (std::size_t p = 0; p < parts.size();) {
    std::optional<int> model;
    if (forest.component(parts[p]) == parts[p]) {
      const ComponentTree tree(forest, parts[p], pairs);
      auto detour =
          find_detour(tree.nodes(), pairs, [](int /*signal*/) { return kNoiseOfOneSight; });
      if (!detour) detour = find_turned_alike(tree.nodes(), pairs);
      if (detour) model = tree.model_of(detour->node);
    }
    if (!model) {
      ++p;
      continue;
    }
    std::vector<AcceptedModel> models = forest.models();
    const auto m = models.begin() + *model;
    pairs->record(m->part_i, m->part_j).is_redundant = true;
    result.emplace_back(m->part_i, m->part_j);
    models.erase(m);
    forest.set_models(std::move(models));
  }
  return result;
}

}  // namespace bodyschema
