#include "processes/model_monitor/live_schema.h"

#include <gtest/gtest.h>

#include <cmath>
#include <set>

#include "tests/support/broken_arm.h"

namespace bodyschema {
namespace {

using test::BrokenArm;
using test::Fault;
using test::Regime;

/// While a link bends, each sample is of another body: none of these may be learned from as the one
/// that it is in the end.
TEST(LiveSchemaTest, AfterADriftTheBodyIsAsItIsSinceItsEnd) {
  constexpr int kHealthy = 100, kPart = 4;
  constexpr double kMost_deg = 25;
  for (const double rate_deg : {0.5, 1.0})
    for (const int seed : {1, 2, 3}) {
      SCOPED_TRACE(std::to_string(rate_deg) + "° a sample, seed " + std::to_string(seed));
      BrokenArm arm({Fault::kDrift, "", 0.85, rate_deg, kMost_deg}, Regime::kTagIso, kHealthy,
                    seed);
      LiveSchema live(arm.engineered(), test::adaptation_options(Regime::kTagIso), {}, {});
      const int end = kHealthy + static_cast<int>(std::ceil(kMost_deg / rate_deg));
      for (int t = 0; t < end + 30; ++t) live.on_sample(arm.observe(t));
      EXPECT_NEAR(static_cast<double>(live.body_since()), end, 5);
      for (const Edge& edge : live.schema().edges) {
        if (edge.to == kPart)
          EXPECT_EQ(edge.valid_since_sample, live.body_since());
        else
          EXPECT_EQ(edge.valid_since_sample, 0) << "edge to " << edge.to;
      }
    }
}

// What the edges at a part have in common holds while they are those that were fitted together.
TEST(LiveSchemaTest, AChangedEdgeHasNothingInCommonWithItsNeighboursUntilItIsAsBefore) {
  constexpr int kBlock = 40;
  BrokenArm arm({Fault::kBend, ""}, Regime::kTagIso, kBlock, 1);
  BodySchema engineered = arm.engineered();
  for (const int part : engineered.parts)
    engineered.frame_covariances[part] = 1e-8 * Matrix6d::Identity();
  LiveSchema live(engineered, test::adaptation_options(Regime::kTagIso), {}, {});
  const auto told = [&] {
    std::set<int> parts;
    for (const auto& [part, covariance] : live.schema().frame_covariances) parts.insert(part);
    return parts;
  };
  const std::set<int> all(engineered.parts.begin(), engineered.parts.end());
  int t = 0;
  for (; t < kBlock; ++t) live.on_sample(arm.observe(t));
  EXPECT_EQ(told(), all);
  for (; t < 2 * kBlock; ++t) live.on_sample(arm.observe(t));
  const int bent = arm.changes().front().part;
  std::set<int> others = all;
  others.erase(bent);
  others.erase(bent - 1);
  EXPECT_EQ(told(), others);
  for (; t < 3 * kBlock; ++t) live.on_sample(arm.observe(t));
  EXPECT_EQ(told(), all);
}

}  // namespace
}  // namespace bodyschema
