#include "processes/controller/trajectory.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "common/kinematics/kinematic_path.h"
#include "common/schema/standard_deviations.h"
#include "common/text/pose_text.h"

namespace bodyschema {
namespace {

constexpr double kTurn_rad = 0.1;  // chosen: of a part 0.2 m long the end moves by a step of 20 mm

/// Without `from`.
std::vector<PoseTarget> straight_line(const PoseTarget& from, const PoseTarget& to, double step_m) {
  double num_steps = std::max(1.0, std::ceil((to.p_RT - from.p_RT).norm() / step_m));
  if (to.q_RT)
    num_steps = std::max(num_steps, std::ceil(from.q_RT->angularDistance(*to.q_RT) / kTurn_rad));
  if (!(num_steps <= static_cast<double>(Trajectory::kMostSteps))) return {};
  const auto n = static_cast<std::size_t>(num_steps);
  std::vector<PoseTarget> line;
  for (std::size_t i = 1; i <= n; ++i) {
    const double share = static_cast<double>(i) / num_steps;
    PoseTarget step{.p_RT = from.p_RT + share * (to.p_RT - from.p_RT)};
    if (to.q_RT) step.q_RT = from.q_RT->slerp(share, *to.q_RT);
    line.push_back(step);
  }
  return line;
}

/// How far the part leaves the line to `end` where all signals move evenly from one action to
/// another, looked at in three places [m, in the root's frame].
double leaves_line_by_m(const KinematicPath& path, const Eigen::VectorXd& from,
                        const Eigen::VectorXd& to, const Eigen::Vector3d& end) {
  const auto position_at = [&](double share) -> Eigen::Vector3d {
    return path.predict(from + share * (to - from)).translation();
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

/// Solves step after step.
class Solver {
 public:
  Solver(const BodySchema& schema, int part, const Eigen::VectorXd& action,
         const Trajectory::Limits& limits)
      : schema_(schema),
        part_(part),
        limits_(limits),
        path_(KinematicPath::between(schema, schema.root, part)),
        action_(action) {
    options_.tolerance_m = std::min(options_.tolerance_m, limits.error_m);
    options_.tolerance_rad = std::min(options_.tolerance_rad, limits.error_rad);
  }

  /// "" or why the step cannot be made from the one before.
  std::string objection(const PoseTarget& step, bool is_on_line) {
    const auto solution = solve_pose(schema_, part_, step, schema_.signals, action_, options_);
    const double sd_m =
        deviations_of(path_->covariance(solution.action, Variance::kFirstOrder)).position_m;
    if (!(sd_m <= limits_.position_sd_m))
      return fmt::format("the schema knows the part there within ±{:.1f} mm only", sd_m * 1e3);
    if (!(solution.error_m <= limits_.error_m && solution.error_rad <= limits_.error_rad))
      return "out of reach, no nearer than " +
             (step.q_RT ? pose_text(solution.error_m, solution.error_rad, 1)
                        : fmt::format("{:.1f} mm", solution.error_m * 1e3));
    const double off_m =
        is_on_line ? leaves_line_by_m(*path_, action_, solution.action, step.p_RT) : 0;
    if (!(off_m <= limits_.off_line_m))
      return fmt::format(
          "the arm would have to turn over and leave the line by {:.0f} mm: begin elsewhere, or go "
          "round by another point",
          off_m * 1e3);
    if (std::string why = limits_.workspace.objection(step.p_RT); !why.empty()) return why;
    if (std::string why = limits_.workspace.objection(schema_, action_, solution.action);
        !why.empty())
      return why;
    action_ = solution.action;
    return "";
  }

 private:
  const BodySchema& schema_;
  const int part_;
  const Trajectory::Limits& limits_;
  InverseKinematicsOptions options_ = kThoroughInverseKinematics;
  const std::optional<KinematicPath> path_;
  Eigen::VectorXd action_;
};

/// "" or to which step of a leg there is an objection.
std::string objection_to(const std::vector<PoseTarget>& leg, std::size_t n, std::size_t num_legs,
                         Solver* solver,
                         const std::function<void(std::size_t)>& on_step = nullptr) {
  for (const PoseTarget& step : leg) {
    if (on_step) on_step(n);
    if (const std::string why = solver->objection(step, n > 0); !why.empty())
      return fmt::format("the way to point {} of {}, at {:.3f} {:.3f} {:.3f}: {}", n + 1, num_legs,
                         step.p_RT.x(), step.p_RT.y(), step.p_RT.z(), why);
  }
  return "";
}

}  // namespace

Trajectory::Trajectory(const std::vector<PoseTarget>& way_points, double step_m) {
  if (way_points.empty()) throw std::invalid_argument("a path has a way point or more");
  if (!(step_m > 0)) throw std::invalid_argument("a step is longer than 0 m");
  legs_.push_back({way_points.front()});
  std::size_t num_steps = 1;
  for (std::size_t n = 1; n < way_points.size(); ++n) {
    const PoseTarget &from = way_points[n - 1], &to = way_points[n];
    if (from.q_RT.has_value() != to.q_RT.has_value())
      throw std::invalid_argument("some way points have an orientation, others none");
    legs_.push_back(straight_line(from, to, step_m));
    num_steps += legs_.back().size();
    if (legs_.back().empty() || num_steps > kMostSteps)
      throw std::invalid_argument(fmt::format(
          "more than {} steps up to point {}: are all way points in metres?", kMostSteps, n + 1));
  }
}

std::string Trajectory::objection(const BodySchema& schema, int part, const Eigen::VectorXd& action,
                                  const Limits& limits,
                                  const std::function<void(std::size_t)>& on_step) const {
  Solver solver(schema, part, action, limits);
  for (std::size_t n = 0; n < legs_.size(); ++n)
    if (std::string why = objection_to(legs_[n], n, legs_.size(), &solver, on_step); !why.empty())
      return why;
  return "";
}

std::string Trajectory::objection_to_leg(std::size_t n, const BodySchema& schema, int part,
                                         const Eigen::VectorXd& action,
                                         const Limits& limits) const {
  Solver solver(schema, part, action, limits);
  return objection_to(legs_[n], n, legs_.size(), &solver);
}

}  // namespace bodyschema
