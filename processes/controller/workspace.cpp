#include "processes/controller/workspace.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <utility>

namespace bodyschema {
namespace {

constexpr double kStep = 0.01;    // of a range
constexpr double kLook_m = 5e-3;  // that the origin of a part moves between two looks
constexpr double kDeeper_m = 1e-6;
constexpr int kMaxHalvings = 8;  // of a step

Eigen::AlignedBox3d box_of(const Yaml& yaml) {
  const Eigen::AlignedBox3d box(yaml.vector3("lowest"), yaml.vector3("highest"));
  if (box.isEmpty()) throw yaml.error("highest", "expected nothing below lowest");
  return box;
}

using PartPoses = std::map<int, Pose>;  // in R

/// How deep a point is where it may not be, by box: outside `within` (0), in keep_out[n − 1] (n)
/// [m].
std::map<std::size_t, double> depths_at(const Workspace& workspace, const Eigen::Vector3d& p) {
  std::map<std::size_t, double> depths;
  if (!workspace.within.isEmpty() && !workspace.within.contains(p))
    depths[0] = workspace.within.exteriorDistance(p);
  for (std::size_t n = 0; n < workspace.keep_out.size(); ++n) {
    const Eigen::AlignedBox3d& box = workspace.keep_out[n];
    if (box.contains(p))
      depths[n + 1] = std::min((p - box.min()).minCoeff(), (box.max() - p).minCoeff());
  }
  return depths;
}

using Depths = std::map<std::pair<int, std::size_t>, double>;  // by part and box

Depths depths_of(const Workspace& workspace, const BodySchema& schema, const PartPoses& poses) {
  Depths result;
  for (const auto& [part, X_RB] : poses) {
    if (part == schema.root) continue;
    for (const auto& [box, depth] : depths_at(workspace, X_RB.translation()))
      result[{part, box}] = depth;
  }
  return result;
}

std::string in_box(std::size_t box) {
  return box == 0 ? "outside the workspace" : "in keep_out box " + std::to_string(box);
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

std::string Workspace::objection(const Eigen::Vector3d& p_RT) const {
  const auto depths = depths_at(*this, p_RT);
  return depths.empty() ? "" : "the target is " + in_box(depths.begin()->first);
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
  // A part that is where it may not be may go no deeper, and once out not in again.
  Depths allowed = depths_of(*this, schema, poses);
  const double longest_step = 1.0 / num_steps;
  for (double share = 0; share < 1;) {
    double step = std::min(longest_step, 1 - share);
    PartPoses next = poses_at(share + step);
    for (int n = 0; n < kMaxHalvings && farthest_move_m(poses, next) > kLook_m; ++n)
      next = poses_at(share + (step /= 2));
    const Depths depths = depths_of(*this, schema, next);
    for (const auto& [where, depth] : depths)
      if (!allowed.contains(where) || depth > allowed.at(where) + kDeeper_m)
        return "part " + std::to_string(where.first) + " would be " + in_box(where.second);
    std::erase_if(allowed, [&](const auto& entry) { return !depths.contains(entry.first); });
    share += step;
    poses = std::move(next);
  }
  return "";
}

}  // namespace bodyschema
