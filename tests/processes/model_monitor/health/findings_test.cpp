#include "processes/model_monitor/health/findings.h"

#include <gtest/gtest.h>

#include <cmath>

#include "common/geometry/angle.h"
#include "processes/model_monitor/health/health_words.h"
#include "tests/support/broken_arm.h"

namespace bodyschema {
namespace {

using State = Finding::State;
using test::BrokenArm;
using test::Fault;
using test::Regime;

constexpr int kBlock = 60;  // what is adopted within its first samples settles in it

struct Case {
  Fault fault;
  const char* name;
  std::string cause;
  int from, to, part;
  std::vector<double> amounts;
  int signal;
};

/// The life of an arm, and what was known to be wrong at the end of each of its blocks.
struct KnownLife {
  explicit KnownLife(BrokenArm* arm) {
    Adaptation adaptation(arm->engineered(), test::adaptation_options(Regime::kTagIso));
    Findings findings;
    for (int t = 0; t < arm->num_samples(); ++t) {
      const std::vector<AdaptationEvent> events = adaptation.on_sample(arm->observe(t));
      findings.update(adaptation, events, t);
      for (const AdaptationEvent& event : events)
        log += std::to_string(t) + "  " + text_of(event, adaptation.schema().signals) + "\n";
      for (const int part : adaptation.schema().parts)
        is_told &= adaptation.edge_state(part) != EdgeState::kInvalid || !findings.all().empty();
      if ((t + 1) % kBlock != 0) continue;
      at_end.push_back(findings.all());
      for (const Finding& finding : findings.all())
        log += "       = " + text_of(finding, adaptation.schema().signals) + "\n";
    }
  }
  std::vector<std::vector<Finding>> at_end;
  bool is_told = true;  ///< whatever was invalid was among them
  std::string log;
};

class FindingsTest : public testing::TestWithParam<Case> {};

TEST_P(FindingsTest, WhatIsWrongIsToldWithPlaceAmountAndTimeUntilItIsRepaired) {
  const Case& c = GetParam();
  BrokenArm arm({c.fault, c.name, 0.9}, Regime::kTagIso, kBlock, 3);
  const KnownLife life(&arm);
  SCOPED_TRACE(life.log);
  EXPECT_TRUE(life.is_told);
  EXPECT_TRUE(life.at_end[0].empty());
  EXPECT_TRUE(life.at_end[2].empty()) << "it was repaired";
  for (const int block : {1, 3}) {
    SCOPED_TRACE(block);
    ASSERT_EQ(life.at_end[block].size(), 1U);
    const Finding& found = life.at_end[block].front();
    EXPECT_EQ(found.state, State::kConfirmed);
    EXPECT_EQ(found.cause, c.cause);
    EXPECT_EQ(found.from, c.from);
    EXPECT_EQ(found.to, c.to);
    EXPECT_EQ(found.part, c.part);
    EXPECT_GE(found.since, block * kBlock);
    EXPECT_LE(found.since, block * kBlock + 5);
    EXPECT_GE(found.adopted, found.since);
    EXPECT_GE(found.num_confirming, 40);
    EXPECT_EQ(found.size.signal, c.signal);
    std::vector<double> truth = c.amounts;
    if (truth.empty()) {
      // Where it stands: the exact edge turned before its joint.
      const Edge *exact = nullptr, *engineered = nullptr;
      const BodySchema broken = arm.engineered_but_exact(c.to, kBlock);
      exact = edge_to(broken, c.to);
      engineered = edge_to(arm.engineered(), c.to);
      truth = {log_so3((engineered->left.inverse() * exact->left).linear()).z()};
    }
    ASSERT_EQ(found.size.amounts.size(), truth.size());
    for (std::size_t i = 0; i < truth.size(); ++i) {
      const double sd = found.size.sds[i];
      // The second time it is known from the first: no standard deviation. The engineered model
      // is wrong by 1 mm and 0.2° an axis besides.
      const bool is_angle = i == 1 || c.signal >= 0;
      const double model = is_angle ? 0.01 : 0.004;
      if (block == 1) {
        EXPECT_GT(sd, 0);
        EXPECT_LT(sd, is_angle ? 0.03 : 0.01);
      }
      EXPECT_NEAR(found.size.amounts[i], truth[i], 3 * std::max(sd, 0.0) + model) << i;
    }
  }
}

INSTANTIATE_TEST_SUITE_P(
    Faults, FindingsTest,
    testing::Values(
        Case{Fault::kStuck, "stuck", "joint_stuck", 4, 5, -1, {}, 3},
        Case{Fault::kOffset, "offset", "joint_offset", 3, 4, -1, {-20 * kDegree}, 2},
        Case{Fault::kGain, "gain", "joint_gain", 3, 4, -1, {0.7}, 2},
        Case{Fault::kMarker, "marker", "marker_moved", -1, -1, 3, {0.05, 1}, -1},
        Case{Fault::kCamera, "camera", "camera_moved", -1, -1, 1, {0.1, 15 * kDegree}, -1}),
    [](const auto& c) { return std::string(c.param.name); });

TEST(FindingsTest, TwoFaultsAreTwoFindings) {
  BrokenArm arm({Fault::kTwo, "two", 0.9}, Regime::kTagIso, kBlock, 3);
  const KnownLife life(&arm);
  SCOPED_TRACE(life.log);
  for (const int block : {1, 3}) {
    ASSERT_EQ(life.at_end[block].size(), 2U);
    for (const Finding& finding : life.at_end[block])
      EXPECT_TRUE(finding.to == 3 || finding.to == 7 || finding.part == 7);
  }
  EXPECT_TRUE(life.at_end[2].empty());
}

TEST(FindingsTest, WhatADriftLeftIsConfirmedByEverySampleAfterItsEnd) {
  constexpr double kRate_deg = 0.5, kMost_deg = 15;
  BrokenArm arm({Fault::kDrift, "", 0.85, kRate_deg, kMost_deg}, Regime::kTagIso, kBlock, 1);
  const KnownLife life(&arm);
  SCOPED_TRACE(life.log);
  ASSERT_EQ(life.at_end[1].size(), 1U);
  const Finding& left = life.at_end[1].front();
  EXPECT_EQ(left.state, State::kConfirmed);
  EXPECT_GE(left.num_confirming, 2 * kBlock - 1 - left.adopted);
  EXPECT_LE(left.num_confirming, kBlock - kMost_deg / kRate_deg);
}

TEST(FindingsTest, NothingIsWrongWithAHealthyArm) {
  BrokenArm arm({Fault::kNone, "none", 0.9}, Regime::kTagIso, kBlock, 4);
  const KnownLife life(&arm);
  for (const auto& findings : life.at_end) EXPECT_TRUE(findings.empty()) << life.log;
}

AdaptationEvent event(AdaptationEvent::Kind kind, const std::string& cause, int from, int to) {
  AdaptationEvent event;
  event.kind = kind;
  event.cause = cause;
  event.from = from;
  event.to = to;
  return event;
}

TEST(HealthWordsTest, AnEventSaysWhatWhereHowMuchAndSinceWhen) {
  using Kind = AdaptationEvent::Kind;
  const std::vector<Signal> signals = {{"q1", -1, 1}, {"q2", -1, 1}, {"q3", -1, 1}};
  AdaptationEvent stuck = event(Kind::kCandidate, "joint_stuck", 4, 5);
  stuck.size = {ChangeSize::Kind::kCommand, 2, {-0.2132}, {0.0121}};
  stuck.since = 290;
  stuck.num_samples = 2;
  stuck.margin = 31.44;
  EXPECT_EQ(text_of(stuck, signals),
            "q3 (4→5) stuck at −0.21 ± 0.01 since sample 290: adopted after 2 samples, by 31.4 "
            "nats");
  stuck.kind = Kind::kRecovered;
  stuck.num_samples = 40;
  stuck.margin = 0;
  EXPECT_EQ(text_of(stuck, signals),
            "q3 (4→5) stuck at −0.21 ± 0.01 since sample 290: confirmed by 40 samples");
  stuck.kind = Kind::kReverted;
  EXPECT_EQ(text_of(stuck, signals), "q3 (4→5) stuck at −0.21 ± 0.01: undone");

  AdaptationEvent bent = event(Kind::kRefined, "geometry", 5, 6);
  bent.size = {ChangeSize::Kind::kPose, -1, {0.0571, 0.349}, {0.0003, 0.002}};
  bent.since = 7;
  EXPECT_EQ(text_of(bent, signals),
            "5→6 bent or exchanged by 57.1 ± 0.3 mm, 20.0 ± 0.1° since sample 7: adopted instead");
  AdaptationEvent back = event(Kind::kRestored, "stored", 5, 6);
  back.since = 12;
  back.is_normal = true;
  EXPECT_EQ(text_of(back, signals), "5→6: back to normal since sample 12");
  back.is_normal = false;
  EXPECT_EQ(text_of(back, signals), "5→6: as once before, adopted again since sample 12");

  AdaptationEvent lost = event(Kind::kMissing, "marker_missing", -1, -1);
  lost.part = 9;
  lost.since = 30;
  EXPECT_EQ(text_of(lost, signals), "marker of part 9 not seen since sample 30: found");
  lost.kind = Kind::kRecovered;
  lost.since = -1;
  EXPECT_EQ(text_of(lost, signals), "marker of part 9 is seen again: back to normal");
  lost.tag = 34;
  EXPECT_EQ(text_of(lost, signals), "tag 34 of part 9 is where it was again: back to normal");

  EXPECT_EQ(text_of(event(Kind::kMismatch, "", 4, 5), signals), "4→5 not as known: found");
  EXPECT_EQ(text_of(event(Kind::kRecovered, "unexplained", 4, 5), signals),
            "4→5: back to normal by itself, unexplained");
  AdaptationEvent camera = event(Kind::kMismatch, "camera_moved", -1, -1);
  camera.part = 1;
  EXPECT_EQ(text_of(camera, signals), "camera not as known: found");
}

TEST(HealthWordsTest, AFindingSaysHowFarOneIsWithIt) {
  const std::vector<Signal> signals = {{"q1", -1, 1}};
  Finding finding{.state = State::kConfirmed, .from = 4, .to = 5, .cause = "joint_stuck"};
  finding.size = {ChangeSize::Kind::kCommand, 0, {-12}, {-1}};
  finding.since = finding.found = 290;
  finding.adopted = 291;
  finding.num_confirming = 40;
  EXPECT_EQ(text_of(finding, signals),
            "q1 (4→5) stuck at −12.00 since sample 290, in the schema since 291, confirmed by 40 "
            "samples");
  finding.state = State::kAdopted;
  finding.num_confirming = 1;
  EXPECT_EQ(
      text_of(finding, signals),
      "q1 (4→5) stuck at −12.00 since sample 290, in the schema since 291, not confirmed yet (1 "
      "sample)");
  finding.state = State::kFound;
  finding.cause = "";
  finding.size = {};
  EXPECT_EQ(text_of(finding, signals),
            "4→5 not as known since sample 290, found at 290, not explained yet");
  Finding drift{.state = State::kFollowed, .from = 5, .to = 6, .cause = "drift"};
  drift.size = {ChangeSize::Kind::kRate, -1, {0.0011, 0.5 * kDegree}, {-1, 0.02 * kDegree}};
  drift.since = 3;
  EXPECT_EQ(text_of(drift, signals),
            "5→6 drifts by 1.10 mm, 0.50 ± 0.02° a sample since sample 3, followed");
}

}  // namespace
}  // namespace bodyschema
