#include "processes/structure_learner/told_noise.h"

#include <algorithm>
#include <cmath>
#include <map>

namespace bodyschema {

bool has_covariances(const std::vector<ActionPoseSample>& samples) {
  for (const auto& sample : samples)
    for (const auto& o : sample.parts)
      if (!o.covariance.isZero(0)) return true;
  return false;
}

Noise typical_noise(const std::vector<ActionPoseSample>& samples) {
  double position = 0, rotation = 0;
  int count = 0, num_rotations = 0;
  for (const auto& sample : samples) {
    for (const auto& o : sample.parts) {
      position += o.covariance.topLeftCorner<3, 3>().trace() / 3;
      rotation += o.covariance.bottomRightCorner<3, 3>().trace() / 3;
      ++count;
      num_rotations += o.has_rotation;
    }
  }
  if (count == 0) return {};
  return {std::sqrt(position / count), std::sqrt(rotation / std::max(num_rotations, 1))};
}

std::set<int> fixed_parts(const std::vector<ActionPoseSample>& samples) {
  constexpr int kFewest = 3;
  struct Seen {
    Pose first;
    int count = 0;
    bool has_moved = false;
  };
  std::map<int, Seen> seen;
  for (const ActionPoseSample& sample : samples)
    for (const PartObservation& o : sample.parts) {
      Seen& part = seen.try_emplace(o.part, Seen{o.X_CB}).first->second;
      ++part.count;
      part.has_moved |= part.first.matrix() != o.X_CB.matrix();
    }
  std::set<int> result;
  for (const auto& [part, of] : seen)
    if (!of.has_moved && of.count >= kFewest) result.insert(part);
  return result;
}

}  // namespace bodyschema
