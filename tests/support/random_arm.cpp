#include "tests/support/random_arm.h"

#include <algorithm>
#include <numeric>

#include "common/geometry/angle.h"

namespace bodyschema::test {

SyntheticRobot random_arm(const RandomArmOptions& options, Rng& rng) {
  SyntheticRobot robot;
  robot.X_CR = random_pose(rng, 1.5, 2);
  robot.links.push_back({.part = 1});
  std::vector<int> signals(options.num_joints);
  std::iota(signals.begin(), signals.end(), 0);
  if (options.scrambled) std::shuffle(signals.begin(), signals.end(), rng);
  robot.signals.resize(options.num_joints);
  for (int j = 0; j < options.num_joints; ++j) {
    const int s = signals[j];
    TrueLink link{.part = j + 2, .parent = j + 1, .signal = s};
    link.X_before = random_pose(rng, 0.05, 0.2);
    link.X_after = random_pose(rng, 0.05, 0.2);
    const double kind = uniform(rng, 0, 1);
    if (j > 0 && kind < 0.8) {  // parallel to the axis before, or at a right angle
      robot.links.back().X_after.linear().setIdentity();
      link.X_before.linear() =
          Eigen::AngleAxisd(kind < 0.3 ? 0 : M_PI / 2, Eigen::Vector3d::UnitX()).toRotationMatrix();
    }
    double gain = 1;
    if (options.own_gains) gain = uniform(rng, 0.6, 1.6) * (uniform(rng, 0, 1) < 0.5 ? -1 : 1);
    double half_range = 0.5 * uniform(rng, 60, 240) * kDegree / std::abs(gain);
    if (uniform(rng, 0, 1) < options.share_sliding) {
      link.slide = 0.1 * gain;
      half_range = 1;
    } else {
      link.turn = gain;
    }
    link.zero = uniform(rng, -0.5, 0.5);
    link.hidden = j + 1 < options.num_joints;
    const double centre = uniform(rng, -0.5, 0.5);
    robot.signals[s] = {"q" + std::to_string(s + 1), centre - half_range, centre + half_range, {}};
    robot.links.push_back(link);
  }
  return robot;
}

std::vector<ActionPoseSample> noisy_babble(const SyntheticRobot& robot, int num_samples,
                                           const Noise& noise, Rng& rng) {
  std::vector<ActionPoseSample> samples = babble(robot, num_samples, {}, rng);
  for (ActionPoseSample& sample : samples)
    for (PartObservation& o : sample.parts) {
      Vector6d e = gaussian6(rng);
      e.head<3>() *= noise.position_m;
      e.tail<3>() *= noise.rotation_rad;
      o.X_CB = o.X_CB * exp(e);
    }
  return samples;
}

}  // namespace bodyschema::test
