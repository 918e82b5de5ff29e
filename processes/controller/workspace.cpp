#include "processes/controller/workspace.h"

#include <algorithm>
#include <cmath>
#include <set>

namespace bodyschema {
namespace {

constexpr double kStep = 0.01;  // of a range

Eigen::AlignedBox3d box_of(const Yaml& yaml) {
  const Eigen::AlignedBox3d box(yaml.vector3("lowest"), yaml.vector3("highest"));
  if (box.isEmpty()) throw yaml.error("highest", "expected nothing below lowest");
  return box;
}

/// Parts that are where they may not be.
std::set<int> trespassers(const Workspace& workspace, const BodySchema& schema,
                          const Eigen::VectorXd& action) {
  std::set<int> parts;
  for (const auto& [part, X_RB] : schema.predict_all(action)) {
    const auto holds = [p = X_RB.translation()](const auto& box) { return box.contains(p); };
    const bool is_outside = !workspace.within.isEmpty() && !holds(workspace.within);
    if (part != schema.root && (is_outside || std::ranges::any_of(workspace.keep_out, holds)))
      parts.insert(part);
  }
  return parts;
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
  const std::set<int> before = trespassers(*this, schema, from);
  for (int n = 1; n <= num_steps; ++n) {
    const Eigen::VectorXd action = from + (to - from) * (static_cast<double>(n) / num_steps);
    for (const int part : trespassers(*this, schema, action))
      if (!before.contains(part))
        return "part " + std::to_string(part) + " would leave the workspace";
  }
  return "";
}

}  // namespace bodyschema
