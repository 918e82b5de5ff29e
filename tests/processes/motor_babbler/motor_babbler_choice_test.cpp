// Class MotorBabbler: the actions that it chooses by a schema, and those that others want.

#include <gtest/gtest.h>

#include <set>

#include "tests/processes/motor_babbler/motor_babbler_bench.h"

namespace bodyschema::test {
namespace {

/// After the first TEST sample, which is not judged yet.
Bench after_first_test() {
  Bench bench(active_config());
  bench.start();
  bench.run(4);
  EXPECT_FALSE(bench.make_sample());
  return bench;
}

TEST(MotorBabblerTest, CandidatesAreAFunctionOfSeedAndIdWithinTheLimits) {
  const MotorBabblerConfig config = test_config();
  std::set<std::vector<double>> all;
  for (std::int64_t id = 0; id < 50; ++id) {
    const auto candidates = candidate_actions(config, 3, id);
    EXPECT_EQ(candidates, candidate_actions(config, 3, id));
    EXPECT_EQ(candidates.size(), 40U);
    for (const Eigen::VectorXd& action : candidates) {
      all.insert({action.begin(), action.end()});
      for (std::size_t i = 0; i < config.signals.size(); ++i) {
        EXPECT_GE(action[i], config.signals[i].lower);
        EXPECT_LE(action[i], config.signals[i].upper);
      }
    }
  }
  EXPECT_EQ(all.size(), 2000U);
}

TEST(MotorBabblerTest, AnActionIsChosenByTheSchemaOfTheNewestVerdictAndAllSamples) {
  Bench bench = after_first_test();
  ASSERT_FALSE(bench.take(bench.babbler.on_body_schema(schema_of(5))));
  ASSERT_TRUE(bench.take(bench.babbler.on_model_health(verdict(4, 5))));
  std::vector<SeenAction> memory;
  for (int n = 0; n < 5; ++n) {
    memory.push_back({n, n != 4, random_action(active_config(), 1, n), {}});
  }
  const auto candidates = candidate_actions(active_config(), 1, 5);
  const Eigen::VectorXd expected =
      candidates[choose_action(from_message(schema_of(5)), memory, candidates)];
  EXPECT_EQ(bench.last.action, std::vector<double>(expected.begin(), expected.end()));
}

TEST(MotorBabblerTest, WhichOfSampleVerdictAndSchemaComesFirstDoesNotMatter) {
  Bench straight = after_first_test();
  straight.babbler.on_body_schema(schema_of(5));
  ASSERT_TRUE(straight.take(straight.babbler.on_model_health(verdict(4, 5))));

  Bench late = after_first_test();
  EXPECT_FALSE(late.take(late.babbler.on_model_health(verdict(4, 5))));
  EXPECT_NE(late.babbler.activity().find("BODY_SCHEMA version 5"), std::string::npos);
  EXPECT_FALSE(late.take(late.babbler.on_body_schema(schema_of(4))));
  ASSERT_TRUE(late.take(late.babbler.on_body_schema(schema_of(5))));
  EXPECT_EQ(late.last.action, straight.last.action);

  Bench early(active_config());
  early.start();
  early.run(4);
  early.babbler.on_motion_status(answer(early.last, motion_status_t::STATE_SETTLED));
  early.babbler.on_body_schema(schema_of(5));
  EXPECT_FALSE(early.take(early.babbler.on_model_health(verdict(4, 5))));
  // It hears the sample too early: there is a gap before it.
  EXPECT_FALSE(early.take(early.babbler.on_sample(sample_of(early.last, 4))));
  EXPECT_NE(early.babbler.activity().find("samples up to 4"), std::string::npos);
  ASSERT_TRUE(early.take(early.babbler.remember(sample_of(early.last, 4))));
  EXPECT_EQ(early.last.action, straight.last.action);
}

TEST(MotorBabblerTest, TestActionsAndWhatReplacesARefusedOneAreDrawn) {
  Bench bench = after_first_test();
  bench.babbler.on_body_schema(schema_of(5));
  ASSERT_TRUE(bench.take(bench.babbler.on_model_health(verdict(4, 5))));
  for (int n = 5; n < 9; ++n) {
    EXPECT_FALSE(is_drawn(bench.last)) << n;
    if (n == 6) {
      ASSERT_TRUE(bench.take(
          bench.babbler.on_motion_status(answer(bench.last, motion_status_t::STATE_REJECTED))));
      EXPECT_TRUE(is_drawn(bench.last));
    }
    ASSERT_TRUE(bench.make_sample());
  }
  ASSERT_TRUE(bench.is_test());
  EXPECT_TRUE(is_drawn(bench.last));
}

TEST(MotorBabblerTest, WhatTheMonitorFindsBetweenTwoVerdictsDoesNotChangeWhatIsChosen) {
  Bench undisturbed = after_first_test(), bench = after_first_test();
  for (Bench* each : {&undisturbed, &bench}) {
    each->babbler.on_body_schema(schema_of(5));
    ASSERT_TRUE(each->take(each->babbler.on_model_health(verdict(4, 5))));
  }
  for (int n = 5; n < 8; ++n) {
    bench.babbler.on_body_schema(schema_of(n + 1));
    bench.babbler.on_model_health(verdict(4, n + 1));
    ASSERT_TRUE(undisturbed.make_sample());
    ASSERT_TRUE(bench.make_sample());
    EXPECT_FALSE(is_drawn(bench.last));
    EXPECT_EQ(bench.last.action, undisturbed.last.action) << n;
  }
  // By the next verdict it counts, also if its schema was heard before.
  ASSERT_TRUE(bench.make_sample());
  ASSERT_FALSE(bench.make_sample());
  EXPECT_TRUE(bench.take(bench.babbler.on_model_health(verdict(9, 8))));
}

TEST(MotorBabblerTest, AProbeThatIsWantedIsTheFirstActionAfterTheVerdict) {
  for (const Choice choice : {Choice::kActive, Choice::kRandom}) {
    MotorBabblerConfig config = active_config();
    config.choice = choice;
    Bench bench(config);
    bench.start();
    bench.run(4);
    ASSERT_TRUE(bench.is_test());
    ASSERT_FALSE(bench.make_sample());
    model_health_t wants = verdict(4, 5);
    wants.probe_sample = 3;
    std::vector<double> probe;
    for (const Signal& signal : config.signals)
      probe.push_back(0.3 * signal.lower + 0.7 * signal.upper);
    set_array(wants.num_probe, wants.probe_action, probe);
    bench.babbler.on_body_schema(schema_of(5));
    ASSERT_TRUE(bench.take(bench.babbler.on_model_health(wants)));
    EXPECT_EQ(bench.last.action, wants.probe_action);
    EXPECT_EQ(bench.last.purpose, action_command_t::PURPOSE_PROBE);
    // A refused probe is not tried again and again.
    Bench refused = bench;
    ASSERT_TRUE(refused.take(
        refused.babbler.on_motion_status(answer(refused.last, motion_status_t::STATE_REJECTED))));
    EXPECT_EQ(refused.last.purpose, action_command_t::PURPOSE_TRAIN);
    EXPECT_NE(refused.last.action, wants.probe_action);
    // It takes the place of a TRAIN action: the rhythm of the TEST ones stays.
    for (int n = 5; n < 9; ++n) {
      EXPECT_FALSE(bench.is_test()) << n;
      ASSERT_TRUE(bench.make_sample());
      EXPECT_NE(bench.last.purpose, action_command_t::PURPOSE_PROBE);
    }
    EXPECT_TRUE(bench.is_test());
  }
}

TEST(MotorBabblerTest, AProbeBeyondTheLimitsIsNotMade) {
  Bench bench = after_first_test();
  model_health_t wants = verdict(4, 5);
  wants.probe_sample = 3;
  set_array(wants.num_probe, wants.probe_action,
            std::vector<double>(active_config().signals.size(), 1e3));
  bench.babbler.on_body_schema(schema_of(5));
  ASSERT_TRUE(bench.take(bench.babbler.on_model_health(wants)));
  EXPECT_EQ(bench.last.purpose, action_command_t::PURPOSE_TRAIN);
}

/// Takes the verdict on the newest sample, with its schema. Returns the next `num` actions, all of
/// them TRAIN.
std::vector<std::vector<double>> actions_after(Bench* bench, const model_health_t& health,
                                               int num) {
  bench->babbler.on_body_schema(schema_of(health.schema_version));
  EXPECT_TRUE(bench->take(bench->babbler.on_model_health(health)));
  std::vector<std::vector<double>> actions;
  for (int n = 0; n < num; ++n) {
    EXPECT_FALSE(bench->is_test());
    actions.push_back(bench->last.action);
    bench->make_sample();
  }
  return actions;
}

TEST(MotorBabblerTest, TheActionsThatTheRefinerWantsAreMadeOnceEachAndInOrder) {
  Bench bench = after_first_test();
  const model_health_t first = wanting(verdict(4, 5), 4), second = wanting(verdict(9, 10), 4),
                       third = wanting(verdict(14, 15), 4);
  std::vector<std::vector<double>> made = actions_after(&bench, first, 4);
  EXPECT_TRUE(is_drawn(bench.last));  // TEST
  ASSERT_FALSE(bench.make_sample());
  for (const auto& action : actions_after(&bench, second, 4)) made.push_back(action);
  ASSERT_FALSE(bench.make_sample());
  std::vector<std::vector<double>> wanted;
  for (int n = 0; n < 10; ++n)
    if (n != 2) wanted.push_back(first.wanted_actions[n].wanted_action);
  const auto rest = actions_after(&bench, third, 2);
  made.push_back(rest[0]);
  EXPECT_EQ(made, wanted);
  // None is left.
  EXPECT_EQ(bench.babbler.num_wanted_taken(), 9);
  EXPECT_EQ(std::count(wanted.begin(), wanted.end(), rest[1]), 0);
}

TEST(MotorBabblerTest, AWantedActionThatIsRefusedIsNotTriedAgain) {
  Bench bench = after_first_test();
  const model_health_t wants = wanting(verdict(4, 5), 4);
  bench.babbler.on_body_schema(schema_of(5));
  ASSERT_TRUE(bench.take(bench.babbler.on_model_health(wants)));
  EXPECT_EQ(bench.last.action, wants.wanted_actions[0].wanted_action);
  ASSERT_TRUE(bench.take(
      bench.babbler.on_motion_status(answer(bench.last, motion_status_t::STATE_REJECTED))));
  EXPECT_TRUE(is_drawn(bench.last));
  ASSERT_TRUE(bench.make_sample());
  EXPECT_EQ(bench.last.action, wants.wanted_actions[1].wanted_action);
}

TEST(MotorBabblerTest, WantedActionsOfASchemaThatIsGoneAreDroppedForThoseOfANewOne) {
  Bench bench = after_first_test();
  actions_after(&bench, wanting(verdict(4, 5), 4), 4);
  ASSERT_FALSE(bench.make_sample());
  Bench newer = bench;
  for (const auto& action : actions_after(&bench, verdict(9, 10), 4))
    for (const auto& wanted : wanting(verdict(4, 5), 4).wanted_actions)
      EXPECT_NE(action, wanted.wanted_action);
  EXPECT_EQ(bench.babbler.num_wanted_taken(), 4);

  const model_health_t others = wanting(verdict(9, 10), 9);
  EXPECT_EQ(actions_after(&newer, others, 4)[0], others.wanted_actions[0].wanted_action);
}

TEST(MotorBabblerTest, OnlyWhereActionsAreChosenAreThoseOfTheRefinerMade) {
  Bench bench;
  bench.start();
  bench.run(4);
  ASSERT_FALSE(bench.make_sample());
  ASSERT_TRUE(bench.take(bench.babbler.on_model_health(wanting(verdict(4, 5), 4))));
  EXPECT_TRUE(is_drawn(bench.last, test_config()));
}

TEST(MotorBabblerTest, AMonitorThatWaitsForTheRefinerIsWaitedFor) {
  Bench bench = after_first_test();
  model_health_t waiting = verdict(-1, 0);
  waiting.awaited_refinement = 4;
  for (int t = 200; t < 230; ++t) {
    EXPECT_FALSE(bench.take(bench.babbler.on_tick(t * kSecond)));
    EXPECT_FALSE(bench.take(bench.babbler.on_model_health(waiting)));
  }
  const model_health_t wants = wanting(verdict(4, 5), 4);
  EXPECT_EQ(actions_after(&bench, wants, 1)[0], wants.wanted_actions[0].wanted_action);
  EXPECT_EQ(bench.babbler.num_without_schema(), 0);
}

TEST(MotorBabblerTest, WithoutASchemaActionsAreDrawn) {
  Bench bench = after_first_test();
  ASSERT_TRUE(bench.take(bench.babbler.on_model_health(verdict(4, 0))));
  EXPECT_TRUE(is_drawn(bench.last));
  EXPECT_EQ(bench.babbler.num_without_schema(), 0);
}

TEST(MotorBabblerTest, AnInitialSchemaThatStandsIsChosenByToo) {
  Bench bench = after_first_test();
  model_health_t health = verdict(4, 0);
  set_array(health.num_edges, health.edge_health, {edge_health_t{}});
  EXPECT_FALSE(bench.take(bench.babbler.on_model_health(health)));
  ASSERT_TRUE(bench.take(bench.babbler.on_body_schema(schema_of(0))));
  EXPECT_FALSE(is_drawn(bench.last));
}

TEST(MotorBabblerTest, ASchemaThatDoesNotComeIsGivenUpUntilTheNextTest) {
  Bench bench = after_first_test();
  EXPECT_FALSE(bench.take(bench.babbler.on_model_health(verdict(4, 5))));
  EXPECT_FALSE(bench.take(bench.babbler.on_tick(200 * kSecond)));
  EXPECT_FALSE(bench.take(bench.babbler.on_tick(210 * kSecond - 1)));
  ASSERT_TRUE(bench.take(bench.babbler.on_tick(210 * kSecond)));
  EXPECT_EQ(bench.babbler.num_without_schema(), 1);
  // Late is not in between.
  bench.babbler.on_body_schema(schema_of(5));
  for (int n = 5; n < 9; ++n) {
    EXPECT_TRUE(is_drawn(bench.last)) << n;
    ASSERT_TRUE(bench.make_sample());
  }
  ASSERT_FALSE(bench.make_sample());
  bench.babbler.on_body_schema(schema_of(10));
  ASSERT_TRUE(bench.take(bench.babbler.on_model_health(verdict(9, 10))));
  EXPECT_FALSE(is_drawn(bench.last));
  EXPECT_EQ(bench.babbler.num_without_schema(), 1);
}

TEST(MotorBabblerTest, ARunThatIsOverWaitsForNoSchema) {
  MotorBabblerConfig config = active_config();
  config.stop.min_samples = config.stop.max_samples = 10;
  Bench bench(config);
  bench.start();
  bench.run(9);
  ASSERT_TRUE(bench.is_test());
  bench.make_sample();
  bench.babbler.on_model_health(verdict(9, 10));
  EXPECT_TRUE(bench.babbler.is_done());
}

}  // namespace
}  // namespace bodyschema::test
