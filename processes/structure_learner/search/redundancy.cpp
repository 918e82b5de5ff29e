#include "processes/structure_learner/search/redundancy.h"

#include <algorithm>
#include <map>
#include <optional>
#include <utility>
#include <vector>

#include "common/geometry/pose.h"
#include "processes/structure_learner/search/component_tree.h"

namespace bodyschema {
namespace {

// d² of one sight.
constexpr double kNoiseOfOneSight = 6;
// Of the mean squares of the motions of two joints of one signal: their gains may differ fourfold
// (RandomTreeOptions), droop of 3° is a twentieth of what a joint of 60° moves.
constexpr double kCoupling = 1.0 / 36;

using Nodes = std::vector<TreeNode>;

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
// whitened by the noise of one sight.
std::optional<double> mean_square_motion(const Nodes& nodes, int a, int b, int signal,
                                         PairModels* pairs) {
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
    sum += (pair.primary(t).whitening * moved).squaredNorm();
  }
  return sum / pair.size();
}

// How many signals move node b against node a.
int num_joints_between(const Nodes& nodes, int a, int b, PairModels* pairs) {
  int count = 0;
  for (const int signal : pairs->actions().moving()) {
    const auto moved = mean_square_motion(nodes, a, b, signal, pairs);
    count += !moved || *moved >= kNoiseOfOneSight;
  }
  return count;
}

// A node whose edge to its parent has a joint that it does not need: an edge of fewer joints would
// do, between the far ends of it and of another edge with that joint.
std::optional<int> redundant_node(const Nodes& nodes, PairModels* pairs) {
  const int n = static_cast<int>(nodes.size());
  for (const int signal : pairs->actions().moving())
    for (int k = 1; k < n; ++k)
      for (int l = k + 1; l < n; ++l) {
        if (!nodes[k].model.uses(signal) || !nodes[l].model.uses(signal)) continue;
        const int far = is_below(nodes, l, k) ? nodes[k].parent : k;
        const auto moved = mean_square_motion(nodes, far, l, signal, pairs);
        if (!moved || *moved >= kNoiseOfOneSight) continue;
        const int larger = nodes[k].model.num_joints() > nodes[l].model.num_joints() ? k : l;
        if (num_joints_between(nodes, far, l, pairs) < nodes[larger].model.num_joints())
          return larger;
      }
  return std::nullopt;
}

// By joint of the model: mean square of what it moves over the frames, whitened by the noise of one
// sight.
std::vector<double> joint_motions(const AcceptedModel& m, PairModels* pairs) {
  const PairData& pair = pairs->pair(m.part_i, m.part_j);
  std::vector<double> result(static_cast<std::size_t>(m.model.num_joints()), 0);
  for (int t = 0; t < pair.size(); ++t) {
    const int sample = pair.frames[t].sample;
    const MotionJacobian J = motion_jacobian(m.model, pairs->actions(), sample);
    for (int d = 0; d < m.model.num_joints(); ++d) {
      const double q = pairs->actions()(sample, m.model.joints[d].signal);
      result[d] += (pair.primary(t).whitening * (q * J.col(d))).squaredNorm() / pair.size();
    }
  }
  return result;
}

}  // namespace

std::vector<Coupling> couplings(PairModels* pairs, const ModelForest& forest) {
  std::vector<std::pair<Coupling, double>> joints;
  std::map<int, double> largest;
  for (const AcceptedModel& m : forest.models()) {
    const std::vector<double> motions = joint_motions(m, pairs);
    for (int d = 0; d < m.model.num_joints(); ++d) {
      const int signal = m.model.joints[d].signal;
      joints.emplace_back(Coupling{m.part_i, m.part_j, signal}, motions[d]);
      largest[signal] = std::max(largest[signal], motions[d]);
    }
  }
  std::vector<Coupling> result;
  for (const auto& [joint, motion] : joints)
    if (motion < kCoupling * largest[joint.signal]) result.push_back(joint);
  return result;
}

std::vector<std::pair<int, int>> redundant_edges(PairModels* pairs, ModelForest forest) {
  std::vector<std::pair<int, int>> result;
  const std::vector<int> parts = forest.parts();
  for (std::size_t p = 0; p < parts.size();) {
    std::optional<int> model;
    if (forest.component(parts[p]) == parts[p]) {
      const ComponentTree tree(forest, parts[p], pairs);
      if (const auto node = redundant_node(tree.nodes(), pairs)) model = tree.model_of(*node);
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
