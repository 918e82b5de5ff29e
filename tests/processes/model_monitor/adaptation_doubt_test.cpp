// Class Adaptation: what is ambiguous, restored, remembered or drifts.

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <set>

#include "common/geometry/angle.h"
#include "processes/structure_learner/learn.h"
#include "tests/processes/model_monitor/adaptation_life.h"
#include "tests/support/imperfect_robot.h"

namespace bodyschema::test {
namespace {

TEST(AdaptationTest, WhatIsRestoredIsToldInAllItsPlacesAndNotWhereAMarkerIsAnOutlier) {
  using Place = std::pair<int, bool>;  // part, marker
  const std::vector<std::pair<Fault, std::set<Place>>> cases = {
      {Fault::kMarker, {{3, true}}}, {Fault::kTwo, {{3, false}, {7, false}}}};
  for (const auto& [fault, changed] : cases) {
    BrokenArm arm({fault, "", 1}, Regime::kTagIso, kBlock, 3);
    Adaptation adaptation(arm.engineered(), adaptation_options(Regime::kTagIso));
    Life life = live(arm, adaptation, 2 * kBlock);
    ASSERT_TRUE(adaptation.is_settled()) << life.log();
    // From the repair until it is found the root's marker is seen tilted, now so, now so.
    life.events.clear();
    for (int t = 2 * kBlock; t < 2 * kBlock + 3 && life.events.empty(); ++t) {
      ActionPoseSample sample = arm.observe(t);
      for (PartObservation& o : sample.parts) {
        if (o.part != 1) continue;
        o.X_CB.linear() *= exp_so3(1.2 * Eigen::Vector3d::Unit(t % 3));
        o.X_CB_other.reset();
      }
      life.events = adaptation.on_sample(sample);
    }
    SCOPED_TRACE("events:\n" + life.log());
    std::set<Place> told;
    for (const AdaptationEvent& e : life.events) {
      EXPECT_TRUE(arm.is_near(part_of(e))) << text(e);
      if (e.kind == Kind::kRestored) told.insert({part_of(e), e.part >= 0});
    }
    EXPECT_EQ(told, changed);
    std::set<Place> provisional;
    for (const int part : adaptation.schema().parts) {
      if (adaptation.edge_state(part) == EdgeState::kProvisional) provisional.insert({part, false});
      if (adaptation.marker_state(part) == EdgeState::kProvisional)
        provisional.insert({part, true});
    }
    EXPECT_EQ(provisional, changed);
  }
}

/// Nothing is told of a healthy robot, but where a link bends after that.
void expect_bend_alone(const Imperfection& imperfection, int num_joints, int seed,
                       int num_healthy) {
  SCOPED_TRACE(std::to_string(num_joints) + " joints, seed " + std::to_string(seed));
  ImperfectRobot robot(num_joints, true, imperfection, static_cast<std::uint64_t>(seed));
  LearnOptions learning;
  learning.root = 1;
  learning.measurement.noise = Noise{0.003, 1 * kDegree};
  AdaptationOptions options;
  options.measurement.noise = learning.measurement.noise;
  Adaptation adaptation(learn(robot.signals(), robot.babble(100), learning).schema, options);
  for (int n = 0; n < num_healthy; ++n)
    for (const AdaptationEvent& e : adaptation.on_sample(robot.go(robot.random_action())))
      EXPECT_EQ(e.kind, Kind::kProbeWanted) << text(e);
  const int bent = 2 + num_joints / 2;
  robot.bend(bent, 0.03, 20 * kDegree);
  bool is_found = false;
  for (int n = 0; n < 20; ++n)
    for (const AdaptationEvent& e : adaptation.on_sample(robot.go(robot.random_action())))
      is_found |= part_of(e) == bent;
  EXPECT_TRUE(is_found);
}

// A fifth of all readings: some flips come in a row, in like views, and agree.
TEST(AdaptationTest, FlipsInARowAreNoChange) {
  for (const int num_joints : {3, 4, 5, 6})
    expect_bend_alone({.flip_share = 0.2}, num_joints, 497 + num_joints, 500);
}

TEST(AdaptationTest, WhatAViewBiasesIsNoChange) {
  for (const int seed : {504, 509})
    expect_bend_alone({.view_bias_m = 0.004, .view_bias_deg = 2}, 7, seed, 200);
}

// The first samples show little of noise that lasts.
TEST(AdaptationTest, NoiseThatLastsIsNoChange) {
  for (const int seed : {504, 507, 509})
    expect_bend_alone({.correlation = 0.9}, 3 + (seed - 500) % 5, seed, 60);
}

TEST(AdaptationTest, AnAmbiguousEdgeIsReportedOnceItIsLocalised) {
  for (const int seed : {1, 2, 3}) {
    BrokenArm arm({Fault::kCamera, "", 1}, Regime::kTagIso, 20, seed);
    Adaptation adaptation(arm.engineered(), adaptation_options(Regime::kTagIso));
    Life life = live(arm, adaptation, 20);
    ASSERT_TRUE(life.events.empty()) << life.log();
    // The camera is bumped, and the first three parts are out of its sight.
    ActionPoseSample sample = arm.observe(20);
    std::erase_if(sample.parts, [](const PartObservation& o) { return o.part <= 3; });
    life.events = adaptation.on_sample(sample);
    EXPECT_TRUE(life.events.empty()) << life.log();
    int num_invalid = 0;
    for (const int part : adaptation.schema().parts)
      num_invalid += adaptation.edge_state(part) == EdgeState::kInvalid;
    EXPECT_EQ(num_invalid, 1) << "the arm is not to be relied upon";
    for (int t = 21; t < 24; ++t)
      for (const AdaptationEvent& e : adaptation.on_sample(arm.observe(t)))
        life.events.push_back(e);
    SCOPED_TRACE("events:\n" + life.log());
    ASSERT_TRUE(life.has(Kind::kMismatch));
    EXPECT_TRUE(life.has(Kind::kCandidate));
    for (const AdaptationEvent& e : life.events) EXPECT_EQ(part_of(e), 1) << text(e);
  }
}

// A stored body with a bent link explains part of the first sample after the camera moved; the
// camera must be found all the same.
TEST(AdaptationTest, ARememberedBendDoesNotHideThatTheCameraMoved) {
  for (int seed = 1; seed <= 10; ++seed) {
    BrokenArm arm({Fault::kNone, "", 1}, Regime::kTagIso, 20, seed);
    const BodySchema& settled = arm.engineered();
    Pose T = Pose::Identity();
    T.linear() = exp_so3(Eigen::Vector3d(0.02, 0.03, -0.01));
    T.translation() << 0.02, -0.04, 0.03;
    BodySchema bent = settled;
    for (Edge& edge : bent.edges)
      if (edge.to == 4) {  // by as much as the camera will have moved, in mid-range
        const Pose X_CA =
            settled.X_CR *
            settled.predict(1, edge.from, Eigen::VectorXd::Zero(arm.observe(0).action.size()))
                ->X_AB;
        edge.left = X_CA.inverse() * T * X_CA * edge.left;
      }
    Adaptation adaptation(settled, adaptation_options(Regime::kTagIso), {settled, bent}, {});
    Life life;
    for (int t = 1; t < 60; ++t) {
      ActionPoseSample sample = arm.observe(t);
      for (PartObservation& o : sample.parts) {
        if (t < 20) break;
        o.X_CB = T * o.X_CB;
        if (o.X_CB_other) o.X_CB_other = T * *o.X_CB_other;
      }
      for (const AdaptationEvent& e : adaptation.on_sample(sample)) life.events.push_back(e);
    }
    std::map<int, std::string> standing;
    for (const AdaptationEvent& e : life.events) {
      if (e.kind == Kind::kReverted) standing.erase(part_of(e));
      if (e.kind == Kind::kCandidate || e.kind == Kind::kRestored || e.kind == Kind::kRefined)
        standing[part_of(e)] = e.cause;
    }
    EXPECT_EQ(standing, (std::map<int, std::string>{{1, "camera_moved"}})) << seed << "\n"
                                                                           << life.log();
  }
}

TEST(AdaptationTest, WhatIsOverBeforeItsPlaceIsKnownIsNotTold) {
  for (const int seed : {1, 2, 3}) {
    BrokenArm arm({Fault::kNone, "", 1}, Regime::kTagIso, 20, seed);
    Adaptation adaptation(arm.engineered(), adaptation_options(Regime::kTagIso));
    Life life;
    for (int t = 0; t < 40; ++t) {
      ActionPoseSample sample = arm.observe(t);
      if (t == 20) {  // for one sample the table is knocked, and only half the arm is in sight
        Pose T = Pose::Identity();
        T.linear() = exp_so3(Eigen::Vector3d(0.02, 0.03, 0));
        std::erase_if(sample.parts, [](const PartObservation& o) { return o.part <= 3; });
        for (PartObservation& o : sample.parts) {
          o.X_CB = T * o.X_CB;
          o.X_CB_other.reset();
        }
      }
      for (const AdaptationEvent& e : adaptation.on_sample(sample)) life.events.push_back(e);
      if (t == 20) {
        EXPECT_FALSE(adaptation.is_settled());
      }
    }
    EXPECT_TRUE(life.events.empty()) << life.log();
    EXPECT_TRUE(adaptation.is_settled());
  }
}

TEST(AdaptationTest, AProbeIsWantedOncePerAmbiguity) {
  for (const auto& [fault, seed] : {std::pair{Fault::kOffset, 14}, {Fault::kAdjacent, 3}}) {
    BrokenArm arm({fault, "", 0.85}, Regime::kChapter, 90, seed);
    Adaptation adaptation(arm.engineered(), adaptation_options(Regime::kChapter));
    const Life life = live(arm, adaptation, 180);
    SCOPED_TRACE("events:\n" + life.log());
    std::map<std::pair<int, std::string>, int> asked;  // part, the two explanations
    for (const AdaptationEvent& e : life.events) {
      if (e.kind != Kind::kProbeWanted) continue;
      EXPECT_GE(e.margin, 0) << text(e);
      EXPECT_LE(e.margin, adaptation.options().ambiguity) << text(e);
      const std::string& one = e.cause;
      const std::string& other = e.other_cause.empty() ? one : e.other_cause;
      // "geometry" is several forms, and each of two may be a small one.
      if (one != "geometry" && other != "geometry")
        ++asked[{part_of(e), std::min(one, other) + "," + std::max(one, other)}];
    }
    for (const auto& [what, count] : asked) EXPECT_LE(count, 2) << what.first << what.second;
    EXPECT_TRUE(life.has(Kind::kProbeWanted));
  }
}

TEST(AdaptationTest, WhatHasSettledIsStillFittedToMoreSamplesForAWhileAndKeptSo) {
  double settled = 0, matured = 0;
  for (const int seed : {1, 2, 3}) {
    BrokenArm arm({Fault::kTool, "", 0.79}, Regime::kChapter, 110, seed);
    Adaptation adaptation(arm.engineered(), adaptation_options(Regime::kChapter));
    const Life life = live(arm, adaptation, 220);
    SCOPED_TRACE("events:\n" + life.log());
    for (const AdaptationEvent& e : life.events) EXPECT_LT(e.sample_index, 160) << text(e);
    settled += life.error[159];
    matured += life.error[219];
    EXPECT_EQ(life.error[219], life.error[209]) << "for ever";
    // Both bodies are remembered, the new one as it became.
    ASSERT_EQ(adaptation.history().size(), 2);
    EXPECT_EQ(arm.error(adaptation.history()[0], 0), arm.error(arm.engineered(), 0));
    EXPECT_EQ(arm.error(adaptation.history()[1], 219), life.error[219]);
  }
  // Twice the samples: a third less of the tool's part of the error.
  EXPECT_LT(matured, 0.9 * settled);
}

TEST(AdaptationTest, TwoSchemasOfOneBodyAreRememberedAsOne) {
  BrokenArm arm({Fault::kTool, "", 0.85}, Regime::kTagIso, 100, 2);
  const AdaptationOptions options = adaptation_options(Regime::kTagIso);
  Adaptation adaptation(arm.engineered(), options);
  live(arm, adaptation, 145);
  const BodySchema of_45 = adaptation.schema();
  for (int t = 145; t < 195; ++t) adaptation.on_sample(arm.observe(t));
  const BodySchema of_95 = adaptation.schema();
  ASSERT_NE(of_45.edges.back().right.matrix(), of_95.edges.back().right.matrix());
  const auto remembered = [&](const BodySchema& stored, const BodySchema& now) {
    return Adaptation(now, options, {arm.engineered(), stored}, {}).history();
  };
  // The newest stands for both.
  ASSERT_EQ(remembered(of_45, of_95).size(), 2U);
  EXPECT_EQ(remembered(of_45, of_95)[1].edges.back().right.matrix(),
            of_95.edges.back().right.matrix());
  BodySchema another = of_95;
  another.edges.back().right.translation().x() += 0.02;
  EXPECT_EQ(remembered(of_95, another).size(), 3U);
  // The first is kept as it is.
  BodySchema first = arm.engineered();
  first.edges.back().right.translation().x() += 1e-7;
  EXPECT_EQ(remembered(of_95, first).size(), 2U);
}

TEST(AdaptationTest, ASlowDriftIsNamedAndFollowed) {
  BrokenArm arm({Fault::kDrift, "", 0.85}, Regime::kTagIso, 100, 2);
  Adaptation adaptation(arm.engineered(), adaptation_options(Regime::kTagIso));
  const Life life = live(arm, adaptation, 400);
  EXPECT_TRUE(std::any_of(life.events.begin(), life.events.end(), [](const AdaptationEvent& e) {
    return e.kind == Kind::kDrift && e.to == 4 && e.cause == "drift";
  })) << life.log();
  EXPECT_LT(*std::max_element(life.error.begin(), life.error.end()), 0.020);
  EXPECT_LT(life.error.back(), 0.006);
  EXPECT_GT(arm.error(arm.engineered(), 399), 0.03);
}

/// Faster than the step tests are slow: at first it looks like a step, and is taken for one until
/// samples tell.
TEST(AdaptationTest, AFastDriftIsADrift) {
  constexpr double kMost_deg = 25;
  constexpr int kAfter = 30;
  for (const double rate_deg : {0.1, 0.3, 0.5, 1.0})
    for (const int seed : {1, 2, 3}) {
      BrokenArm arm({Fault::kDrift, "", 0.85, rate_deg, kMost_deg}, Regime::kTagIso, kBlock, seed);
      Adaptation adaptation(arm.engineered(), adaptation_options(Regime::kTagIso));
      const int end = kBlock + static_cast<int>(std::ceil(kMost_deg / rate_deg));
      const Life life = live(arm, adaptation, end + kAfter);
      SCOPED_TRACE("by " + std::to_string(rate_deg) + "° a sample, seed " + std::to_string(seed) +
                   ", over at " + std::to_string(end) + ":\n" + life.log());
      std::vector<AdaptationEvent> drifts, ends;
      for (const AdaptationEvent& e : life.events) {
        EXPECT_TRUE(e.sample_index >= kBlock && arm.is_near(part_of(e))) << text(e);
        if (e.kind == Kind::kDrift) drifts.push_back(e);
        if (e.kind == Kind::kRecovered) ends.push_back(e);
      }
      // Told once, at its edge, before it has gone far; and its end soon after that.
      ASSERT_EQ(drifts.size(), 1U);
      EXPECT_EQ(drifts[0].to, 4);
      EXPECT_EQ(drifts[0].cause, "drift");
      EXPECT_LT((static_cast<double>(drifts[0].sample_index) - kBlock) * rate_deg, 12);
      EXPECT_NEAR(static_cast<double>(drifts[0].since), kBlock, 12);
      ASSERT_EQ(drifts[0].size.amounts.size(), 2U);
      EXPECT_NEAR(drifts[0].size.amounts[1], rate_deg * kDegree, 0.6 * rate_deg * kDegree);
      if (rate_deg > 0.2) {
        ASSERT_EQ(ends.size(), 1U);
        EXPECT_EQ(ends[0].cause, "drift");
        EXPECT_LT(ends[0].sample_index, end + 15);
        EXPECT_TRUE(adaptation.is_settled());
      }
      const double healthy = life.error[kBlock - 1];
      EXPECT_LT(*std::max_element(life.error.begin(), life.error.end()), healthy + 0.025);
      for (int t = end + 10; t < end + kAfter; ++t)
        EXPECT_LT(life.error[static_cast<std::size_t>(t)], healthy + 0.006) << "sample " << t;
    }
}

TEST(AdaptationTest, WhatBreaksWhileALinkDriftsIsFoundAllTheSame) {
  BrokenArm arm({Fault::kDrift, "", 1}, Regime::kTagIso, 60, 2);
  Adaptation adaptation(arm.engineered(), adaptation_options(Regime::kTagIso));
  Pose tool = Pose::Identity();
  tool.translation() << 0.1, 0, 0.05;
  tool.linear() = exp_so3(Eigen::Vector3d(0.5, 0, 0));
  Life life;
  std::vector<double> distances;  // of what is seen from what is predicted, in the end
  for (int t = 0; t < 240; ++t) {
    ActionPoseSample sample = arm.observe(t);
    if (t >= 180)
      for (PartObservation& o : sample.parts) {
        if (o.part != 7) continue;
        o.X_CB = o.X_CB * tool;
        if (o.X_CB_other) *o.X_CB_other = *o.X_CB_other * tool;
      }
    for (const auto& e : adaptation.on_sample(sample)) life.events.push_back(e);
    const PartObservation* seen = sample.find(7);
    if (t < 220 || !seen) continue;
    const Pose X_CB =
        adaptation.schema().X_CR * adaptation.schema().predict_all(sample.action).at(7);
    distances.push_back((X_CB.translation() - seen->X_CB.translation()).norm());
  }
  SCOPED_TRACE("events:\n" + life.log());
  EXPECT_TRUE(std::any_of(life.events.begin(), life.events.end(), [](const AdaptationEvent& e) {
    return e.kind == Kind::kDrift && e.sample_index < 180;
  }));
  EXPECT_TRUE(std::any_of(life.events.begin(), life.events.end(), [](const AdaptationEvent& e) {
    return e.kind == Kind::kCandidate && part_of(e) == 7 && e.sample_index >= 180 &&
           e.sample_index < 186;
  }));
  std::nth_element(distances.begin(), distances.begin() + std::ssize(distances) / 2,
                   distances.end());
  EXPECT_LT(distances[distances.size() / 2], 0.015);
}

}  // namespace
}  // namespace bodyschema::test
