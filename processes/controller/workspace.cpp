#include "processes/controller/workspace.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <set>
#include <utility>

namespace bodyschema {
namespace {

constexpr double kStep = 0.01;    // of a range
constexpr double kLook_m = 5e-3;  // that the origin of a part moves between two looks
constexpr int kMaxHalvings = 8;   // of a step

Eigen::AlignedBox3d box_of(const Yaml& yaml) {
  const Eigen::AlignedBox3d box(yaml.vector3("lowest"), yaml.vector3("highest"));
  if (box.isEmpty()) throw yaml.error("highest", "expected nothing below lowest");
  return box;
}

using PartPoses = std::map<int, Pose>;  // in R

/// Parts that are where they may not be.
std::set<int> trespassers(const Workspace& workspace, const BodySchema& schema,
                          const PartPoses& poses) {
  std::set<int> parts;
  for (const auto& [part, X_RB] : poses) {
    const auto holds = [p = X_RB.translation()](const auto& box) { return box.contains(p); };
    const bool is_outside = !workspace.within.isEmpty() && !holds(workspace.within);
    if (part != schema.root && (is_outside || std::ranges::any_of(workspace.keep_out, holds)))
      parts.insert(part);
  }
  return parts;
}

double farthest_move_m(const PartPoses& from, const PartPoses& to) {
  double farthest = 0;
  for (const auto& [part, X_RB] : to)
    farthest = std::max(farthest, (X_RB.translation() - from.at(part).translation()).norm());
  return farthest;
}

}  // namespace

Workspace Workspace::load(const Yaml& yaml) {
  Workspace workspace;
  workspace.within = box_of(yaml);
  if (yaml.has("keep_out"))
    for (const Yaml& box : yaml.list("keep_out")) workspace.keep_out.push_back(box_of(box));
  return workspace;
}

std::string Workspace::objection(const BodySchema& schema, const Eigen::VectorXd& from,
                                 const Eigen::VectorXd& to) const {
  if (within.isEmpty() && keep_out.empty()) return "";
  double longest = 0;
  for (Eigen::Index s = 0; s < to.size(); ++s) {
    const Signal& signal = schema.signals[static_cast<std::size_t>(s)];
    const double range = signal.upper - signal.lower;
    if (range > 0) longest = std::max(longest, std::abs(to[s] - from[s]) / range);
  }
  const int num_steps = std::max(1, static_cast<int>(std::ceil(longest / kStep)));
  const auto poses_at = [&](double share) -> PartPoses {
    return schema.predict_all(from + (to - from) * share);
  };
  PartPoses poses = poses_at(0);
  const std::set<int> before = trespassers(*this, schema, poses);
  const double longest_step = 1.0 / num_steps;
  for (double share = 0; share < 1;) {
    double step = std::min(longest_step, 1 - share);
    PartPoses next = poses_at(share + step);
    for (int n = 0; n < kMaxHalvings && farthest_move_m(poses, next) > kLook_m; ++n)
      next = poses_at(share + (step /= 2));
    for (const int part : trespassers(*this, schema, next))
      if (!before.contains(part))
        return "part " + std::to_string(part) + " would leave the workspace";
    share += step;
    poses = std::move(next);
  }
  return "";
}

}  // namespace bodyschema
