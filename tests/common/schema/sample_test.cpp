#include "common/schema/sample.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <utility>
#include <vector>

#include "common/schema/body_schema.h"

namespace bodyschema {
namespace {

PartObservation by(int part, std::vector<int> tags) {
  PartObservation observation;
  observation.part = part;
  observation.tags = std::move(tags);
  return observation;
}

/// Of part 1 two tags agree and one does not; of part 2 none do, of part 3 all.
ActionPoseSample sample() {
  ActionPoseSample sample;
  sample.sample_index = 10;
  sample.parts = {by(1, {10, 11}), by(3, {30})};
  sample.contradictions = {by(1, {12}), by(2, {20}), by(2, {21})};
  return sample;
}

using Tags = std::vector<int>;

TEST(ActionPoseSample, OfTagsThatContradictEachOtherTheOnlyOneThatIsLeftIsBelieved) {
  const auto without = [](const Tags& tags, int part) {
    const ActionPoseSample all = sample();
    const PartObservation* seen = all.find_without(
        [&](int tag) { return std::find(tags.begin(), tags.end(), tag) != tags.end(); }, part);
    return seen ? seen->tags : Tags{};
  };
  EXPECT_EQ(without({}, 1), (Tags{10, 11}));
  EXPECT_EQ(without({}, 2), Tags{});
  EXPECT_EQ(without({12}, 1), (Tags{10, 11}));
  EXPECT_EQ(without({10}, 1), Tags{12});
  EXPECT_EQ(without({20}, 2), Tags{21});
  EXPECT_EQ(without({20, 21}, 2), Tags{});
  EXPECT_EQ(without({30}, 3), Tags{});
}

TEST(ActionPoseSample, IsWithoutMovedTagsAsIfTheyHadNotBeenSeen) {
  ActionPoseSample clean = sample();
  drop_moved_tags({{20, 9, 5, -1}, {30, 9, 5, 8}, {12, 20, 11, -1}}, &clean);
  ASSERT_EQ(clean.parts.size(), 3U);  // 30 was back by then, 12 moved later
  EXPECT_EQ(clean.parts[1].part, 2);
  EXPECT_EQ(clean.parts[1].tags, Tags{21});
  ASSERT_EQ(clean.contradictions.size(), 1U);
  EXPECT_EQ(clean.contradictions[0].tags, Tags{12});
}

}  // namespace
}  // namespace bodyschema
