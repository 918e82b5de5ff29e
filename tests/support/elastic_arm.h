#pragma once

#include "tests/support/random_arm.h"

namespace bodyschema::test {

/// An arm of joints that turn and give way to gravity, which pulls along −z of its base. At the end
/// of each link is a mass.
struct ElasticArm {
  SyntheticRobot robot;  ///< without load
  std::vector<double> mass_kg;
  Eigen::VectorXd compliance_rad_per_Nm;

  /// Torque about the axis of each joint of an edge from base to hand over its gain, by the edge's
  /// geometry: as JointLoads.
  Eigen::VectorXd loads(const Edge& edge, const Eigen::VectorXd& action) const;
  /// Where the joints rest, in command units.
  Eigen::VectorXd loaded(const Eigen::VectorXd& action) const;
};

/// A random_arm() of as many joints, whose hand gives way by `droop_m` at most.
ElasticArm elastic_arm(int num_joints, double droop_m, Rng& rng);

/// Its samples in tag noise: the hand alone is seen.
std::vector<ActionPoseSample> babble(const ElasticArm& arm, int num_samples, Rng& rng);

}  // namespace bodyschema::test
