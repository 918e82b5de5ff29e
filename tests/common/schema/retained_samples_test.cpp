#include "common/schema/retained_samples.h"

#include <gtest/gtest.h>

#include <random>
#include <set>
#include <stdexcept>

namespace bodyschema {
namespace {

using Indices = std::vector<std::int64_t>;

std::shared_ptr<const ActionPoseSample> sample(std::int64_t index) {
  auto result = std::make_shared<ActionPoseSample>();
  result->sample_index = index;
  return result;
}

Indices indices_of(const SharedSamples& samples) {
  Indices result;
  for (const auto& s : samples) result.push_back(s->sample_index);
  return result;
}

Indices multiples(std::int64_t stride, std::int64_t first, std::int64_t last) {
  Indices result;
  for (std::int64_t index = first; index <= last; ++index)
    if (index % stride == 0) result.push_back(index);
  return result;
}

TEST(RetainedSamples, AreAllUpToTheMostAndThenEverySecond) {
  EXPECT_EQ(retained_stride(0, kMostRetained - 1), 1);
  EXPECT_EQ(retained_stride(0, kMostRetained), 2);
  EXPECT_EQ(retained_stride(700, 700 + kMostRetained - 1), 1);
  EXPECT_EQ(retained_stride(0, 100'000), 64);
  for (const std::int64_t first : {0, 1, 999, 12'345}) {
    std::int64_t before = 1;
    for (std::int64_t last = first; last < first + 50'000; last += 7) {
      const std::int64_t stride = retained_stride(first, last);
      EXPECT_TRUE(stride == before || stride == 2 * before);
      before = stride;
      const std::int64_t count = last / stride - (first + stride - 1) / stride + 1;
      EXPECT_LE(count, kMostRetained);
      if (stride > 1) {
        EXPECT_GE(count, kMostRetained / 2 - 1);
      }
    }
  }
}

// What is asked for need not be known when the samples come: since when the body is as it is, say.
TEST(RetainedSamples, AreAFunctionOfTheIndicesWheneverTheyAreAskedFor) {
  RetainedSamples samples;
  std::mt19937_64 rng(1);
  std::int64_t newest = -1;
  for (int n = 0; n < 60'000; ++n) {
    samples.add(sample(++newest));
    if (n % 1'777 != 0 && n != 59'999) continue;
    for (int i = 0; i < 20; ++i) {
      const auto below = [&](std::int64_t end) { return static_cast<std::int64_t>(rng() % end); };
      const std::int64_t last = newest - below(std::min(newest, RetainedSamples::kMaxLag) + 1);
      const std::int64_t first = i == 0 ? 0 : below(last + 1);
      EXPECT_EQ(indices_of(samples.between(first, last)),
                multiples(retained_stride(first, last), first, last))
          << first << " to " << last << " of " << newest;
    }
  }
}

TEST(RetainedSamples, AreNestedAsTheyGrow) {
  RetainedSamples samples;
  std::set<std::int64_t> ever;
  for (std::int64_t index = 0; index < 20'000; ++index) {
    samples.add(sample(index));
    if (index % 500 != 0) continue;
    for (const std::int64_t kept : indices_of(samples.between(0, index)))
      if (kept <= index - 500) {
        EXPECT_TRUE(ever.contains(kept)) << kept << " came back";
      }
    ever.clear();
    for (const std::int64_t kept : indices_of(samples.between(0, index))) ever.insert(kept);
  }
}

TEST(RetainedSamples, KeepAFewThousandOfAHundredThousand) {
  RetainedSamples samples;
  for (std::int64_t index = 0; index < 100'000; ++index) samples.add(sample(index));
  EXPECT_LT(samples.size(), 10'000U);
  const std::size_t before = samples.size();
  for (std::int64_t index = 100'000; index < 200'000; ++index) samples.add(sample(index));
  EXPECT_LT(samples.size(), before + 1'200);
}

TEST(RetainedSamples, RefuseWhatIsTooFarBack) {
  RetainedSamples samples;
  for (std::int64_t index = 0; index < 5'000; ++index) samples.add(sample(index));
  EXPECT_NO_THROW(samples.between(0, 4'999 - RetainedSamples::kMaxLag));
  EXPECT_THROW(samples.between(0, 4'998 - RetainedSamples::kMaxLag), std::invalid_argument);
}

TEST(RetainedSamples, OfARecordingAreThoseOfTheRun) {
  RetainedSamples live;
  std::vector<ActionPoseSample> recording;
  for (std::int64_t index = 0; index < 9'000; ++index) {
    if (index % 5 == 3) continue;  // a TEST sample
    live.add(sample(index));
    recording.push_back(*live.between(index, index).at(0));
  }
  Indices offline;
  for (const auto& s : retained(recording)) offline.push_back(s.sample_index);
  EXPECT_EQ(offline, indices_of(live.between(0, recording.back().sample_index)));
}

}  // namespace
}  // namespace bodyschema
