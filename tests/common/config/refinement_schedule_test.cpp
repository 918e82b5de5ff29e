#include "common/config/refinement_schedule.h"

#include <gtest/gtest.h>

#include <vector>

namespace bodyschema {
namespace {

std::vector<std::int64_t> due(std::int64_t every, const std::vector<std::int64_t>& tests) {
  RefinementSchedule schedule(every);
  std::vector<std::int64_t> result;
  for (const std::int64_t test : tests)
    if (schedule.is_due(test)) result.push_back(test);
  return result;
}

TEST(RefinementSchedule, IsTheFirstTestSampleAfterEverySoManySamples) {
  using Indices = std::vector<std::int64_t>;
  EXPECT_EQ(due(10, {4, 9, 14, 19, 24}), (Indices{9, 19}));
  EXPECT_EQ(due(12, {4, 9, 14, 19, 24, 29}), (Indices{14, 24}));
  // After a gap once.
  EXPECT_EQ(due(10, {4, 33, 34, 39, 49}), (Indices{33, 39, 49}));
  EXPECT_EQ(due(1, {4, 9}), (Indices{4, 9}));
  EXPECT_EQ(due(0, {4, 9}), Indices{});
}

}  // namespace
}  // namespace bodyschema
