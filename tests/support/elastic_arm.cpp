#include "tests/support/elastic_arm.h"

#include <algorithm>

namespace bodyschema::test {

Eigen::VectorXd ElasticArm::loads(const Edge& edge, const Eigen::VectorXd& action) const {
  const auto num = std::ssize(edge.joints);
  std::vector<Pose> joints;  // in the base, z along the axis
  std::vector<Eigen::Vector3d> masses;
  Pose X = edge.left;
  for (const ScrewJoint& joint : edge.joints) {
    joints.push_back(X);
    Vector6d twist = Vector6d::Zero();
    twist(5) = joint.turn * (joint.gain * action(joint.signal) + joint.offset);
    X = X * exp(twist) * joint.X_after;
    masses.push_back(X.translation());
  }
  const Eigen::Vector3d g = -9.80665 * Eigen::Vector3d::UnitZ();
  Eigen::VectorXd loads = Eigen::VectorXd::Zero(num);
  for (std::ptrdiff_t d = 0; d < num; ++d) {
    Eigen::Vector3d torque = Eigen::Vector3d::Zero();
    for (std::ptrdiff_t k = d; k < num; ++k)
      torque += mass_kg[k] * (masses[k] - joints[d].translation()).cross(g);
    loads(d) = joints[d].linear().col(2).dot(torque) / (edge.joints[d].turn * edge.joints[d].gain);
  }
  return loads;
}

Eigen::VectorXd ElasticArm::loaded(const Eigen::VectorXd& action) const {
  const Edge edge = robot.true_edge(robot.links.front().part, robot.links.back().part);
  Eigen::VectorXd rests = action;
  constexpr int kIterations = 20;  // each leaves a few hundredths of the last one's change
  for (int n = 0; n < kIterations; ++n) {
    const Eigen::VectorXd load = loads(edge, rests);
    rests = action;
    for (std::ptrdiff_t d = 0; d < load.size(); ++d)
      rests(edge.joints[d].signal) += compliance_rad_per_Nm(d) * load(d);
  }
  return rests;
}

ElasticArm elastic_arm(int num_joints, double droop_m, Rng& rng) {
  ElasticArm arm;
  arm.robot = random_arm({.num_joints = num_joints, .share_sliding = 0}, rng);
  arm.compliance_rad_per_Nm.resize(num_joints);
  for (int d = 0; d < num_joints; ++d) {
    arm.mass_kg.push_back(uniform(rng, 0.5, 3));
    arm.compliance_rad_per_Nm(d) = 1e-6 * uniform(rng, 0.3, 1);
  }
  const int hand = arm.robot.links.back().part;
  double most = 0;
  for (int n = 0; n < 200; ++n) {
    const Eigen::VectorXd action = arm.robot.random_action(rng);
    const auto position = [&](const Eigen::VectorXd& at) {
      return Eigen::Vector3d(arm.robot.poses_in_camera(at).at(hand).translation());
    };
    most = std::max(most, (position(arm.loaded(action)) - position(action)).norm());
  }
  arm.compliance_rad_per_Nm *= droop_m / most;
  return arm;
}

std::vector<ActionPoseSample> babble(const ElasticArm& arm, int num_samples, Rng& rng) {
  const int hand = arm.robot.links.back().part;
  std::vector<ActionPoseSample> samples;
  for (int n = 0; n < num_samples; ++n) {
    const Eigen::VectorXd action = arm.robot.random_action(rng);
    ActionPoseSample sample = observe(arm.robot, arm.loaded(action),
                                      {.regime = Regime::kTag, .with_covariances = true}, n, rng);
    sample.action = action;
    std::erase_if(sample.parts, [&](const auto& seen) { return seen.part != hand; });
    samples.push_back(std::move(sample));
  }
  return samples;
}

}  // namespace bodyschema::test
