// Class ModelMonitor: which proposals it accepts, in whatever order they come.

#include <gtest/gtest.h>

#include "common/bus/check.h"
#include "common/geometry/angle.h"
#include "tests/processes/model_monitor/model_monitor_bench.h"

namespace bodyschema::test {
namespace {

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
  ASSERT_TRUE(is_right(from_message(right), robot_));
  EXPECT_TRUE(monitor.on_learned_schema(right));
  ASSERT_TRUE(monitor.schema());
  EXPECT_EQ(check(*monitor.schema()), "");
  EXPECT_TRUE(is_right(from_message(*monitor.schema()), robot_));
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
    robot_ = chapter_robot(run % 2 ? "a" : "c", rng);
    const ObservationOptions options{
        .regime = Regime::kTag, .with_covariances = true, .with_other_hypothesis = true};
    samples_ = babble(robot_, 60, options, rng);
    for (ActionPoseSample& sample : samples_) {
      if (sample.sample_index % 5 == 4) sample.purpose = Purpose::kTest;
    }
    const BodySchema right = learned(59);
    if (!is_right(right, robot_)) continue;  // the learner's matter
    ModelMonitor monitor = monitor_at(59);
    monitor.on_learned_schema(to_message(right));
    EXPECT_TRUE(monitor.schema()) << "run " << run << ": "
                                  << (monitor.health().num_events
                                          ? monitor.health().events.back().event_text
                                          : "");

    for (std::size_t i = 0; i < right.edges.size(); ++i) {
      BodySchema wrong = right;
      Vector6d error = 20 * Vector6d::Unit(static_cast<int>(uniform(rng, 0, 6)));
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
      if (i % 5 == 4 && (i == 44 || uniform(rng, 0, 1) < 0.5))
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
      const double what = uniform(rng, 0, 1);
      if (what < 0.6) {
        monitor.on_sample(sample(next++));
      } else if (what < 0.7) {
        monitor.on_sample(sample(static_cast<std::int64_t>(uniform(rng, 0, next))));
      } else {
        const auto i = static_cast<int>(uniform(rng, 0, double(proposals.size())));
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

}  // namespace
}  // namespace bodyschema::test
