#include "processes/model_monitor/sample_stream.h"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "processes/model_monitor/adaptation.h"
#include "tests/support/broken_arm.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

const std::vector<Signal> kTwoSignals{{"q1", -1, 1}, {"q2", 0, 10}};

ActionPoseSample sample_at(std::int64_t index, double time_s, double q1, double q2) {
  ActionPoseSample sample;
  sample.sample_index = index;
  sample.utime = std::llround(1e6 * time_s);
  sample.action = Eigen::Vector2d(q1, q2);
  return sample;
}

TEST(SampleStreamTest, OfAStreamOneSampleASecondIsNew) {
  SampleStream stream;
  std::vector<std::int64_t> fresh;
  for (int n = 0; n < 350; ++n)
    if (!stream.repeats(sample_at(n, 0.01 * n, 0.002 * n, 5), kTwoSignals)) fresh.push_back(n);
  EXPECT_EQ(fresh, (std::vector<std::int64_t>{0, 100, 200, 300}));
  EXPECT_TRUE(stream.is_dense());
  EXPECT_EQ(stream.count(), 3);
  for (std::size_t n = 0; n < fresh.size(); ++n)
    EXPECT_EQ(stream.sample_index_of(static_cast<std::int64_t>(n)), fresh[n]);
}

TEST(SampleStreamTest, WhatComesAfterAGapOrAJumpIsNew) {
  SampleStream stream;
  EXPECT_FALSE(stream.repeats(sample_at(0, 0, 0, 5), kTwoSignals));
  EXPECT_TRUE(stream.repeats(sample_at(1, 0.01, 0, 5), kTwoSignals));
  EXPECT_FALSE(stream.repeats(sample_at(2, 0.3, 0, 5), kTwoSignals));
  EXPECT_TRUE(stream.repeats(sample_at(3, 0.31, 0.1, 5), kTwoSignals));
  EXPECT_FALSE(stream.repeats(sample_at(4, 0.32, 0.1, 6.1), kTwoSignals));
}

TEST(SampleStreamTest, PosesOfABabblingArmAreAllNew) {
  test::Rng rng(3);
  const std::vector<Signal> signals(7, {"q", -1, 1});
  for (const double interval_s : {1.5, 0.7, 0.2, 0.0}) {
    SampleStream stream;
    for (int n = 0; n < 1000; ++n) {
      ActionPoseSample sample = sample_at(n, interval_s * n, 0, 0);
      sample.action.resize(7);
      for (double& q : sample.action) q = test::uniform(rng, -1, 1);
      ASSERT_FALSE(stream.repeats(sample, signals)) << interval_s << " s, sample " << n;
      ASSERT_EQ(stream.count(), n);
    }
    EXPECT_FALSE(stream.is_dense());
  }
  // At rest from time to time, small steps are no stream either.
  SampleStream stream;
  for (int n = 0; n < 100; ++n)
    EXPECT_FALSE(stream.repeats(sample_at(n, 0.6 * n, 0.01 * n, 5), kTwoSignals));
}

TEST(SampleStreamTest, WithoutAClockNothingRepeats) {
  SampleStream stream;
  for (int n = 0; n < 10; ++n) EXPECT_FALSE(stream.repeats(sample_at(n, 0, 0, 5), kTwoSignals));
}

/// The arm as it is at rest, and as a camera at 20 Hz sees it meanwhile: the same is found at the
/// same instants.
TEST(SampleStreamTest, FramesBetweenChangeNothingOfWhatIsFound) {
  constexpr int kFrames = 20;
  for (const test::Fault fault : {test::Fault::kNone, test::Fault::kTwo}) {
    test::BrokenArm arm({fault, "", 0.85}, test::Regime::kTagIso, 25, 5);
    const AdaptationOptions options = test::adaptation_options(test::Regime::kTagIso);
    Adaptation at_rest(arm.engineered(), options), in_stream(arm.engineered(), options);
    int num_events = 0;
    for (int n = 0; n < arm.num_samples(); ++n) {
      ActionPoseSample sample = arm.observe(n);
      sample.utime = 1'000'000 * n;
      const auto expected = at_rest.on_sample(sample);
      sample.sample_index *= kFrames;
      const auto found = in_stream.on_sample(sample);
      ASSERT_EQ(found.size(), expected.size()) << "sample " << n;
      for (std::size_t e = 0; e < found.size(); ++e) {
        EXPECT_EQ(found[e].kind, expected[e].kind);
        EXPECT_EQ(found[e].cause, expected[e].cause);
        EXPECT_EQ(found[e].sample_index, sample.sample_index);
        ++num_events;
      }
      if (!expected.empty()) {
        EXPECT_EQ(in_stream.since(), kFrames * at_rest.since());
      }
      for (int frame = 1; frame < kFrames; ++frame) {
        ++sample.sample_index;
        sample.utime += 1'000'000 / kFrames;
        EXPECT_TRUE(in_stream.on_sample(sample).empty());
      }
    }
    EXPECT_EQ(num_events == 0, fault == test::Fault::kNone) << num_events;
  }
}

}  // namespace
}  // namespace bodyschema
