#include "processes/model_monitor/health/baseline_youth.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>

namespace bodyschema {
namespace {

health_event_t event(std::int8_t kind, std::int64_t sample) {
  health_event_t event{};
  event.event_kind = kind;
  event.event_sample = sample;
  event.event_from = 1;
  event.event_to = 2;
  event.event_part = event.event_tag = -1;
  event.samples_used = 1;
  return event;
}

health_event_t mismatch(std::int64_t sample) {
  return event(health_event_t::EVENT_MISMATCH, sample);
}

void pass(BaselineYouth* youth, int num_quiet) {
  for (int n = 0; n < num_quiet; ++n) EXPECT_TRUE(youth->on_sample({}, true).empty());
}

TEST(BaselineYouthTest, TheOddsAreThoseOfTheRuleOfSuccession) {
  BaselineYouth youth(4);
  youth.on_sample({mismatch(0)}, true);
  // 0.1 · B(2, 5) against 0.001.
  EXPECT_NEAR(youth.log_odds_wrong(), std::log(0.1 / 30 / 1e-3), 1e-9);
  pass(&youth, 6);
  EXPECT_NEAR(youth.log_odds_wrong(), std::log(0.1 / 132 / 1e-3), 1e-9);
  youth.on_sample({mismatch(7)}, true);
  // B(3, 11) = 2! 10! / 13!
  EXPECT_NEAR(youth.log_odds_wrong(), std::log(0.1 * 2 / (11. * 12 * 13) / 1e-6), 1e-9);
}

TEST(BaselineYouthTest, WhatHappensAfterManyQuietSamplesIsToldAtOnce) {
  BaselineYouth youth;
  pass(&youth, 16);
  EXPECT_TRUE(youth.is_over());
  EXPECT_EQ(youth.on_sample({mismatch(16)}, true).size(), 1U);
  EXPECT_FALSE(youth.has_story());
  EXPECT_TRUE(BaselineYouth(std::numeric_limits<std::int32_t>::max()).is_over());
}

TEST(BaselineYouthTest, WhatShowsNothingConfirmsNothing) {
  BaselineYouth youth;
  for (int n = 0; n < 100; ++n) youth.on_sample({}, false);
  EXPECT_FALSE(youth.is_over());
}

TEST(BaselineYouthTest, AChangeInTheYouthWaitsUntilItIsLikelierThanAWrongBaseline) {
  BaselineYouth youth;
  pass(&youth, 5);
  auto long_ago = mismatch(5);
  long_ago.samples_used = 3;
  EXPECT_TRUE(youth.on_sample({long_ago, event(health_event_t::EVENT_CANDIDATE, 5)}, true).empty());
  EXPECT_TRUE(youth.has_story());
  EXPECT_EQ(youth.story_since(), 3);
  int num_waited = 0;
  for (; !youth.is_story_believed() && num_waited < 100; ++num_waited) pass(&youth, 1);
  EXPECT_EQ(num_waited, 11);  // 16 quiet samples in all
  const auto told = youth.end();
  ASSERT_EQ(told.size(), 2U);
  EXPECT_EQ(told[1].event_kind, health_event_t::EVENT_CANDIDATE);
  EXPECT_TRUE(youth.is_over());
  EXPECT_FALSE(youth.has_story());
  EXPECT_EQ(youth.on_sample({mismatch(40)}, true).size(), 1U);
}

TEST(BaselineYouthTest, ManyMismatchesSpeakAgainstTheBaselineHoweverManyQuietSamplesCome) {
  BaselineYouth youth;
  for (int n = 0; n < 10; ++n) {
    pass(&youth, 5);
    youth.on_sample({mismatch(6 * n + 5)}, true);
    EXPECT_FALSE(youth.is_story_believed());
    EXPECT_FALSE(youth.is_over());
  }
  EXPECT_GT(youth.log_odds_wrong(), std::log(1e6));
}

TEST(BaselineYouthTest, AMarkerThatIsGoneIsToldAtOnceAndSpeaksAgainstNothing) {
  BaselineYouth youth;
  auto missing = event(health_event_t::EVENT_MISSING, 3);
  missing.event_from = missing.event_to = -1;
  missing.event_part = 4;
  missing.event_cause = health_event_t::CAUSE_MARKER_MISSING;
  EXPECT_EQ(youth.on_sample({missing}, true).size(), 1U);
  EXPECT_FALSE(youth.has_story());
  // One of several tags of a part is looked for by the schema.
  missing.event_tag = 17;
  EXPECT_TRUE(youth.on_sample({missing}, true).empty());
  EXPECT_TRUE(youth.has_story());
}

}  // namespace
}  // namespace bodyschema
