#include "processes/controller/trajectory.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <utility>

#include "common/geometry/angle.h"
#include "common/schema/standard_deviations.h"

namespace bodyschema {
namespace {

constexpr double kTurn_rad = 0.1;
constexpr std::size_t kMostSteps = 1'000'000;

/// Without `from`.
std::vector<PoseTarget> straight_line(const PoseTarget& from, const PoseTarget& to, double step_m) {
  double num_steps = std::ceil((to.p_RT - from.p_RT).norm() / step_m);
  if (to.q_RT)
    num_steps = std::max(num_steps, std::ceil(from.q_RT->angularDistance(*to.q_RT) / kTurn_rad));
  const auto n = std::clamp<std::size_t>(static_cast<std::size_t>(num_steps), 1, kMostSteps);
  std::vector<PoseTarget> line;
  for (std::size_t i = 1; i <= n; ++i) {
    const double share = static_cast<double>(i) / static_cast<double>(n);
    PoseTarget step{.p_RT = from.p_RT + share * (to.p_RT - from.p_RT)};
    if (to.q_RT) step.q_RT = from.q_RT->slerp(share, *to.q_RT);
    line.push_back(step);
  }
  return line;
}

/// How far `part` leaves the line to `end` where all signals move evenly from one action to
/// another, looked at in three places [m, in the root's frame].
double leaves_line_by_m(const BodySchema& schema, int part, const Eigen::VectorXd& from,
                        const Eigen::VectorXd& to, const Eigen::Vector3d& end) {
  const auto position_at = [&](double share) -> Eigen::Vector3d {
    return schema.predict(schema.root, part, from + share * (to - from))->X_AB.translation();
  };
  const Eigen::Vector3d begin = position_at(0), along = end - begin;
  double farthest = 0;
  for (const double share : {0.25, 0.5, 0.75}) {
    const Eigen::Vector3d off = position_at(share) - begin;
    const double done = std::clamp(off.dot(along) / std::max(along.squaredNorm(), 1e-12), 0.0, 1.0);
    farthest = std::max(farthest, (off - done * along).norm());
  }
  return farthest;
}

}  // namespace

Trajectory::Trajectory(std::vector<PoseTarget> way_points, double step_m) {
  for (std::size_t n = 0; n < way_points.size(); ++n)
    legs_.push_back(n == 0 ? std::vector{way_points[0]}
                           : straight_line(way_points[n - 1], way_points[n], step_m));
}

std::string Trajectory::objection(const BodySchema& schema, int part, Eigen::VectorXd action,
                                  const Limits& limits) const {
  for (std::size_t n = 0; n < legs_.size(); ++n) {
    for (const PoseTarget& step : legs_[n]) {
      const InverseKinematicsSolution solution =
          solve_pose(schema, part, step, schema.signals, action, kThoroughInverseKinematics);
      const double sd_m =
          deviations_of(schema.predict(schema.root, part, solution.action)->covariance).position_m;
      const double off_m =
          n > 0 ? leaves_line_by_m(schema, part, action, solution.action, step.p_RT) : 0;
      std::string why;
      if (sd_m > limits.position_sd_m)
        why = fmt::format("the schema knows the part there within ±{:.1f} mm only", sd_m * 1e3);
      else if (solution.error_m > limits.error_m || solution.error_rad > limits.error_rad)
        why = fmt::format("out of reach, no nearer than {}",
                          step.q_RT ? fmt::format("{:.1f} mm and {:.1f}°", solution.error_m * 1e3,
                                                  solution.error_rad / kDegree)
                                    : fmt::format("{:.1f} mm", solution.error_m * 1e3));
      else if (off_m > limits.off_line_m)
        why = fmt::format(
            "the arm would have to turn over and leave the line by {:.0f} mm: begin elsewhere, or "
            "go round by another point",
            off_m * 1e3);
      if (!why.empty())
        return fmt::format("the way to point {} of {}, at {:.3f} {:.3f} {:.3f}: {}", n + 1,
                           legs_.size(), step.p_RT.x(), step.p_RT.y(), step.p_RT.z(), why);
      action = solution.action;
    }
  }
  return "";
}

}  // namespace bodyschema
