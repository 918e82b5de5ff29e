#pragma once

#include <gtest/gtest.h>

#include "common/bus/codec.h"
#include "common/bus/convert.h"
#include "processes/model_monitor/adaptation.h"
#include "processes/model_monitor/model_monitor.h"
#include "processes/structure_learner/learn.h"
#include "tests/support/broken_arm.h"
#include "tests/support/synthetic_robot.h"

// What the monitor's tests have in common: a robot, its samples, and what is learned from them.

namespace bodyschema::test {

using Bytes = std::vector<std::uint8_t>;

inline ModelMonitorConfig test_config() {
  return {.max_mahalanobis2 = 20.06,
          .max_outlier_share = 0.2,
          .measurement = {.systematic = kTagSystematic}};
}

inline Bytes bytes_of(const ModelMonitor& monitor) {
  EXPECT_TRUE(monitor.schema());
  return monitor.schema() ? encode(kBodySchema, *monitor.schema()) : Bytes();
}

/// Health without the history of how it came about.
inline Bytes judgement_of(const ModelMonitor& monitor) {
  model_health_t health = monitor.health();
  set_array(health.num_events, health.events, {});
  return encode(kModelHealth, health);
}

inline Matrix6d covariance(double position_m, double rotation_rad) {
  Vector6d diagonal;
  diagonal << Eigen::Vector3d::Constant(position_m * position_m),
      Eigen::Vector3d::Constant(rotation_rad * rotation_rad);
  return diagonal.asDiagonal();
}

inline PartObservation observation(int part, const Pose& X_CB, double position_m,
                                   double rotation_rad) {
  PartObservation result;
  result.part = part;
  result.X_CB = X_CB;
  result.covariance = covariance(position_m, rotation_rad);
  return result;
}

/// A babbling 2-DOF robot seen through tags, every fifth sample TEST, and what is learned from it.
class ModelMonitorTest : public testing::Test {
 protected:
  static constexpr int kNumSamples = 45;

  ModelMonitorTest() {
    Rng rng(31);
    robot_ = chapter_robot("a", rng);
    const ObservationOptions options{
        .regime = Regime::kTag, .with_covariances = true, .with_other_hypothesis = true};
    samples_ = babble(robot_, kNumSamples, options, rng);
    for (ActionPoseSample& sample : samples_) {
      sample.utime = 1'000'000 * (sample.sample_index + 1);
      if (sample.sample_index % 5 == 4) sample.purpose = Purpose::kTest;
    }
  }

  /// What the learner proposes after sample `index`.
  BodySchema learned(std::int64_t index) const {
    std::vector<ActionPoseSample> training;
    for (const ActionPoseSample& sample : samples_) {
      if (sample.sample_index <= index && sample.purpose == Purpose::kTrain)
        training.push_back(sample);
    }
    LearnOptions options;
    options.root = 1;
    BodySchema schema = learn(robot_.signals, training, options).schema;
    schema.last_sample_index = index;
    schema.utime = samples_.at(index).utime;
    return schema;
  }
  body_schema_t proposal(std::int64_t index) const { return to_message(learned(index)); }
  sample_t sample(std::int64_t index) const { return to_message(samples_.at(index)); }
  /// The proposal of `index` as if it were one of the TEST sample `last`.
  body_schema_t proposal(std::int64_t index, std::int64_t last) const {
    BodySchema schema = learned(index);
    schema.last_sample_index = last;
    schema.utime = samples_.at(last).utime;
    return to_message(schema);
  }
  body_schema_t wrong(std::int64_t index) const {
    BodySchema schema = learned(index);
    for (Edge& edge : schema.edges) edge.right.translation().x() += 0.3;
    return to_message(schema);
  }
  /// From sample `since` on the joint farthest from the root stands still. Returns its edge.
  Edge break_last_joint(std::int64_t since) {
    const BodySchema schema = learned(kNumSamples - 1);
    const Edge* edge = nullptr;
    for (const Edge& e : schema.edges)
      if (!e.joints.empty()) edge = &e;
    const int signal = edge->joints.front().signal;
    for (ActionPoseSample& sample : samples_) {
      if (sample.sample_index < since) continue;
      Eigen::VectorXd action = sample.action;
      action(signal) = 0.4;
      const auto healthy = robot_.poses_in_camera(sample.action);
      const auto poses = robot_.poses_in_camera(action);
      for (PartObservation& part : sample.parts) {
        // The same noise about another pose.
        const Pose noise = healthy.at(part.part).inverse() * part.X_CB;
        if (part.X_CB_other)
          part.X_CB_other =
              poses.at(part.part) * (healthy.at(part.part).inverse() * *part.X_CB_other);
        part.X_CB = poses.at(part.part) * noise;
      }
    }
    return *edge;
  }
  /// A monitor that has heard the samples 0..index.
  ModelMonitor monitor_at(std::int64_t index) const {
    ModelMonitor monitor(test_config());
    for (std::int64_t i = 0; i <= index; ++i) monitor.on_sample(sample(i));
    return monitor;
  }

  SyntheticRobot robot_;
  std::vector<ActionPoseSample> samples_;
};

}  // namespace bodyschema::test
