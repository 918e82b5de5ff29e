#include "common/estimation/quantile.h"

#include <gtest/gtest.h>

namespace bodyschema {
namespace {

TEST(Quantile, MediansDifferWhereTheNumberOfValuesIsEven) {
  EXPECT_EQ(median({3, 1, 2}), 2);
  EXPECT_EQ(upper_median({3, 1, 2}), 2);
  EXPECT_EQ(median({4, 1, 2, 3}), 2.5);
  EXPECT_EQ(upper_median({4, 1, 2, 3}), 3);
  EXPECT_EQ(median({7}), 7);
}

}  // namespace
}  // namespace bodyschema
