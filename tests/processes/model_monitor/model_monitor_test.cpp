#include "processes/model_monitor/model_monitor.h"

#include <gtest/gtest.h>
#include <unistd.h>

#include <filesystem>
#include <fstream>

#include "common/bus/check.h"
#include "common/bus/codec.h"
#include "common/bus/convert.h"
#include "common/config/yaml.h"
#include "common/geometry/angle.h"
#include "processes/model_monitor/adaptation.h"
#include "processes/structure_learner/learn.h"
#include "tests/support/broken_arm.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Rng;
using Bytes = std::vector<std::uint8_t>;

ModelMonitorConfig test_config() {
  return {.max_mahalanobis2 = 20.06,
          .max_outlier_share = 0.2,
          .measurement = {.systematic = kTagSystematic}};
}

Bytes bytes_of(const ModelMonitor& monitor) {
  EXPECT_TRUE(monitor.schema());
  return monitor.schema() ? encode(kBodySchema, *monitor.schema()) : Bytes();
}

/// Health without the history of how it came about.
Bytes judgement_of(const ModelMonitor& monitor) {
  model_health_t health = monitor.health();
  set_array(health.num_events, health.events, {});
  return encode(kModelHealth, health);
}

Matrix6d covariance(double position_m, double rotation_rad) {
  Vector6d diagonal;
  diagonal << Eigen::Vector3d::Constant(position_m * position_m),
      Eigen::Vector3d::Constant(rotation_rad * rotation_rad);
  return diagonal.asDiagonal();
}

PartObservation observation(int part, const Pose& X_CB, double position_m, double rotation_rad) {
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
    robot_ = test::chapter_robot("a", rng);
    const test::ObservationOptions options{
        .regime = test::Regime::kTag, .with_covariances = true, .with_other_hypothesis = true};
    samples_ = test::babble(robot_, kNumSamples, options, rng);
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

  test::SyntheticRobot robot_;
  std::vector<ActionPoseSample> samples_;
};

TEST_F(ModelMonitorTest, SaysNothingBeforeTheFirstProposal) {
  const ModelMonitor monitor = monitor_at(44);
  EXPECT_FALSE(monitor.schema());
  EXPECT_EQ(monitor.health().judged_sample, -1);
  EXPECT_EQ(monitor.health().schema_complete, 0);
  EXPECT_EQ(monitor.health().worst_position_m, -1);
  EXPECT_EQ(check(monitor.health()), "");
}

TEST_F(ModelMonitorTest, NothingBecomesTheBodySchemaWithoutATest) {
  for (ActionPoseSample& sample : samples_) sample.purpose = Purpose::kTrain;
  ModelMonitor monitor = monitor_at(44);
  EXPECT_FALSE(monitor.on_learned_schema(proposal(44)));
  EXPECT_FALSE(monitor.schema());
  EXPECT_EQ(monitor.health().judged_sample, -1);
  EXPECT_EQ(monitor.health().schema_version, 0);
  EXPECT_EQ(monitor.health().num_events, 0);
  EXPECT_EQ(check(monitor.health()), "");
}

TEST_F(ModelMonitorTest, TestsAfterTheProposalDoNotCount) {
  ModelMonitor monitor = monitor_at(44);
  EXPECT_TRUE(monitor.on_learned_schema(proposal(29)));
  ASSERT_TRUE(monitor.schema());
  EXPECT_EQ(monitor.health().num_test_samples, 6);
  ModelMonitor earlier = monitor_at(29);
  earlier.on_learned_schema(proposal(29));
  EXPECT_EQ(bytes_of(monitor), bytes_of(earlier));
  EXPECT_EQ(judgement_of(monitor), judgement_of(earlier));
}

TEST_F(ModelMonitorTest, OnlyAProposalThatEndsWithATestIsJudged) {
  ModelMonitor monitor = monitor_at(44);
  for (std::int64_t i = 0; i < kNumSamples; ++i) {
    BodySchema schema = learned(29);
    schema.last_sample_index = i;
    EXPECT_EQ(monitor.on_learned_schema(to_message(schema)), i % 5 == 4) << i;
  }
}

TEST_F(ModelMonitorTest, ARightSchemaIsAccepted) {
  ModelMonitor monitor = monitor_at(44);
  const body_schema_t right = proposal(44);
  ASSERT_TRUE(test::is_right(from_message(right), robot_));
  EXPECT_TRUE(monitor.on_learned_schema(right));
  ASSERT_TRUE(monitor.schema());
  EXPECT_EQ(check(*monitor.schema()), "");
  EXPECT_TRUE(test::is_right(from_message(*monitor.schema()), robot_));
  EXPECT_EQ(monitor.schema()->schema_version, 45);
  EXPECT_EQ(monitor.schema()->last_sample_index, 44);
  EXPECT_EQ(monitor.schema()->utime, right.utime);
  for (const auto& edge : monitor.schema()->edges) EXPECT_EQ(edge.state, schema_edge_t::EDGE_OK);

  const model_health_t& health = monitor.health();
  EXPECT_EQ(check(health), "");
  EXPECT_EQ(health.schema_version, 45);
  EXPECT_EQ(health.judged_sample, 44);
  EXPECT_EQ(health.schema_complete, 1);
  EXPECT_EQ(health.num_test_samples, 9);
  EXPECT_EQ(health.num_edges, 4);
  EXPECT_EQ(health.num_parts, 5);
  EXPECT_GE(health.worst_position_m, 0);
  EXPECT_LT(health.worst_position_m, 0.015);
  ASSERT_EQ(health.num_events, 1);
  EXPECT_EQ(health.events[0].event_kind, health_event_t::EVENT_SCHEMA_ACCEPTED);
  EXPECT_EQ(health.events[0].event_sample, 44);
}

TEST_F(ModelMonitorTest, ARightSchemaOfAnyRobotIsAcceptedAndOneWrongEdgeIsNot) {
  Rng rng(32);
  for (int run = 0; run < 12; ++run) {
    robot_ = test::chapter_robot(run % 2 ? "a" : "c", rng);
    const test::ObservationOptions options{
        .regime = test::Regime::kTag, .with_covariances = true, .with_other_hypothesis = true};
    samples_ = test::babble(robot_, 60, options, rng);
    for (ActionPoseSample& sample : samples_) {
      if (sample.sample_index % 5 == 4) sample.purpose = Purpose::kTest;
    }
    const BodySchema right = learned(59);
    if (!test::is_right(right, robot_)) continue;  // the learner's matter
    ModelMonitor monitor = monitor_at(59);
    monitor.on_learned_schema(to_message(right));
    EXPECT_TRUE(monitor.schema()) << "run " << run << ": "
                                  << (monitor.health().num_events
                                          ? monitor.health().events.back().event_text
                                          : "");

    for (std::size_t i = 0; i < right.edges.size(); ++i) {
      BodySchema wrong = right;
      Vector6d error = 20 * Vector6d::Unit(static_cast<int>(test::uniform(rng, 0, 6)));
      error.head<3>() *= 0.003;
      error.tail<3>() *= 1 * kDegree;
      wrong.edges[i].right = wrong.edges[i].right * exp(error);
      ModelMonitor other = monitor_at(59);
      EXPECT_TRUE(other.on_learned_schema(to_message(wrong)));
      EXPECT_FALSE(other.schema()) << "run " << run << ", edge " << i;
      ASSERT_EQ(other.health().num_events, 1);
      const health_event_t& event = other.health().events[0];
      EXPECT_EQ(event.event_kind, health_event_t::EVENT_SCHEMA_REFUSED);
      const std::string edge = "edge " + std::to_string(wrong.edges[i].from) + "-" +
                               std::to_string(wrong.edges[i].to) + " refuted";
      EXPECT_EQ(event.event_text.rfind(edge, 0), 0U) << event.event_text;
    }
  }
}

TEST_F(ModelMonitorTest, AnEdgeWithTheWrongSignalIsRefused) {
  BodySchema wrong = learned(44);
  int changed = 0;
  for (Edge& edge : wrong.edges) {
    for (ScrewJoint& joint : edge.joints) {
      if (joint.signal == 1) {
        joint.signal = 0;
        ++changed;
      }
    }
  }
  ASSERT_GT(changed, 0);
  ModelMonitor monitor = monitor_at(44);
  EXPECT_TRUE(monitor.on_learned_schema(to_message(wrong)));
  EXPECT_FALSE(monitor.schema());
}

TEST_F(ModelMonitorTest, ARefusedProposalLeavesTheBodySchemaAsItIs) {
  ModelMonitor monitor = monitor_at(44);
  monitor.on_learned_schema(proposal(39));
  const Bytes before = bytes_of(monitor);
  BodySchema wrong = learned(44);
  wrong.edges[0].right.translation().x() += 0.2;
  EXPECT_TRUE(monitor.on_learned_schema(to_message(wrong)));
  EXPECT_EQ(bytes_of(monitor), before);
  EXPECT_EQ(monitor.health().schema_version, 40);
  EXPECT_EQ(monitor.health().judged_sample, 44);
  EXPECT_EQ(monitor.health().num_test_samples, 9);
  EXPECT_EQ(monitor.health().utime, samples_[44].utime);
  EXPECT_EQ(check(monitor.health()), "");
}

TEST_F(ModelMonitorTest, FlipsOfPlanarMarkersDoNotRefute) {
  const BodySchema right = learned(44);
  for (ActionPoseSample& sample : samples_) {
    if (sample.purpose != Purpose::kTest) continue;
    const auto truth = robot_.poses_in_camera(sample.action);
    for (PartObservation& part : sample.parts) {
      // The wrong hypothesis came first, the right one second.
      part.X_CB_other = truth.at(part.part);
      part.X_CB = truth.at(part.part);
      part.X_CB.linear() *= exp_so3({60 * kDegree, 0, 0});
      part.error_ratio = 1.1;
    }
  }
  ModelMonitor monitor = monitor_at(44);
  monitor.on_learned_schema(to_message(right));
  EXPECT_TRUE(monitor.schema());

  // Without the second hypothesis the same poses speak against it.
  for (ActionPoseSample& sample : samples_) {
    for (PartObservation& part : sample.parts) {
      part.X_CB_other.reset();
      part.error_ratio = 0;
      part.X_CB.linear() *= exp_so3({0, 30 * kDegree, 0}).matrix();
      part.X_CB.translation().x() += 0.1 * part.part;
    }
  }
  ModelMonitor strict = monitor_at(44);
  strict.on_learned_schema(to_message(right));
  EXPECT_FALSE(strict.schema());
}

TEST_F(ModelMonitorTest, OneRefutingTestIsTakenForAnOutlierTwoOfNineAreNot) {
  const BodySchema right = learned(44);
  const int moved = right.edges.back().to;
  for (const int num_refuting : {0, 1, 2}) {
    int refuting = 0, num_tests = 0;
    std::vector<ActionPoseSample> samples = samples_;
    for (ActionPoseSample& sample : samples) {
      if (sample.purpose != Purpose::kTest) continue;
      const auto truth = robot_.poses_in_camera(sample.action);
      sample.parts.clear();
      for (const auto& [part, X_CB] : truth) {
        PartObservation o = observation(part, X_CB, 0.002, 0.01);
        if (part == moved && refuting < num_refuting) {
          o.X_CB.translation().y() += 0.3;
          ++refuting;
        }
        sample.parts.push_back(o);
      }
      ++num_tests;
    }
    ASSERT_EQ(num_tests, 9);
    ModelMonitor monitor(test_config());
    for (const ActionPoseSample& sample : samples) monitor.on_sample(to_message(sample));
    monitor.on_learned_schema(to_message(right));
    EXPECT_EQ(monitor.schema().has_value(), num_refuting < 2) << num_refuting;
  }
}

TEST_F(ModelMonitorTest, OfAcceptancesInARowTheNewestIsAnEvent) {
  ModelMonitor monitor = monitor_at(44);
  for (const int last : {34, 39, 44}) {
    monitor.on_learned_schema(proposal(last));
    ASSERT_EQ(monitor.health().num_events, 1);
    EXPECT_EQ(monitor.health().events[0].event_sample, last);
  }
  EXPECT_EQ(monitor.health().events[0].event_number, 2);
}

TEST_F(ModelMonitorTest, AnEdgeThatNoTestCouldJudgeIsProvisional) {
  const BodySchema right = learned(44);
  const Edge& edge = right.edges.back();
  for (ActionPoseSample& sample : samples_) {
    if (sample.purpose != Purpose::kTest) continue;
    std::erase_if(sample.parts, [&](const auto& part) { return part.part == edge.to; });
  }
  ModelMonitor monitor = monitor_at(44);
  monitor.on_learned_schema(to_message(right));
  ASSERT_TRUE(monitor.schema());
  for (std::size_t i = 0; i < right.edges.size(); ++i) {
    const bool is_tested = right.edges[i].from != edge.to && right.edges[i].to != edge.to;
    const auto expected = is_tested ? schema_edge_t::EDGE_OK : schema_edge_t::EDGE_PROVISIONAL;
    EXPECT_EQ(monitor.schema()->edges[i].state, expected);
    EXPECT_EQ(monitor.health().edge_health[i].edge_state, expected);
    EXPECT_EQ(monitor.health().edge_health[i].num_tests > 0, is_tested);
    EXPECT_EQ(monitor.health().edge_health[i].median_mahalanobis2 >= 0, is_tested);
  }
}

TEST_F(ModelMonitorTest, ThereIsNoStepBackFromCompleteToIncomplete) {
  ModelMonitor monitor = monitor_at(44);
  monitor.on_learned_schema(proposal(39));
  ASSERT_EQ(monitor.health().schema_complete, 1);
  const Bytes before = bytes_of(monitor);

  BodySchema incomplete = learned(44);
  const int lost = incomplete.edges.back().to;
  incomplete.edges.pop_back();
  incomplete.complete = false;
  incomplete.unconnected = {{lost, Unconnected::kNotEnoughData, ""}};
  EXPECT_TRUE(monitor.on_learned_schema(to_message(incomplete)));
  EXPECT_EQ(bytes_of(monitor), before);
  EXPECT_EQ(monitor.health().events.back().event_kind, health_event_t::EVENT_SCHEMA_REFUSED);
  EXPECT_EQ(monitor.health().schema_complete, 1);

  // An incomplete one is better than none.
  ModelMonitor fresh = monitor_at(44);
  EXPECT_TRUE(fresh.on_learned_schema(to_message(incomplete)));
  ASSERT_TRUE(fresh.schema());
  EXPECT_EQ(fresh.health().schema_complete, 0);
}

TEST_F(ModelMonitorTest, BeginsWithASchemaOfBeforeAndIsHeardOfItAtOnce) {
  body_schema_t schema = proposal(44);
  schema.schema_version = 0;
  schema.last_sample_index = -1;
  ModelMonitor monitor(test_config());
  monitor.start_from(schema);
  ASSERT_TRUE(monitor.schema());
  EXPECT_EQ(monitor.health().edge_health.size(), schema.edges.size());
  EXPECT_EQ(check(monitor.health()), "");
  const Edge broken = break_last_joint(30);
  for (std::int64_t i = 0; i < kNumSamples; ++i) monitor.on_sample(sample(i));
  EXPECT_EQ(check(monitor.health()), "");
  const auto& events = monitor.health().events;
  EXPECT_TRUE(std::any_of(events.begin(), events.end(), [&](const health_event_t& e) {
    return e.event_kind == health_event_t::EVENT_CANDIDATE && e.event_to == broken.to &&
           e.event_cause == health_event_t::CAUSE_JOINT_STUCK;
  }));
}

TEST_F(ModelMonitorTest, AMarkerIsMissedAsLongAsItIsGoneWhateverIsProposed) {
  int part = 0;
  for (const PartObservation& o : samples_.front().parts) part = std::max(part, o.part);
  for (ActionPoseSample& sample : samples_)
    if (sample.sample_index >= 20)
      std::erase_if(sample.parts, [part](const PartObservation& o) { return o.part == part; });
  ModelMonitor monitor(test_config());
  bool is_told = false;
  for (std::int64_t i = 0; i < kNumSamples; ++i) {
    monitor.on_sample(sample(i));
    if (i % 5 == 4) monitor.on_learned_schema(proposal(i));
    const auto& parts = monitor.health().part_health;
    const bool is_unseen = std::any_of(parts.begin(), parts.end(), [part](const auto& health) {
      return health.health_part == part && health.is_unseen != 0;
    });
    EXPECT_TRUE(is_unseen || !is_told) << i;
    is_told |= is_unseen;
  }
  EXPECT_TRUE(is_told);
}

TEST_F(ModelMonitorTest, AProposalAheadOfTheSamplesWaitsForThem) {
  ModelMonitor in_order = monitor_at(44);
  in_order.on_learned_schema(proposal(44));

  ModelMonitor monitor = monitor_at(30);
  EXPECT_FALSE(monitor.on_learned_schema(proposal(44)));
  EXPECT_FALSE(monitor.schema());
  for (std::int64_t i = 31; i < 44; ++i) EXPECT_FALSE(monitor.on_sample(sample(i)));
  EXPECT_TRUE(monitor.on_sample(sample(44)));
  EXPECT_EQ(bytes_of(monitor), bytes_of(in_order));
  EXPECT_EQ(judgement_of(monitor), judgement_of(in_order));
}

TEST_F(ModelMonitorTest, WaitingProposalsAreJudgedInOrderHoweverTheyCame) {
  ModelMonitor monitor = monitor_at(30);
  EXPECT_FALSE(monitor.on_learned_schema(proposal(44)));
  EXPECT_FALSE(monitor.on_learned_schema(proposal(39)));
  for (std::int64_t i = 31; i <= 39; ++i) monitor.on_sample(sample(i));
  ASSERT_TRUE(monitor.schema());
  EXPECT_EQ(monitor.schema()->schema_version, 40);
  for (std::int64_t i = 40; i <= 44; ++i) monitor.on_sample(sample(i));
  EXPECT_EQ(monitor.schema()->schema_version, 45);
}

TEST_F(ModelMonitorTest, ProposalsFromNowhereDoNotDisplaceTheNextOne) {
  ModelMonitor monitor = monitor_at(30);
  body_schema_t nowhere = proposal(44);
  for (std::int64_t n = 0; n < 100; ++n) {
    nowhere.last_sample_index = 1'000'000 + n;
    EXPECT_FALSE(monitor.on_learned_schema(nowhere));
  }
  EXPECT_FALSE(monitor.on_learned_schema(proposal(34)));
  for (std::int64_t i = 31; i <= 34; ++i) monitor.on_sample(sample(i));
  ASSERT_TRUE(monitor.schema());
  EXPECT_EQ(monitor.schema()->schema_version, 35);
}

TEST_F(ModelMonitorTest, AProposalIsJudgedOnce) {
  ModelMonitor monitor = monitor_at(44);
  EXPECT_TRUE(monitor.on_learned_schema(proposal(44)));
  const Bytes bytes = bytes_of(monitor);
  for (int i = 0; i < 10; ++i) {
    EXPECT_FALSE(monitor.on_learned_schema(proposal(44)));
    EXPECT_FALSE(monitor.on_learned_schema(proposal(30 + i)));
  }
  EXPECT_EQ(bytes_of(monitor), bytes);
  EXPECT_EQ(monitor.health().num_events, 1);
}

/// The refiner's answer to a proposal.
body_schema_t answer_to(body_schema_t proposal) {
  std::vector<wanted_action_t> wanted(2);
  for (int n = 0; n < 2; ++n)
    set_array(wanted[n].num_signals, wanted[n].wanted_action,
              std::vector<double>(proposal.signals.size(),
                                  0.1 * n + 1e-3 * double(proposal.last_sample_index)));
  set_array(proposal.num_wanted, proposal.wanted_actions, wanted);
  return proposal;
}
ModelMonitorConfig with_refiner(std::int64_t refine_every) {
  ModelMonitorConfig config = test_config();
  config.refine_every = refine_every;
  return config;
}
constexpr std::int64_t kSecond = 1'000'000;

TEST_F(ModelMonitorTest, AProposalThatTheRefinerAnswersWaitsForIt) {
  ModelMonitor monitor(with_refiner(20));
  for (std::int64_t i = 0; i <= 34; ++i) monitor.on_sample(sample(i));
  // 14 is not due, 19 is.
  EXPECT_TRUE(monitor.on_learned_schema(proposal(14)));
  EXPECT_FALSE(monitor.on_learned_schema(proposal(19)));
  EXPECT_EQ(monitor.health().judged_sample, 14);
  EXPECT_EQ(monitor.health().awaited_refinement, 19);
  EXPECT_EQ(check(monitor.health()), "");
  // Nor are later ones judged before it.
  EXPECT_FALSE(monitor.on_learned_schema(proposal(24)));
  EXPECT_TRUE(monitor.on_refined_schema(answer_to(proposal(19))));
  EXPECT_EQ(monitor.health().judged_sample, 24);
  EXPECT_EQ(monitor.health().awaited_refinement, -1);
  EXPECT_EQ(monitor.schema()->schema_version, 25);
  // Repeated.
  EXPECT_FALSE(monitor.on_refined_schema(answer_to(proposal(19))));
}

TEST_F(ModelMonitorTest, TheVerdictDoesNotDependOnTheOrderOfLearnerRefinerAndSamples) {
  const auto judged = [&](const std::string& order) {
    ModelMonitor monitor(with_refiner(20));
    for (std::int64_t i = 0; i < 39; ++i) monitor.on_sample(sample(i));
    for (const char what : order)
      if (what == 'S')
        monitor.on_sample(sample(39));
      else if (what == 'L')
        monitor.on_learned_schema(proposal(39));
      else
        monitor.on_refined_schema(answer_to(proposal(39)));
    EXPECT_EQ(monitor.health().judged_sample, 39);
    EXPECT_EQ(monitor.health().wanted_sample, 39);
    EXPECT_EQ(encode(kBodySchema, *monitor.schema()), bytes_of(monitor));
    return encode(kModelHealth, monitor.health());
  };
  const Bytes expected = judged("SLR");
  for (const char* order : {"SRL", "LSR", "LRS", "RSL", "RLS"}) EXPECT_EQ(judged(order), expected);
}

TEST_F(ModelMonitorTest, AnIncompleteProposalDoesNotWaitForTheRefiner) {
  ModelMonitor monitor(with_refiner(20));
  for (std::int64_t i = 0; i <= 19; ++i) monitor.on_sample(sample(i));
  body_schema_t incomplete = proposal(19);
  incomplete.is_complete = 0;
  EXPECT_TRUE(monitor.on_learned_schema(incomplete));
  EXPECT_EQ(monitor.health().awaited_refinement, -1);
}

TEST_F(ModelMonitorTest, ASilentRefinerIsGivenUpOnceUntilItIsHeardAgain) {
  ModelMonitor monitor(with_refiner(10));
  for (std::int64_t i = 0; i <= 39; ++i) monitor.on_sample(sample(i));
  EXPECT_FALSE(monitor.on_learned_schema(proposal(9)));
  EXPECT_FALSE(monitor.on_tick(100 * kSecond));
  // The learner repeats itself.
  EXPECT_FALSE(monitor.on_learned_schema(proposal(9)));
  EXPECT_FALSE(monitor.on_tick(130 * kSecond));
  EXPECT_TRUE(monitor.on_tick(131 * kSecond));
  EXPECT_EQ(monitor.health().judged_sample, 9);
  EXPECT_FALSE(monitor.on_tick(200 * kSecond));
  EXPECT_TRUE(monitor.on_learned_schema(proposal(19)));
  EXPECT_TRUE(monitor.on_refined_schema(answer_to(proposal(19))));
  EXPECT_FALSE(monitor.on_learned_schema(proposal(29)));
  EXPECT_EQ(monitor.health().awaited_refinement, 29);
}

TEST_F(ModelMonitorTest, WantedActionsArePassedOnWithTheVerdictUntilThereAreNewerOnes) {
  ModelMonitor monitor(with_refiner(20));
  for (std::int64_t i = 0; i <= 19; ++i) monitor.on_sample(sample(i));
  monitor.on_refined_schema(answer_to(proposal(19)));
  EXPECT_EQ(monitor.health().wanted_sample, -1);
  EXPECT_EQ(monitor.health().num_wanted, 0);
  monitor.on_learned_schema(proposal(19));
  for (std::int64_t i = 20; i < kNumSamples; ++i) {
    EXPECT_EQ(monitor.health().wanted_sample, i <= 39 ? 19 : 39) << i;
    EXPECT_EQ(monitor.health().num_wanted, 2);
    EXPECT_DOUBLE_EQ(monitor.health().wanted_actions[1].wanted_action[0], i <= 39 ? 0.119 : 0.139);
    EXPECT_EQ(check(monitor.health()), "");
    EXPECT_EQ(monitor.schema()->num_wanted, 0);
    monitor.on_sample(sample(i));
    if (i % 5 == 4) monitor.on_learned_schema(proposal(i));
    if (i == 39) monitor.on_refined_schema(answer_to(proposal(i)));
  }
}

TEST_F(ModelMonitorTest, WantedActionsAreDroppedOnceTheBodyIsAnotherThanTheyAreFor) {
  break_last_joint(30);
  ModelMonitor monitor(with_refiner(20));
  std::int64_t changed = -1;
  for (std::int64_t i = 0; i < kNumSamples; ++i) {
    monitor.on_sample(sample(i));
    if (i == 19) monitor.on_refined_schema(answer_to(proposal(19)));
    if (i % 5 == 4) monitor.on_learned_schema(proposal(std::min<int64_t>(i, 29), i));
    if (i < 19) continue;
    if (changed < 0 && monitor.schema()->num_changes > 0) changed = i;
    EXPECT_EQ(monitor.health().wanted_sample, changed < 0 ? 19 : -1) << i;
    EXPECT_EQ(check(monitor.health()), "");
  }
  EXPECT_GE(changed, 30);

  // So they are where the tree is another.
  ModelMonitor other(with_refiner(20));
  for (std::int64_t i = 0; i <= 39; ++i) other.on_sample(sample(i));
  body_schema_t answer = answer_to(proposal(39));
  std::swap(answer.edges[0].from_part, answer.edges[0].to_part);
  other.on_refined_schema(answer);
  other.on_learned_schema(proposal(39));
  EXPECT_EQ(other.health().judged_sample, 39);
  EXPECT_EQ(other.health().wanted_sample, -1);
}

TEST_F(ModelMonitorTest, TheSameBytesComeOutWhateverPrefixesWereSkipped) {
  ModelMonitor only_last = monitor_at(44);
  only_last.on_learned_schema(proposal(44));
  const Bytes expected = bytes_of(only_last);
  const Bytes judgement = judgement_of(only_last);
  Rng rng(33);
  for (int run = 0; run < 10; ++run) {
    ModelMonitor monitor(test_config());
    for (std::int64_t i = 0; i < kNumSamples; ++i) {
      monitor.on_sample(sample(i));
      if (i % 5 == 4 && (i == 44 || test::uniform(rng, 0, 1) < 0.5))
        monitor.on_learned_schema(proposal(i));
    }
    EXPECT_EQ(bytes_of(monitor), expected);
    EXPECT_EQ(judgement_of(monitor), judgement);
  }
}

TEST_F(ModelMonitorTest, AnyOrderOfMessagesEndsInTheSameSchemaAndNeverRunsBackwards) {
  ModelMonitor in_order = monitor_at(44);
  in_order.on_learned_schema(proposal(44));
  std::map<std::int64_t, body_schema_t> proposals;
  for (std::int64_t i = 3; i < kNumSamples; ++i) proposals[i] = proposal(i);
  Rng rng(34);
  for (int run = 0; run < 50; ++run) {
    ModelMonitor monitor(test_config());
    std::int64_t next = 0, version = 0, judged = -1;
    const auto look = [&] {
      const model_health_t& health = monitor.health();
      ASSERT_EQ(check(health), "");
      ASSERT_GE(health.judged_sample, judged);
      ASSERT_GE(health.schema_version, version);
      judged = health.judged_sample;
      version = health.schema_version;
      if (monitor.schema()) {
        ASSERT_EQ(check(*monitor.schema()), "");
        ASSERT_EQ(monitor.schema()->schema_version, version);
        ASSERT_EQ(version, monitor.schema()->last_sample_index + 1);
      }
    };
    while (next < kNumSamples) {
      const double what = test::uniform(rng, 0, 1);
      if (what < 0.6) {
        monitor.on_sample(sample(next++));
      } else if (what < 0.7) {
        monitor.on_sample(sample(static_cast<std::int64_t>(test::uniform(rng, 0, next))));
      } else {
        const auto i = static_cast<int>(test::uniform(rng, 0, double(proposals.size())));
        monitor.on_learned_schema(std::next(proposals.begin(), i)->second);
      }
      look();
      ASSERT_FALSE(HasFatalFailure()) << "run " << run;
    }
    monitor.on_learned_schema(proposals.at(44));
    EXPECT_EQ(bytes_of(monitor), bytes_of(in_order)) << "run " << run;
    EXPECT_EQ(judgement_of(monitor), judgement_of(in_order)) << "run " << run;
  }
}

TEST_F(ModelMonitorTest, TheNewestThirtyTwoEventsAreKeptAndNumbered) {
  ModelMonitor monitor = monitor_at(9);
  const BodySchema complete = learned(44);
  BodySchema incomplete = complete;
  incomplete.unconnected = {{incomplete.edges.back().to, Unconnected::kNotEnoughData, ""}};
  incomplete.edges.pop_back();
  incomplete.complete = false;
  for (std::int64_t n = 0; n < 100; ++n) {
    BodySchema schema = n % 2 ? incomplete : complete;
    ActionPoseSample later = samples_[9];
    later.sample_index = 10 + n;
    later.utime += 1'000'000 * (n + 1);
    monitor.on_sample(to_message(later));
    schema.last_sample_index = later.sample_index;
    schema.utime = later.utime;
    ASSERT_TRUE(monitor.on_learned_schema(to_message(schema)));
    const model_health_t& health = monitor.health();
    ASSERT_EQ(health.num_events, std::min<std::int64_t>(n + 1, 32));
    EXPECT_EQ(health.events.back().event_number, n);
    for (std::size_t i = 1; i < health.events.size(); ++i)
      EXPECT_EQ(health.events[i].event_number, health.events[i - 1].event_number + 1);
  }
  EXPECT_EQ(check(monitor.health()), "");
}

TEST_F(ModelMonitorTest, ASchemaToStartFromIsPublishedAndStandsAgainstWorse) {
  ModelMonitor before = monitor_at(39);
  before.on_learned_schema(proposal(39));
  ASSERT_TRUE(before.schema());

  ModelMonitor monitor(test_config());
  monitor.start_from(*before.schema());
  EXPECT_EQ(bytes_of(monitor), bytes_of(before));
  for (std::int64_t i = 0; i <= 39; ++i) monitor.on_sample(sample(i));
  EXPECT_EQ(bytes_of(monitor), bytes_of(before));
  EXPECT_EQ(judgement_of(monitor), judgement_of(before));

  EXPECT_FALSE(monitor.on_learned_schema(proposal(39)));
  EXPECT_FALSE(monitor.on_learned_schema(proposal(14)));
  BodySchema incomplete = learned(44);
  incomplete.edges.pop_back();
  incomplete.complete = false;
  for (std::int64_t i = 40; i <= 44; ++i) monitor.on_sample(sample(i));
  EXPECT_TRUE(monitor.on_learned_schema(to_message(incomplete)));
  EXPECT_EQ(bytes_of(monitor), bytes_of(before));
}

TEST_F(ModelMonitorTest, ARestartAtAnyMomentIsAsIfNothingHadHappened) {
  // The joint of the last edge sticks from sample 27 on; the learner proposes nothing right then.
  break_last_joint(27);
  const auto hear = [&](ModelMonitor* monitor, std::int64_t i) {
    monitor->on_sample(sample(i));
    if (i % 5 == 4)
      monitor->on_learned_schema(i == 9 ? wrong(9) : proposal(std::min<int64_t>(i, 24), i));
  };
  ModelMonitor undisturbed(test_config());
  for (std::int64_t i = 0; i < kNumSamples; ++i) hear(&undisturbed, i);
  ASSERT_GT(undisturbed.health().num_events, 2);
  for (std::int64_t killed_after = 0; killed_after < kNumSamples; ++killed_after) {
    ModelMonitor before(test_config());
    for (std::int64_t i = 0; i <= killed_after; ++i) hear(&before, i);
    ModelMonitor monitor(test_config());
    monitor.restore(before.memory());
    for (std::int64_t i = 0; i <= killed_after; ++i) monitor.on_sample(sample(i));
    EXPECT_EQ(monitor.schema().has_value(), before.schema().has_value());
    if (before.schema()) {
      EXPECT_EQ(bytes_of(monitor), bytes_of(before)) << killed_after;
    }
    EXPECT_EQ(encode(kModelHealth, monitor.health()), encode(kModelHealth, before.health()))
        << killed_after;
    for (std::int64_t i = killed_after + 1; i < kNumSamples; ++i) hear(&monitor, i);
    EXPECT_EQ(bytes_of(monitor), bytes_of(undisturbed)) << killed_after;
    EXPECT_EQ(encode(kModelHealth, monitor.health()), encode(kModelHealth, undisturbed.health()))
        << killed_after;
  }
}

TEST_F(ModelMonitorTest, AChangeInTheYouthIsHeldBackThenToldWheneverItIsKilledOrLate) {
  // The first structure is one of sample 9, the joint sticks from 13 on; the learner goes on with
  // the samples of both bodies.
  break_last_joint(13);
  std::map<std::int64_t, body_schema_t> proposals;
  for (std::int64_t i = 9; i < kNumSamples; i += 5) proposals[i] = proposal(i);
  const auto is_about = [](const health_event_t& e) {
    return e.event_kind == health_event_t::EVENT_CANDIDATE &&
           e.event_cause == health_event_t::CAUSE_JOINT_STUCK;
  };
  ModelMonitor undisturbed(test_config());
  std::vector<MonitorMemory> memories;
  std::vector<model_health_t> healths;
  std::int64_t told_at = -1, found_at = -1;
  for (std::int64_t i = 0; i < kNumSamples; ++i) {
    undisturbed.on_sample(sample(i));
    if (proposals.contains(i)) undisturbed.on_learned_schema(proposals.at(i));
    memories.push_back(undisturbed.memory());
    healths.push_back(undisturbed.health());
    EXPECT_EQ(check(undisturbed.health()), "");
    const auto& events = undisturbed.health().events;
    const auto told = std::find_if(events.begin(), events.end(), is_about);
    if (told == events.end() || told_at >= 0) continue;
    told_at = i;
    found_at = told->event_sample;
    ASSERT_EQ(undisturbed.schema()->schema_version, i + 1);
    ASSERT_EQ(undisturbed.schema()->changes.size(), 1U);
    // A proposal of sample i could not rest on it.
    EXPECT_EQ(undisturbed.schema()->changes[0].found_sample, i + 1);
    EXPECT_GE(undisturbed.schema()->changes[0].since_sample, 12);
    EXPECT_EQ(check(*undisturbed.schema()), "");
  }
  EXPECT_GE(found_at, 13);
  EXPECT_LE(found_at, 18);
  EXPECT_GT(told_at, found_at);
  EXPECT_LE(told_at, 34);
  for (std::int64_t killed_after = 0; killed_after < kNumSamples; killed_after += 3) {
    const auto at = static_cast<std::size_t>(killed_after);
    ModelMonitor monitor(test_config());
    monitor.restore(memories[at]);
    for (std::int64_t i = 0; i <= killed_after; ++i) monitor.on_sample(sample(i));
    EXPECT_EQ(encode(kModelHealth, monitor.health()), encode(kModelHealth, healths[at]))
        << killed_after;
    for (std::int64_t i = killed_after + 1; i < kNumSamples; ++i) {
      monitor.on_sample(sample(i));
      if (proposals.contains(i)) monitor.on_learned_schema(proposals.at(i));
    }
    EXPECT_EQ(bytes_of(monitor), bytes_of(undisturbed)) << killed_after;
    EXPECT_EQ(encode(kModelHealth, monitor.health()), encode(kModelHealth, healths.back()))
        << killed_after;
  }
  for (const int delay : {1, 7, 20}) {
    ModelMonitor late(test_config());
    for (std::int64_t i = 0; i < kNumSamples + delay; ++i) {
      if (i < kNumSamples) late.on_sample(sample(i));
      if (proposals.contains(i - delay)) late.on_learned_schema(proposals.at(i - delay));
    }
    EXPECT_EQ(bytes_of(late), bytes_of(undisturbed)) << delay;
    EXPECT_EQ(encode(kModelHealth, late.health()), encode(kModelHealth, healths.back())) << delay;
  }
}

TEST_F(ModelMonitorTest, HoweverSlowTheLearnerIsTheSchemaIsTheSame) {
  break_last_joint(27);
  const auto proposed = [&](std::int64_t i) { return proposal(std::min<int64_t>(i, 24), i); };
  ModelMonitor in_time(test_config());
  for (std::int64_t i = 0; i < kNumSamples; ++i) {
    in_time.on_sample(sample(i));
    if (i % 5 == 4) in_time.on_learned_schema(proposed(i));
  }
  for (const int delay : {1, 3, 7, 20, 45}) {
    ModelMonitor late(test_config());
    for (std::int64_t i = 0; i < kNumSamples + delay; ++i) {
      if (i < kNumSamples) late.on_sample(sample(i));
      if ((i - delay) % 5 == 4 && i >= delay) late.on_learned_schema(proposed(i - delay));
    }
    EXPECT_EQ(bytes_of(late), bytes_of(in_time)) << delay;
    EXPECT_EQ(encode(kModelHealth, late.health()), encode(kModelHealth, in_time.health())) << delay;
  }
}

TEST_F(ModelMonitorTest, AStuckJointIsFoundPublishedAtOnceAndWhatTheLearnerSaysLaterIsPassedOver) {
  const Edge broken = break_last_joint(30);
  ModelMonitor monitor(test_config());
  std::int64_t found = -1;
  for (std::int64_t i = 0; i < kNumSamples; ++i) {
    monitor.on_sample(sample(i));
    if (i % 5 == 4) monitor.on_learned_schema(proposal(std::min<int64_t>(i, 29), i));
    ASSERT_EQ(check(monitor.health()), "");
    if (i == 29) {
      ASSERT_TRUE(monitor.schema());
      ASSERT_EQ(monitor.schema()->is_complete, 1);
      EXPECT_EQ(monitor.schema()->schema_version, 30);
    }
    for (const auto& event : monitor.health().events)
      if (event.event_kind == health_event_t::EVENT_CANDIDATE && found < 0) {
        found = i;
        EXPECT_EQ(event.event_sample, i);
        EXPECT_EQ(monitor.schema()->schema_version, i + 1);
        EXPECT_EQ(monitor.schema()->base_version, 30);
      }
  }
  EXPECT_GE(found, 30);
  EXPECT_LE(found, 35);
  // The last decision on it names the joint.
  std::int8_t cause = health_event_t::CAUSE_NONE;
  for (const auto& event : monitor.health().events) {
    if (event.event_from < 0) continue;
    EXPECT_EQ(event.event_from, broken.from);
    EXPECT_EQ(event.event_to, broken.to);
    if (event.event_kind != health_event_t::EVENT_PROBE_WANTED &&
        event.event_cause != health_event_t::CAUSE_NONE)
      cause = event.event_cause;
  }
  EXPECT_EQ(cause, health_event_t::CAUSE_JOINT_STUCK);
  for (const auto& edge : monitor.schema()->edges) {
    const bool is_broken = edge.to_part == broken.to;
    EXPECT_EQ(edge.state == schema_edge_t::EDGE_PROVISIONAL, is_broken);
    EXPECT_EQ(edge.valid_since_sample >= 30, is_broken);
    EXPECT_LE(edge.valid_since_sample, found);
  }
  EXPECT_EQ(monitor.health().judged_sample, 44);
}

TEST_F(ModelMonitorTest, ARefinedSchemaThatChangedIsNoneAnyMore) {
  break_last_joint(30);
  body_schema_t refined = proposal(29);
  refined.is_refined = 1;
  ModelMonitor monitor(test_config());
  monitor.start_from(refined);
  for (std::int64_t i = 0; i < kNumSamples; ++i) {
    monitor.on_sample(sample(i));
    EXPECT_EQ(monitor.schema()->is_refined, monitor.schema()->num_changes > 0 ? 0 : 1) << i;
  }
  EXPECT_EQ(monitor.schema()->is_refined, 0);
}

TEST_F(ModelMonitorTest, WhatIsWrongOutlivesItsEventsANewBaseAndARestart) {
  const Edge broken = break_last_joint(30);
  const auto endless = [&](std::int64_t i) {
    ActionPoseSample sample = samples_.at(i < 30 ? i : 30 + i % 15);
    sample.sample_index = i;
    sample.utime = 1'000'000 * (i + 1);
    sample.purpose = i % 5 == 4 ? Purpose::kTest : Purpose::kTrain;
    return to_message(sample);
  };
  const auto proposed = [&](std::int64_t i) {
    BodySchema schema = learned(29);
    schema.last_sample_index = i;
    schema.utime = endless(i).utime;
    return to_message(schema);
  };
  constexpr std::int64_t kLast = 574;  // more than 500 after the base: it is renewed
  ModelMonitor monitor(test_config());
  for (std::int64_t i = 0; i <= kLast; ++i) {
    monitor.on_sample(endless(i));
    if (i == 29 || i == kLast) monitor.on_learned_schema(proposed(i));
    ASSERT_EQ(check(monitor.health()), "");
    if (i <= 29) {
      ASSERT_EQ(monitor.health().num_findings, 0) << i;
    }
  }
  MonitorMemory memory = monitor.memory();
  ASSERT_EQ(memory.schemas.back().last_sample_index, kLast);
  set_array(memory.at_base.num_events, memory.at_base.events, {});
  ModelMonitor again(test_config());
  again.restore(memory);
  for (std::int64_t i = 0; i <= kLast + 5; ++i) again.on_sample(endless(i));
  for (const model_health_t& health : {monitor.health(), again.health()}) {
    ASSERT_EQ(health.num_findings, 1);
    const finding_t& finding = health.findings[0];
    EXPECT_EQ(finding.finding_state, finding_t::FINDING_CONFIRMED);
    EXPECT_EQ(finding.finding_from, broken.from);
    EXPECT_EQ(finding.finding_to, broken.to);
    EXPECT_EQ(finding.finding_cause, health_event_t::CAUSE_JOINT_STUCK);
    EXPECT_EQ(finding.finding_size.size_signal, broken.joints.front().signal);
    ASSERT_EQ(finding.finding_size.num_amounts, 1);
    EXPECT_NEAR(finding.finding_size.amount[0], 0.4, 0.02);
    EXPECT_GE(finding.finding_since, 30);
    EXPECT_LE(finding.finding_adopted, 35);
  }
}

// Parts 1 (root, 2 m before the camera) and 2 (0.1 m beside it), no joint.
BodySchema two_parts() {
  BodySchema schema;
  schema.complete = true;
  schema.parts = {1, 2};
  schema.root = 1;
  schema.X_CR.translation() = Eigen::Vector3d(0, 0, 2);
  schema.signals = {{"q1", -1, 1}};
  Edge edge;
  edge.from = 1;
  edge.to = 2;
  edge.right.translation() = Eigen::Vector3d(0.1, 0, 0);
  schema.edges = {edge};
  return schema;
}

sample_t two_parts_seen(std::int64_t index, double error_m, double error_rad, bool sees_2 = true) {
  ActionPoseSample sample;
  sample.sample_index = index;
  sample.utime = index + 1;
  sample.purpose = Purpose::kTest;
  sample.action = Eigen::VectorXd::Constant(1, 0.5);
  PartObservation one = observation(1, Pose::Identity(), 0.01, 0.1);
  one.X_CB.translation() = Eigen::Vector3d(0, 0, 2);
  PartObservation two = observation(2, Pose::Identity(), 0.01, 0.1);
  two.X_CB.translation() = Eigen::Vector3d(0.1, error_m, 2);
  two.X_CB.linear() = exp_so3({0, 0, error_rad});
  sample.parts = {one};
  if (sees_2) sample.parts.push_back(two);
  return to_message(sample);
}

TEST(ModelMonitorByHandTest, ErrorsAndVisibilityAreAsComputedByHand) {
  ModelMonitor monitor(test_config());
  monitor.on_sample(two_parts_seen(0, 0.005, 0.03));
  monitor.on_sample(two_parts_seen(1, 0.001, 0.01));
  monitor.on_sample(two_parts_seen(2, 0, 0, false));
  monitor.on_sample(two_parts_seen(3, 0.002, 0.02));
  monitor.on_sample(two_parts_seen(4, 9, 1));  // beyond the proposal
  BodySchema schema = two_parts();
  schema.last_sample_index = 3;
  EXPECT_TRUE(monitor.on_learned_schema(to_message(schema)));
  ASSERT_TRUE(monitor.schema());
  const model_health_t& health = monitor.health();
  EXPECT_EQ(health.num_test_samples, 4);
  ASSERT_EQ(health.num_parts, 2);
  EXPECT_EQ(health.part_health[0].num_predicted, 4);
  EXPECT_DOUBLE_EQ(health.part_health[0].visibility, 1);
  EXPECT_NEAR(health.part_health[0].position_median_m, 0, 1e-12);
  EXPECT_EQ(health.part_health[1].num_predicted, 3);
  EXPECT_DOUBLE_EQ(health.part_health[1].visibility, 0.75);
  EXPECT_NEAR(health.part_health[1].position_median_m, 0.002, 1e-12);
  EXPECT_NEAR(health.part_health[1].rotation_median_rad, 0.02, 1e-9);
  EXPECT_NEAR(health.worst_position_m, 0.002, 1e-12);
  EXPECT_NEAR(health.worst_rotation_rad, 0.02, 1e-9);
  // d² of sample 3: z = (0.1, 0.002, 0) turned by 0.02 about z. Σ_z = Σ_2 + Ad(z⁻¹) Σ_1 Ad(z⁻¹)ᵀ
  // + model error; the lever arm of 0.1 m makes the root's turn about z a shift along y.
  ASSERT_EQ(health.num_edges, 1);
  EXPECT_EQ(health.edge_health[0].num_tests, 3);
  const double var_p = 0.01 * 0.01, var_r = 0.1 * 0.1, model_r = 0.2 * kDegree;
  const double yy = 2 * var_p + 0.1 * 0.1 * var_r + 1e-6, rr = 2 * var_r + model_r * model_r;
  const double ry = 0.1 * var_r;
  const double det = yy * rr - ry * ry;
  const double y = 0.002, r = 0.02;
  const double d2 = (rr * y * y - 2 * ry * y * r + yy * r * r) / det;
  EXPECT_NEAR(health.edge_health[0].median_mahalanobis2, d2, 0.02 * d2);
}

TEST(ModelMonitorByHandTest, TheMedianOfAnEvenNumberIsTheMeanOfTheMiddleTwo) {
  ModelMonitor monitor(test_config());
  const double errors_m[] = {0.008, 0.001, 0.004, 0.002};
  for (int i = 0; i < 4; ++i) monitor.on_sample(two_parts_seen(i, errors_m[i], 0));
  BodySchema schema = two_parts();
  schema.last_sample_index = 3;
  monitor.on_learned_schema(to_message(schema));
  EXPECT_NEAR(monitor.health().worst_position_m, 0.003, 1e-12);
}

TEST(ModelMonitorByHandTest, SamplesOfAnotherRigDoNotEndTheProcess) {
  ModelMonitor monitor(test_config());
  BodySchema schema = two_parts();
  schema.signals.push_back({"q2", -1, 1});
  schema.last_sample_index = 1;
  schema.version = 2;
  EXPECT_NO_THROW(monitor.start_from(to_message(schema)));
  monitor.on_sample(two_parts_seen(0, 0, 0));
  monitor.on_sample(two_parts_seen(1, 0, 0));
  EXPECT_EQ(monitor.health().worst_position_m, -1);
  monitor.on_sample(two_parts_seen(2, 0, 0));
  schema.last_sample_index = 2;
  EXPECT_NO_THROW(monitor.on_learned_schema(to_message(schema)));
  EXPECT_EQ(check(monitor.health()), "");
}

TEST(ModelMonitorByHandTest, VerdictsThatWereTooManyToRememberAreCountedAfterARestart) {
  MonitorMemory memory;
  memory.at_base.judged_sample = -1;
  std::vector<health_event_t> verdicts;
  for (int n = 8; n < 40; ++n) {
    health_event_t event{};
    event.event_number = n;
    event.event_sample = n - 8;
    event.event_from = event.event_to = event.event_part = event.event_tag = -1;
    event.event_kind = health_event_t::EVENT_SCHEMA_REFUSED;
    verdicts.push_back(event);
  }
  set_array(memory.verdicts.num_events, memory.verdicts.events, std::move(verdicts));
  memory.verdicts.judged_sample = 31;
  ModelMonitor monitor(test_config());
  monitor.restore(memory);
  for (int i = 0; i < 32; ++i) monitor.on_sample(two_parts_seen(i, 0, 0));
  EXPECT_EQ(monitor.health().events.back().event_number, 39);
}

TEST(ModelMonitorByHandTest, AProposalWithoutPartsIsRefusedQuietly) {
  ModelMonitor monitor(test_config());
  monitor.on_sample(two_parts_seen(0, 0, 0));
  BodySchema schema;
  schema.signals = {{"q1", -1, 1}};
  schema.last_sample_index = 0;
  EXPECT_TRUE(monitor.on_learned_schema(to_message(schema)));
  EXPECT_FALSE(monitor.schema());
  EXPECT_EQ(check(monitor.health()), "");
}

TEST(ModelMonitorByHandTest, ALearnedEdgeTravelsAndIsKnownAgainInTheHistory) {
  constexpr int kSamples = 100;
  test::BrokenArm arm({test::Fault::kWorn, "", 1}, test::Regime::kTagIso, kSamples / 2, 3);
  const AdaptationOptions options = test::adaptation_options(test::Regime::kTagIso);
  Adaptation adaptation(arm.engineered(), options);
  for (int t = 0; t < kSamples; ++t) adaptation.on_sample(arm.observe(t));
  const BodySchema& schema = adaptation.schema();
  const Edge* learned = edge_to(schema, 4);
  ASSERT_TRUE(learned->residual_gp);
  EXPECT_STREQ(learned->kind(), "screw_gp");
  const body_schema_t message = to_message(schema);
  EXPECT_EQ(check(message), "");
  EXPECT_LT(encode(kBodySchema, message).size(), 64000U);
  const BodySchema again = from_message(message);
  const Edge* back = edge_to(again, 4);
  ASSERT_TRUE(back && back->residual_gp);
  EXPECT_EQ(back->signals(), learned->signals());
  for (double q = -1.3; q <= 1.3; q += 0.26) {
    const Eigen::VectorXd theta = Eigen::VectorXd::Constant(7, q);
    EXPECT_LT(log(back->predict(theta).inverse() * learned->predict(theta)).norm(), 1e-9);
    EXPECT_LT((back->prediction_covariance(theta) - learned->prediction_covariance(theta)).norm(),
              1e-12);
  }
  EXPECT_EQ(Adaptation(again, options, {arm.engineered(), schema}, {}).history().size(), 2U);
}

TEST(ModelMonitorConfigTest, IsReadInSiUnits) {
  const std::filesystem::path folder = std::filesystem::path(testing::TempDir()) /
                                       ("model_monitor_config_" + std::to_string(getpid()));
  std::filesystem::create_directories(folder);
  const std::filesystem::path file = folder / "model_monitor.yaml";
  std::ofstream(file) << "max_mahalanobis2: 16\nmax_outlier_share: 0.25\nfalse_alarm_rate: 1e-6\n";
  EXPECT_THROW(ModelMonitorConfig::load(file), ConfigError);  // no noise.yaml
  std::filesystem::copy_file(std::filesystem::path(BODYSCHEMA_CONFIG) / "arm4" / "noise.yaml",
                             folder / "noise.yaml");
  const ModelMonitorConfig config = ModelMonitorConfig::load(file);
  EXPECT_EQ(config.max_mahalanobis2, 16);
  EXPECT_EQ(config.max_outlier_share, 0.25);
  EXPECT_EQ(config.measurement.systematic.position_m, 0.001);
  EXPECT_EQ(config.false_alarm_rate, 1e-6);
  std::ofstream(file) << "max_mahalanobis2: 0.5\n";
  EXPECT_THROW(ModelMonitorConfig::load(file), ConfigError);
  std::filesystem::remove_all(folder);
}

}  // namespace
}  // namespace bodyschema
