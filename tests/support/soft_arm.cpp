#include "tests/support/soft_arm.h"

#include <algorithm>
#include <cmath>
#include <string>

namespace bodyschema::test {

std::vector<Signal> SoftArm::signals() const {
  std::vector<Signal> result;
  for (int s = 0; s < num_signals(); ++s) result.push_back({"q" + std::to_string(s + 1), -1, 1});
  return result;
}

std::set<int> SoftArm::signals_of(int section) const {
  std::set<int> result;
  const int last = coupling != 0 ? std::min(section + 1, num_sections - 1) : section;
  for (int s = section * num_chambers; s < (last + 1) * num_chambers; ++s) result.insert(s);
  return result;
}

Pose SoftArm::section(int n, const Eigen::VectorXd& action) const {
  Eigen::Vector2d bend = Eigen::Vector2d::Zero();
  double mean = 0;
  for (int m = n; m < std::min(n + 2, num_sections); ++m)
    for (int c = 0; c < num_chambers; ++c) {
      const double q = action(m * num_chambers + c);
      const double pressure = q + 0.2 * q * q;
      const double angle = 2 * M_PI * c / num_chambers + 0.4 * m;
      bend += (m == n ? 1 : coupling) * bend_rad * pressure * 2 / num_chambers *
              Eigen::Vector2d(std::cos(angle), std::sin(angle));
      if (m == n) mean += pressure / num_chambers;
    }
  Vector6d arc;
  arc << 0, 0, length_m * (1 + stretch * mean), -bend.y(), bend.x(), 0;
  return exp(arc);
}

std::vector<Pose> SoftArm::poses(const Eigen::VectorXd& action) const {
  std::vector<Pose> result{make_pose(Eigen::Quaterniond::Identity(), Eigen::Vector3d(0, 0, 1))};
  for (int n = 0; n < num_sections; ++n) result.push_back(result.back() * section(n, action));
  return result;
}

std::vector<ActionPoseSample> SoftArm::babble(int num_samples, const Noise& noise, Rng& rng) const {
  std::vector<ActionPoseSample> samples(static_cast<std::size_t>(num_samples));
  for (int t = 0; t < num_samples; ++t) {
    ActionPoseSample& sample = samples[static_cast<std::size_t>(t)];
    sample.sample_index = t;
    sample.utime = 2'000'000 * std::int64_t{t};
    sample.action.resize(num_signals());
    for (double& q : sample.action) q = uniform(rng, -1, 1);
    for (const Pose& X_CP : poses(sample.action)) {
      Vector6d error = gaussian6(rng);
      error.head<3>() *= noise.position_m;
      error.tail<3>() *= noise.rotation_rad;
      PartObservation o;
      o.part = static_cast<int>(sample.parts.size());
      o.X_CB = X_CP * exp(error);
      sample.parts.push_back(o);
    }
  }
  return samples;
}

}  // namespace bodyschema::test
