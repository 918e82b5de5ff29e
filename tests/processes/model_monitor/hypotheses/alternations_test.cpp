#include "processes/model_monitor/hypotheses/alternations.h"

#include <gtest/gtest.h>

namespace bodyschema {
namespace {

using Kind = AdaptationEvent::Kind;

std::vector<AdaptationEvent> change(std::int64_t sample, Kind kind, int from, int to) {
  AdaptationEvent event;
  event.sample_index = sample;
  event.kind = kind;
  event.from = from;
  event.to = to;
  return {event};
}

TEST(AlternationsTest, AnEdgeThatChangesToAndFroIsFoundAtItsFourthChange) {
  Alternations alternations;
  EXPECT_FALSE(alternations.look(change(10, Kind::kCandidate, 3, 4)));
  EXPECT_FALSE(alternations.look(change(11, Kind::kRefined, 3, 4)));  // the same change
  EXPECT_FALSE(alternations.look(change(18, Kind::kRestored, 3, 4)));
  EXPECT_FALSE(alternations.look(change(20, Kind::kCandidate, 4, 5)));
  EXPECT_FALSE(alternations.look(change(30, Kind::kCandidate, 3, 4)));
  const auto found = alternations.look(change(41, Kind::kRestored, 3, 4));
  ASSERT_TRUE(found);
  EXPECT_EQ(found->part, 4);
  EXPECT_EQ(found->since, 10);
  EXPECT_FALSE(alternations.look(change(45, Kind::kCandidate, 3, 4)));
}

TEST(AlternationsTest, AGuessThatIsTakenBackIsNoChange) {
  Alternations alternations;
  EXPECT_FALSE(alternations.look(change(103, Kind::kCandidate, 3, 4)));
  EXPECT_FALSE(alternations.look(change(105, Kind::kReverted, 3, 4)));
  EXPECT_FALSE(alternations.look(change(108, Kind::kCandidate, 3, 4)));
  EXPECT_FALSE(alternations.look(change(111, Kind::kRestored, 3, 4)));
  EXPECT_FALSE(alternations.look(change(115, Kind::kCandidate, 3, 4)));
  const auto found = alternations.look(change(120, Kind::kRestored, 3, 4));
  ASSERT_TRUE(found);
  EXPECT_EQ(found->since, 108);
}

TEST(AlternationsTest, AFaultThatIsRepairedAndComesAgainLaterIsNoAlternation) {
  Alternations alternations;
  for (std::int64_t n = 0; n < 20; ++n)
    EXPECT_FALSE(
        alternations.look(change(25 * n, n % 2 ? Kind::kRestored : Kind::kCandidate, 3, 4)));
}

TEST(AlternationsTest, OneFormInsteadOfAnotherIsOneChange) {
  Alternations alternations;
  for (std::int64_t n = 0; n < 3; ++n) {
    auto events = change(n, Kind::kReverted, 3, 4);
    events.push_back(change(n, Kind::kCandidate, 3, 4).front());
    EXPECT_FALSE(alternations.look(events));
  }
}

TEST(AlternationsTest, AFaultThatNoFormExplainsWellIsNoAlternation) {
  // One form after another is adopted for it.
  Alternations alternations;
  for (std::int64_t n = 0; n < 8; ++n)
    EXPECT_FALSE(alternations.look(change(60 + n, Kind::kCandidate, 3, 4)));
}

TEST(AlternationsTest, MarkersAreNotLookedAt) {
  Alternations alternations;
  for (std::int64_t n = 0; n < 8; ++n) {
    auto events = change(n, Kind::kCandidate, -1, -1);
    events.front().part = 4;
    EXPECT_FALSE(alternations.look(events));
  }
}

}  // namespace
}  // namespace bodyschema
