#include "processes/console/views/reach_view.h"

#include <fmt/format.h>

#include <vector>

#include "common/geometry/angle.h"
#include "common/schema/standard_deviations.h"
#include "common/text/text.h"
#include "processes/console/views/prediction_view.h"
#include "processes/console/views/structure_view.h"

namespace bodyschema {
namespace {

constexpr double kAtLimit = 1e-9;  // of a range

// Signals that move the part and are at an end of their range.
std::vector<int> at_limits(const BodySchema& schema, int part, const Eigen::VectorXd& action) {
  std::vector<int> result;
  for (const int s : moving_signals(schema, part)) {
    const Signal& signal = schema.signals[static_cast<std::size_t>(s)];
    const double margin = kAtLimit * (signal.upper - signal.lower);
    if (action(s) <= signal.lower + margin || action(s) >= signal.upper - margin)
      result.push_back(s);
  }
  return result;
}

}  // namespace

Reach reach_of(const BodySchema& schema, int part, const PoseTarget& target,
               const Eigen::VectorXd& start) {
  Reach reach;
  reach.part = part;
  reach.has_orientation = target.q_RT.has_value();
  reach.solution =
      solve_pose(schema, part, target, schema.signals, start, kThoroughInverseKinematics);
  const Eigen::VectorXd& action = reach.solution.action;
  if (const auto predicted = schema.predict(schema.root, part, action, Variance::kOneAction))
    reach.sd = deviations_of(predicted->covariance);
  if (reach.solution.is_within_tolerance) {
    reach.why = "reached";
    if (const auto beyond = signals_outside(schema, action, part); !beyond.empty())
      reach.why +=
          ", but beyond what the samples covered of " + listed(signal_names(schema, beyond));
    return reach;
  }
  const std::vector<int> limits = at_limits(schema, part, action);
  reach.why = fmt::format("out of reach; this is the nearest of {} starts",
                          kThoroughInverseKinematics.max_starts);
  if (!limits.empty()) reach.why += ", at the limits of " + listed(signal_names(schema, limits));
  return reach;
}

Json reach_json(const BodySchema& schema, const Reach& reach) {
  return {{"reached", reach.solution.is_within_tolerance},
          {"why", reach.why},
          {"action", action_json(schema, reach.solution.action)},
          {"position_error_m", reach.solution.error_m},
          {"rotation_error_deg",
           reach.has_orientation ? Json(reach.solution.error_rad / kDegree) : Json()},
          {"position_sd_m", deviation_json(reach.sd.position_m)},
          {"rotation_sd_deg", deviation_json(reach.sd.rotation_rad, kDegree)}};
}

std::string reach_text(const BodySchema& schema, const Reach& reach) {
  std::string text = fmt::format("Part {}: {}; off by {:.2f} mm", reach.part, reach.why,
                                 1e3 * reach.solution.error_m);
  if (reach.has_orientation) text += fmt::format(", {:.3f}°", reach.solution.error_rad / kDegree);
  if (reach.sd.position_m > 0)
    text += fmt::format("; known to {:.2f} mm, {:.3f}° per axis", 1e3 * reach.sd.position_m,
                        reach.sd.rotation_rad / kDegree);
  text += "\n";
  for (std::size_t s = 0; s < schema.signals.size(); ++s)
    text += fmt::format("  {:<12} {:.6g}\n", schema.signals[s].name,
                        reach.solution.action(static_cast<Eigen::Index>(s)));
  return text;
}

}  // namespace bodyschema
