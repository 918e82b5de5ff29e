#pragma once

// Robots of which a refinement begins a little off, and what it answers.

#include <algorithm>
#include <string>
#include <vector>

#include "processes/refiner/refine.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema::test {

inline constexpr Noise kNoise{0.0005, 0.003};

inline BodySchema true_start(const SyntheticRobot& robot) {
  BodySchema schema = true_schema(robot);
  schema.X_CR = robot.X_CR;
  return schema;
}

inline BodySchema displaced(BodySchema schema) {
  Vector6d step;
  step << 0.003, -0.002, 0.004, 0.02, -0.01, 0.01;
  for (Edge& edge : schema.edges) {
    edge.left = edge.left * exp(step);
    for (ScrewJoint& joint : edge.joints) joint.X_after = joint.X_after * exp(Vector6d(-step));
  }
  return schema;
}

inline std::vector<ActionPoseSample> exact(const SyntheticRobot& robot, int num_samples, Rng& rng) {
  std::vector<ActionPoseSample> samples = babble(robot, num_samples, {}, rng);
  for (ActionPoseSample& sample : samples)
    for (PartObservation& observation : sample.parts) observation.covariance = isotropic(kNoise);
  return samples;
}

/// Largest error of a seen part's position relative to the root.
inline double worst_error_m(const BodySchema& schema, const SyntheticRobot& robot,
                            const std::vector<ActionPoseSample>& samples) {
  double worst = 0;
  for (const ActionPoseSample& sample : samples) {
    const auto truth = robot.poses_in_camera(sample.action);
    for (const auto& [part, X_RB] : schema.predict_all(sample.action))
      if (sample.find(part) != nullptr)
        worst = std::max(worst, (truth.at(schema.root).inverse() * truth.at(part).translation() -
                                 X_RB.translation())
                                    .norm());
  }
  return worst;
}

inline bool names(const std::vector<std::string>& sentences, const std::string& words) {
  return std::any_of(sentences.begin(), sentences.end(), [&](const std::string& sentence) {
    return sentence.find(words) != std::string::npos;
  });
}

}  // namespace bodyschema::test
