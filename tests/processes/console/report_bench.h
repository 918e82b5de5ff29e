#pragma once

#include <gtest/gtest.h>

#include "common/plot/plot.h"
#include "processes/console/report/report_figures.h"
#include "processes/console/report/report_page.h"
#include "tests/support/synthetic_robot.h"

// What the report's tests have in common: a body of three parts and its samples.

namespace bodyschema::test {

inline int count(const std::string& text, const std::string& what) {
  int n = 0;
  for (std::size_t at = 0; (at = text.find(what, at)) != std::string::npos; at += what.size()) ++n;
  return n;
}

/// Part 2 turns about part 1 with q1, part 3 about part 2 with q1 and then q2.
inline BodySchema three_parts() {
  Rng rng(5);
  BodySchema schema;
  schema.version = 3;
  schema.complete = true;
  schema.num_samples = 40;
  schema.last_sample_index = 49;
  schema.parts = {1, 2, 3};
  schema.root = 1;
  schema.signals = {{"q1", -1, 1}, {"q2", 0, 100}};
  Edge hinge;
  hinge.from = 1;
  hinge.to = 2;
  hinge.left = random_pose(rng, 0.1, 0.2);
  hinge.joints = {ScrewJoint{.signal = 0, .turn = 1.2}};
  hinge.right = random_pose(rng, 0.1, 0.2);
  Edge two = hinge;
  two.from = 2;
  two.to = 3;
  two.joints = {ScrewJoint{.signal = 0, .turn = 0.4},
                ScrewJoint{.signal = 1, .slide = 0.001, .turn = 0.01}};
  schema.edges = {hinge, two};
  return schema;
}

/// Samples of that schema; `noise` is the covariance of each part's pose.
inline std::vector<ActionPoseSample> samples_of(const BodySchema& schema, int num,
                                                const Matrix6d& noise, Rng& rng) {
  const Matrix6d root = noise.llt().matrixL();
  std::vector<ActionPoseSample> samples;
  for (int i = 0; i < num; ++i) {
    ActionPoseSample& sample = samples.emplace_back();
    sample.sample_index = i;
    sample.purpose = i % 5 == 4 ? Purpose::kTest : Purpose::kTrain;
    sample.action.resize(2);
    sample.action << uniform(rng, -1, 1), uniform(rng, 0, 100);
    const Pose X_CR = random_pose(rng, 1, 2);
    for (const auto& [part, X_RB] : schema.predict_all(sample.action)) {
      PartObservation observation;
      observation.part = part;
      observation.X_CB = X_CR * X_RB * exp(root * gaussian6(rng));
      observation.covariance = noise;
      sample.parts.push_back(observation);
    }
  }
  return samples;
}

inline Matrix6d uneven_noise() {
  Vector6d sigma;
  sigma << 0.001, 0.002, 0.008, 0.03, 0.004, 0.01;
  return sigma.cwiseAbs2().asDiagonal();
}

}  // namespace bodyschema::test
