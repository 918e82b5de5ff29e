#include "processes/model_monitor/health/visibility_watch.h"

#include <gtest/gtest.h>

#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

constexpr int kPart = 4, kAny = VisibilityWatch::kAnyTag;

ActionPoseSample sample_of(const std::vector<int>& tags, Purpose purpose = Purpose::kTrain) {
  ActionPoseSample sample;
  sample.purpose = purpose;
  if (tags.empty()) return sample;
  PartObservation& o = sample.parts.emplace_back();
  o.part = kPart;
  o.tags = tags;
  return sample;
}

class VisibilityWatchTest : public testing::Test {
 protected:
  std::vector<VisibilityWatch::Finding> see(const std::vector<int>& tags,
                                            Purpose purpose = Purpose::kTrain) {
    const ActionPoseSample sample = sample_of(tags, purpose);
    return watch_.look({kPart}, sample, sample, none_);
  }
  /// Samples without `tags` until something is found missing.
  int misses_until_found(const std::vector<int>& tags, int tag) {
    for (int n = 1; n < 1000; ++n) {
      const auto findings = see(tags);
      if (findings.empty()) continue;
      EXPECT_EQ(findings.size(), 1U);
      EXPECT_EQ(findings[0].part, kPart);
      EXPECT_EQ(findings[0].tag, tag);
      EXPECT_TRUE(findings[0].is_missing);
      EXPECT_EQ(findings[0].num_missed, n);
      return n;
    }
    return 0;
  }

  MovedTags none_{{}};
  VisibilityWatch watch_{1e-5};
};

TEST_F(VisibilityWatchTest, TheRarerAPartIsSeenTheLongerItMayBeMissed) {
  for (int n = 0; n < 200; ++n) EXPECT_TRUE(see({40}).empty());
  const int always = misses_until_found({}, kAny);
  EXPECT_LE(always, 3);
  EXPECT_EQ(watch_.missing_parts(), std::vector<int>{kPart});
  const auto back = see({40});
  ASSERT_EQ(back.size(), 1U);
  EXPECT_FALSE(back[0].is_missing);
  EXPECT_TRUE(watch_.missing_parts().empty());
  // Half of the time from now on: 0.5^m is below 1e-5 after 17.
  for (int n = 0; n < 200; ++n)
    EXPECT_TRUE(see(n % 2 ? std::vector{40} : std::vector<int>{}).empty());
  const int half = misses_until_found({}, kAny);
  EXPECT_GE(half, 12);
  EXPECT_LE(half, 20);
}

TEST_F(VisibilityWatchTest, OneOfSeveralTagsIsMissedOnlyWhereThePartIsSeenByOthers) {
  for (int n = 0; n < 100; ++n) EXPECT_TRUE(see({40, 41}).empty());
  EXPECT_LE(misses_until_found({40}, 41), 3);
  // An arm that is led or holds still shows one side for as long.
  VisibilityWatch other(1e-5);
  const ActionPoseSample both = sample_of({40, 41});
  for (int n = 0; n < 100; ++n) other.look({kPart}, both, both, none_);
  const ActionPoseSample held = sample_of({40}, Purpose::kControl);
  for (int n = 0; n < 100; ++n) EXPECT_TRUE(other.look({kPart}, held, held, none_).empty());
  // After a change of the body it is found out anew how often it is seen.
  other.forget_tags();
  const ActionPoseSample one = sample_of({40});
  for (int n = 0; n < 9; ++n) EXPECT_TRUE(other.look({kPart}, one, one, none_).empty());
}

/// A part of four tags, each in sight two times of three, forty samples from the begin or a change.
TEST_F(VisibilityWatchTest, ATagOfWhichLittleIsKnownIsNotMissedByChance) {
  test::Rng rng(1);
  int num_found = 0;
  for (int run = 0; run < 2000; ++run) {
    watch_.forget_tags();
    for (int n = 0; n < 40; ++n) {
      std::vector<int> tags{40};
      for (int tag = 41; tag < 44; ++tag)
        if (test::uniform(rng, 0, 1) < 0.67) tags.push_back(tag);
      for (const auto& finding : see(tags)) num_found += finding.is_missing;
    }
  }
  // 1e-5 a sample: 0.8 are expected.
  EXPECT_LE(num_found, 2);
}

TEST_F(VisibilityWatchTest, WhatIsNotBelievedIsNotSeen) {
  const ActionPoseSample seen = sample_of({40}), nothing = sample_of({});
  for (int n = 0; n < 100; ++n) see({40});
  int num_found = 0;
  for (int n = 0; n < 5; ++n)
    for (const auto& finding : watch_.look({kPart}, seen, nothing, none_))
      num_found += finding.tag == kAny && finding.is_missing;
  EXPECT_EQ(num_found, 1);
  // What rests on a tag that moved is seen, only not used.
  VisibilityWatch other(1e-5);
  for (int n = 0; n < 100; ++n) other.look({kPart}, seen, seen, none_);
  const MovedTags moved({{40, 0, 0, -1}});
  for (int n = 0; n < 100; ++n) EXPECT_TRUE(other.look({kPart}, seen, nothing, moved).empty());
  EXPECT_FALSE(other.is_missing(kPart));
}

TEST(VisibilityWatchOfMany, TheMoreIsWatchedTheLongerEachMayBeMissed) {
  std::vector<int> misses;
  for (const int num_parts : {1, 1000}) {
    VisibilityWatch watch(1e-5);
    std::vector<int> parts(num_parts);
    ActionPoseSample all;
    for (int part = 0; part < num_parts; ++part) {
      parts[part] = part;
      all.parts.push_back({.part = part, .tags = {part}});
    }
    const MovedTags none({});
    for (int n = 0; n < 30; ++n) watch.look(parts, all, all, none);
    ActionPoseSample without = all;
    without.parts.erase(without.parts.begin());
    int n = 0;
    while (!watch.is_missing(0) && n < 1000) {
      watch.look(parts, without, without, none);
      ++n;
    }
    misses.push_back(n);
  }
  EXPECT_GT(misses[1], misses[0]);
}

}  // namespace
}  // namespace bodyschema
