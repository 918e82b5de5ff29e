// Learner and monitor together, while the body changes: in one thread, message by message.

#include <gtest/gtest.h>

#include <algorithm>
#include <deque>

#include "common/bus/check.h"
#include "common/bus/codec.h"
#include "common/bus/convert.h"
#include "processes/model_monitor/model_monitor.h"
#include "processes/structure_learner/structure_learner.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Rng;

constexpr int kBrokenAt = 40, kEnd = 240;

/// A babbling 2-DOF robot, every fifth sample TEST, whose second moving link is bent half-way.
class RelearningTest : public testing::Test {
 protected:
  RelearningTest() {
    Rng rng(7);
    healthy_ = test::chapter_robot("a", rng);
    broken_ = healthy_;
    test::TrueLink& link = second_moving(&broken_);
    link.X_before.linear() = link.X_before.linear() * exp_so3({0.5, 0, 0.3});
    link.X_before.translation() += Eigen::Vector3d(0.02, 0.01, 0);
    babble(rng, kEnd);
  }

  static test::TrueLink& second_moving(test::SyntheticRobot* robot) {
    int num_moving = 0;
    return *std::find_if(robot->links.begin(), robot->links.end(),
                         [&](const auto& link) { return link.signal >= 0 && ++num_moving == 2; });
  }

  /// Broken from kBrokenAt on, until it is repaired.
  void babble(Rng& rng, std::int64_t repaired_at) {
    samples_.clear();
    const test::ObservationOptions options{
        .regime = test::Regime::kTag, .with_covariances = true, .with_other_hypothesis = true};
    for (std::int64_t n = 0; n < kEnd; ++n) {
      const test::SyntheticRobot& robot = n < kBrokenAt || n >= repaired_at ? healthy_ : broken_;
      ActionPoseSample sample = observe(robot, robot.random_action(rng), options, n, rng);
      sample.utime = 1'000'000 * (n + 1);
      if (n % 5 == 4) sample.purpose = Purpose::kTest;
      samples_.push_back(to_message(sample));
    }
    config_.signals = healthy_.signals;
    config_.options.root = 1;
    for (sample_t& sample : samples_) EXPECT_EQ(check(sample), "");
  }

  /// The monitor after samples 0..end-1; the learner's answers come `late` samples late, and it
  /// hears the body schema `heard_late` samples late.
  ModelMonitor run(std::int64_t late = 0, std::int64_t end = kEnd, std::size_t heard_late = 0) {
    ModelMonitor monitor(
        {.max_mahalanobis2 = 20.06,
         .max_outlier_share = 0.2,
         .measurement = {.systematic = {.position_m = 0.0007, .rotation_rad = 0.0025}}});
    StructureLearner learner(config_);
    proposals_.clear();
    std::deque<std::pair<std::int64_t, body_schema_t>> on_the_way;
    std::deque<body_schema_t> published;
    for (std::int64_t n = 0; n < end + late; ++n) {
      if (n < end) {
        const sample_t& sample = samples_[static_cast<std::size_t>(n)];
        monitor.on_sample(sample);
        learner.on_sample(sample);
      }
      while (learner.has_job()) {
        const bool is_test = learner.has_test_job();
        const body_schema_t proposal = learner.take_job()();
        EXPECT_EQ(check(proposal), "");
        if (!is_test) continue;
        on_the_way.emplace_back(n + late, proposal);
        proposals_.push_back(proposal);
      }
      while (!on_the_way.empty() && on_the_way.front().first <= n) {
        monitor.on_learned_schema(on_the_way.front().second);
        on_the_way.pop_front();
      }
      if (monitor.schema()) {
        EXPECT_EQ(check(*monitor.schema()), "");
        published.push_back(*monitor.schema());
        if (published.size() > heard_late) {
          learner.on_body_schema(published.front());
          published.pop_front();
        }
      }
    }
    return monitor;
  }

  /// Mean over random actions and parts [m].
  double error(const BodySchema& schema) const { return error(schema, broken_); }
  static double error(const BodySchema& schema, const test::SyntheticRobot& robot) {
    Rng rng(9);
    double sum = 0;
    int count = 0;
    for (int n = 0; n < 50; ++n) {
      const Eigen::VectorXd action = robot.random_action(rng);
      const auto truth = robot.poses_in_camera(action);
      for (const auto& [part, X_RB] : schema.predict_all(action)) {
        sum += (schema.X_CR * X_RB.translation() - truth.at(part).translation()).norm();
        ++count;
      }
    }
    return sum / count;
  }

  test::SyntheticRobot healthy_, broken_;
  std::vector<sample_t> samples_;
  StructureLearnerConfig config_;
  std::vector<body_schema_t> proposals_;  ///< of TEST samples
};

TEST_F(RelearningTest, AfterAChangeTheBodyIsLearnedAnewFromWhatCameSince) {
  const ModelMonitor monitor = run();
  ASSERT_TRUE(monitor.schema());
  const BodySchema schema = from_message(*monitor.schema());
  ASSERT_EQ(schema.changes.size(), 1U);
  EXPECT_GE(schema.changes[0].found, kBrokenAt);
  EXPECT_LE(schema.changes[0].found, kBrokenAt + 5);
  EXPECT_GE(schema.changes[0].since, kBrokenAt);
  for (const body_schema_t& proposal : proposals_) {
    for (const schema_edge_t& edge : proposal.edges) {
      EXPECT_EQ(edge.valid_since_sample,
                proposal.last_sample_index < schema.changes[0].found ? 0 : schema.changes[0].since);
    }
  }
  // The monitor's own replacement rests on the first samples after the change; the model learned
  // from all of them stands in the end.
  EXPECT_GT(monitor.memory().at_base.judged_sample, kBrokenAt + 40);
  EXPECT_TRUE(test::is_right(schema, broken_));
  EXPECT_LT(error(schema), 0.002);
  for (const health_event_t& event : monitor.health().events)
    EXPECT_NE(event.event_kind, health_event_t::EVENT_REVERTED) << event.event_text;
}

TEST_F(RelearningTest, ALearnerThatIsLateEndsWithTheSameSchema) {
  const auto expected = encode(kBodySchema, *run().schema());
  for (const int late : {1, 4, 13})
    EXPECT_EQ(encode(kBodySchema, *run(late).schema()), expected) << late;
  // A change has settled long after it was published.
  for (const std::size_t heard_late : {1, 5, 30})
    EXPECT_EQ(encode(kBodySchema, *run(0, kEnd, heard_late).schema()), expected) << heard_late;
}

TEST_F(RelearningTest, WhatWasLearnedFromFewSamplesSinceDoesNotReplaceWhatPredictsBetter) {
  const std::int64_t last = kEnd - 1;
  ModelMonitor monitor = run(0, last);
  const auto few = std::find_if(proposals_.begin(), proposals_.end(), [](const auto& proposal) {
    return proposal.is_complete && proposal.edges[0].valid_since_sample > 0;
  });
  ASSERT_NE(few, proposals_.end());
  ASSERT_LT(few->num_samples_seen, 20);
  body_schema_t proposal = *few;
  proposal.last_sample_index = last;
  const auto before = encode(kBodySchema, *monitor.schema());
  monitor.on_sample(samples_.back());
  EXPECT_TRUE(monitor.on_learned_schema(proposal));
  EXPECT_EQ(encode(kBodySchema, *monitor.schema()), before);
}

TEST_F(RelearningTest, AJointThatWasStuckForLongMovesAgainWhenItIsRepaired) {
  broken_ = healthy_;
  test::TrueLink& link = second_moving(&broken_);
  link.turn = link.slide = 0;
  Rng rng(8);
  babble(rng, 140);
  const ModelMonitor monitor = run();
  ASSERT_TRUE(monitor.schema());
  const BodySchema schema = from_message(*monitor.schema());
  EXPECT_TRUE(schema.complete);
  EXPECT_TRUE(test::is_right(schema, healthy_));
  EXPECT_LT(error(schema, healthy_), 0.003);
  // Meanwhile the learner had found a body without that joint.
  EXPECT_TRUE(std::any_of(proposals_.begin(), proposals_.end(), [](const auto& proposal) {
    return proposal.is_complete && from_message(proposal).unused_signals().size() == 1;
  }));
}

}  // namespace
}  // namespace bodyschema
