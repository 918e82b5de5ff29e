// Class ModelMonitor: what was before a restart, and bodies that change.

#include <gtest/gtest.h>

#include "common/bus/check.h"
#include "tests/processes/model_monitor/model_monitor_bench.h"

namespace bodyschema::test {
namespace {

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

// Long, for it is one life and its replays.
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

}  // namespace
}  // namespace bodyschema::test
