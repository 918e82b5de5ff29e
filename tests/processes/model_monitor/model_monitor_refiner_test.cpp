// Class ModelMonitor: proposals that the refiner answers, and the actions that it wants.

#include <gtest/gtest.h>

#include "common/bus/check.h"
#include "tests/processes/model_monitor/model_monitor_bench.h"

namespace bodyschema::test {
namespace {

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
  EXPECT_FALSE(monitor.on_tick(220 * kSecond));
  EXPECT_TRUE(monitor.on_tick(221 * kSecond));
  EXPECT_EQ(monitor.health().judged_sample, 9);
  EXPECT_FALSE(monitor.on_tick(400 * kSecond));
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

}  // namespace
}  // namespace bodyschema::test
