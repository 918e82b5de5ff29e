#include "tests/experiments/control_arms.h"

#include <cmath>
#include <nlohmann/json.hpp>

#include "common/bus/event_log.h"
#include "common/geometry/angle.h"
#include "processes/controller/inverse_kinematics.h"

namespace bodyschema::test {
namespace {

constexpr double kLonger_m = 0.01;

/// A closed path of the whole arm's end effector: each joint swings by a third of its range to both
/// sides, the even ones twice a turn.
std::vector<Eigen::Vector3d> path_of(const SyntheticRobot& robot) {
  std::vector<Eigen::Vector3d> path;
  for (int n = 0; n < kWayPoints; ++n) {
    const double phase = 2 * M_PI * n / kWayPoints;
    Eigen::VectorXd action(robot.signals.size());
    for (std::size_t s = 0; s < robot.signals.size(); ++s) {
      const Signal& signal = robot.signals[s];
      const double swing = std::sin(phase * (s % 2 ? 2 : 1) + 0.7 * static_cast<double>(s));
      action[static_cast<Eigen::Index>(s)] =
          0.5 * (signal.lower + signal.upper) + swing * (signal.upper - signal.lower) / 3;
    }
    const auto X_CB = robot.poses_in_camera(action);
    path.push_back((X_CB.at(kRoot).inverse() * X_CB.at(kEndEffector)).translation());
  }
  return path;
}

/// The middle link turns by 45° about an axis across it, at the joint that carries it.
SyntheticRobot bent(SyntheticRobot robot, Rng& rng) {
  TrueLink& link = robot.links[kMiddle - 1];
  const Eigen::Vector3d along = link.X_after.translation();
  const Eigen::Vector3d across = along.cross(random_vector(rng, 1, 1)).normalized();
  link.X_after =
      exp((Vector6d() << Eigen::Vector3d::Zero(), across * 45 * kDegree).finished()) * link.X_after;
  return robot;
}

/// The hand is farther out, as with another tool.
SyntheticRobot lengthened(SyntheticRobot robot) {
  robot.links.back().X_after.translation() +=
      kLonger_m * robot.links.back().X_after.translation().normalized();
  return robot;
}

bool reaches(const SyntheticRobot& robot, const std::vector<Eigen::Vector3d>& path) {
  const InverseKinematicsOptions options{
      .tolerance_m = 1e-4, .damping_m = 0.05, .max_iterations = 100, .max_starts = 20};
  const BodySchema schema = true_schema(robot);
  Eigen::VectorXd action = Eigen::VectorXd::Zero(static_cast<Eigen::Index>(robot.signals.size()));
  for (const Eigen::Vector3d& p_RT : path) {
    const auto solution =
        solve_pose(schema, kEndEffector, {.p_RT = p_RT}, robot.signals, action, options);
    if (!solution.is_within_tolerance) return false;
    action = solution.action;
  }
  return true;
}

nlohmann::json json_of(const Pose& X) {
  const Eigen::Vector3d p = X.translation();
  const Eigen::Quaterniond q(X.linear());
  return {{"p_m", {p.x(), p.y(), p.z()}}, {"q_wxyz", {q.w(), q.x(), q.y(), q.z()}}};
}

}  // namespace

Arms arms_of(Rng& rng) {
  for (;;) {
    Arms arms;
    arms.whole = chapter_robot("c", rng);
    arms.bent = bent(arms.whole, rng);
    arms.longer = lengthened(arms.whole);
    arms.path = path_of(arms.whole);
    if (reaches(arms.whole, arms.path) && reaches(arms.bent, arms.path)) return arms;
  }
}

void write_geometry(int num_runs, const std::string& file) {
  std::string text;
  for (int run = 1; run <= num_runs; ++run) {
    Rng rng(static_cast<Rng::result_type>(run));
    const Arms arms = arms_of(rng);
    nlohmann::json links, path;
    for (const TrueLink& link : arms.whole.links) {
      if (link.parent < 0) continue;
      const Signal& signal = arms.whole.signals[static_cast<std::size_t>(link.signal)];
      links.push_back({{"part", link.part},
                       {"X_before", json_of(link.X_before)},
                       {"X_after", json_of(link.X_after)},
                       {"limits_rad", {signal.lower, signal.upper}}});
    }
    for (const Eigen::Vector3d& p : arms.path) path.push_back({p.x(), p.y(), p.z()});
    const nlohmann::json line = {{"arm", run},
                                 {"links", links},
                                 {"bent_X_after", json_of(arms.bent.links[kMiddle - 1].X_after)},
                                 {"path_m", path}};
    text += line.dump() + "\n";
  }
  write_file_atomically(file, text);
}

}  // namespace bodyschema::test
