// Class Adaptation: faults are found, named and repaired; healthy arms are left in peace.

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>

#include "tests/processes/model_monitor/adaptation_life.h"

namespace bodyschema::test {
namespace {

/// One seed each, tag_iso: 3 mm, 1°, 3 % of the markers flipped or anywhere.
class WholeLife : public testing::TestWithParam<Scenario> {
 protected:
  WholeLife() {
    for (const AdaptationEvent& e : life.events) {
      EXPECT_GE(e.sample_index, kBlock) << "before the fault\n" << life.log();
      EXPECT_TRUE(arm.is_near(part_of(e))) << text(e) << "\n" << life.log();
    }
  }

  BrokenArm arm{GetParam(), Regime::kTagIso, kBlock, 3};
  Adaptation adaptation{arm.engineered(), adaptation_options(Regime::kTagIso)};
  const Life life = live(arm, adaptation, arm.num_samples());
};

class EveryFault : public WholeLife {};

TEST_P(EveryFault, IsFoundNamedAndRepairedAndBothBodiesAreRemembered) {
  SCOPED_TRACE("events:\n" + life.log());
  EXPECT_TRUE(life.has(Kind::kMismatch));
  EXPECT_TRUE(life.has(Kind::kRestored));
  // Named in the end of the first fault.
  for (const TrueChange& change : arm.changes()) {
    EXPECT_TRUE(std::any_of(life.events.begin(), life.events.end(),
                            [&](const AdaptationEvent& e) {
                              return e.kind == Kind::kRecovered && e.sample_index < 2 * kBlock &&
                                     part_of(e) == change.part && change.causes.contains(e.cause) &&
                                     (e.part >= 0 ? change.at_marker : change.at_edge);
                            }))
        << "part " << change.part;
  }
  const double healthy = life.error[kBlock - 1];
  for (int block = 1; block < 4; ++block)
    for (int t = block * kBlock + 15; t < (block + 1) * kBlock; ++t)
      ASSERT_LT(life.error[static_cast<std::size_t>(t)], healthy + 0.01) << "sample " << t;
}

INSTANTIATE_TEST_SUITE_P(
    AdaptationTest, EveryFault,
    testing::Values(Scenario{Fault::kStuck, "stuck", 0.919}, Scenario{Fault::kTool, "tool", 0.79},
                    Scenario{Fault::kBend, "bend", 0.85}, Scenario{Fault::kOffset, "offset", 0.85},
                    Scenario{Fault::kGain, "gain", 0.85}, Scenario{Fault::kTwo, "two", 0.85},
                    Scenario{Fault::kAdjacent, "adjacent", 0.85},
                    Scenario{Fault::kMarker, "marker", 0.85},
                    Scenario{Fault::kCamera, "camera", 0.85}),
    [](const auto& info) { return std::string(info.param.name); });

// Between the gains 1 and −1 of a joint that turns by ±160° lie others that explain some samples.
TEST(AdaptationTest, AReversedJointIsMendedWithinTenSamples) {
  for (int seed = 1; seed <= 6; ++seed) {
    BrokenArm arm({.fault = Fault::kReversed, .visible = 0.85, .range_rad = 2.8}, Regime::kTagIso,
                  kBlock, seed);
    Adaptation adaptation(arm.engineered(), adaptation_options(Regime::kTagIso));
    const Life life = live(arm, adaptation, kBlock + 11);
    EXPECT_LT(life.error.back(), life.error[kBlock - 1] + 0.01) << seed << "\n" << life.log();
  }
}

class NoFamily : public WholeLife {};

/// What none of the simple changes explains: the edge is learned, and kept like any other.
TEST_P(NoFamily, IsLearnedAndBothBodiesAreRemembered) {
  SCOPED_TRACE("events:\n" + life.log());
  const TrueChange& change = arm.changes().front();
  EXPECT_TRUE(std::any_of(life.events.begin(), life.events.end(), [&](const AdaptationEvent& e) {
    return e.kind == Kind::kCandidate && e.sample_index < kBlock + 25 && e.to == change.part &&
           change.causes.contains(e.cause);
  }));
  const double healthy = life.error[kBlock - 1], unrepaired = arm.error(arm.engineered(), kBlock);
  ASSERT_GT(unrepaired, 0.04);
  const auto stays_below = [&](int begin, int end, double most) {
    for (int t = begin; t < end; ++t)
      ASSERT_LT(life.error[static_cast<std::size_t>(t)], most) << "sample " << t;
  };
  stays_below(kBlock + 25, 2 * kBlock, unrepaired / 4);
  stays_below(2 * kBlock - 5, 2 * kBlock, healthy + 0.005);
  stays_below(2 * kBlock + 8, 3 * kBlock, healthy + 0.001);
  stays_below(3 * kBlock + 8, 4 * kBlock, healthy + 0.005);
}

INSTANTIATE_TEST_SUITE_P(AdaptationTest, NoFamily,
                         testing::Values(Scenario{Fault::kWorn, "worn", 0.85},
                                         Scenario{Fault::kCoupled, "coupled", 0.85},
                                         Scenario{Fault::kElastic, "elastic", 0.85}),
                         [](const auto& info) { return std::string(info.param.name); });

TEST(AdaptationTest, AnEdgeThatIsElsewhereAtEverySampleIsNotLearned) {
  BrokenArm arm({Fault::kNone, "", 1}, Regime::kTagIso, 50, 1);
  Adaptation adaptation(arm.engineered(), adaptation_options(Regime::kTagIso));
  Rng rng(1);
  Life life;
  for (int t = 0; t < 150; ++t) {
    ActionPoseSample sample = arm.observe(t);
    Vector6d wobble = Vector6d::Zero();
    for (int c = 3; c < 6; ++c) wobble(c) = t < 50 || t >= 110 ? 0 : uniform(rng, -1, 1);
    const PartObservation* joint = sample.find(4);
    if (!joint) continue;
    // Part 4 and all that it carries, about its origin.
    const Pose T = joint->X_CB * exp(wobble) * joint->X_CB.inverse();
    for (PartObservation& o : sample.parts) {
      if (o.part < 4) continue;
      o.X_CB = T * o.X_CB;
      o.X_CB_other.reset();
    }
    for (const auto& e : adaptation.on_sample(sample)) life.events.push_back(e);
  }
  EXPECT_TRUE(life.has(Kind::kMismatch));
  for (const AdaptationEvent& e : life.events) {
    EXPECT_NE(e.cause, "joint_nonlinear") << text(e);
    EXPECT_NE(e.cause, "new_model") << text(e);
  }
}

TEST(AdaptationTest, AHealthyArmIsLeftInPeace) {
  for (const Regime regime : {Regime::kChapter, Regime::kTag, Regime::kTagIso}) {
    BrokenArm arm({Fault::kNone, "", 0.85}, regime, 50, 1);
    Adaptation adaptation(arm.engineered(), adaptation_options(regime));
    const Life life = live(arm, adaptation, 200);
    EXPECT_TRUE(life.events.empty()) << name_of(regime) << ":\n" << life.log();
    EXPECT_TRUE(adaptation.is_settled());
    for (const int part : adaptation.schema().parts)
      EXPECT_NE(adaptation.edge_state(part), EdgeState::kInvalid);
  }
}

TEST(AdaptationTest, FaintSuspicionsAddUpToNoChange) {
  // An edge at the limit of what its noise explains is suspected off and on for 600 samples.
  BrokenArm arm({Fault::kNone, "", 0.85}, Regime::kTagIso, 1250, 1006);
  Adaptation adaptation(arm.engineered(), adaptation_options(Regime::kTagIso));
  const Life life = live(arm, adaptation, 650);
  EXPECT_TRUE(life.events.empty()) << life.log();
}

TEST(AdaptationTest, AMarkerThatOnlyUncertainModelsBelieveIsNoDrift) {
  // This arm's window of drift watching has one such by sample 74, of the edge to part 6.
  BrokenArm arm({Fault::kNone, "", 0.85}, Regime::kChapter, 25, 14);
  Adaptation adaptation(arm.engineered(), adaptation_options(Regime::kChapter));
  const Life life = live(arm, adaptation, 100);
  EXPECT_TRUE(life.events.empty()) << life.log();
}

TEST(AdaptationTest, MisjudgedNoiseIsEstimatedAndTheFaultIsFoundAllTheSame) {
  for (const double factor : {0.5, 2.0}) {
    BrokenArm arm({Fault::kTool, "", 0.85}, Regime::kTagIso, kBlock, 4);
    Adaptation adaptation(arm.engineered(), adaptation_options(Regime::kTagIso, factor));
    Life life = live(arm, adaptation, 2 * kBlock);
    EXPECT_NEAR(adaptation.noise_scale() * factor, 1, 0.25);
    ASSERT_FALSE(life.events.empty());
    EXPECT_GE(life.events.front().sample_index, kBlock) << life.log();
    EXPECT_LT(life.error.back(), 0.03);
  }
}

/// A joint that follows nothing looks stuck, offset, rigid … by turns: changes of one place follow
/// upon each other, and one takes away the joint that another was about (with this seed).
TEST(AdaptationTest, AJointThatFollowsNothingIsFoundAndSoIsItsRepair) {
  BrokenArm arm({Fault::kNone, "", 0.85}, Regime::kChapter, 75, 6);
  Adaptation adaptation(arm.engineered(), adaptation_options(Regime::kChapter));
  Rng rng(6);
  Life life;
  for (int t = 0; t < arm.num_samples(); ++t) {
    ActionPoseSample sample = arm.observe(t);
    if (t >= 50 && t < 150) sample.action(4) = uniform(rng, -1, 1);
    for (const auto& e : adaptation.on_sample(sample)) life.events.push_back(e);
  }
  EXPECT_TRUE(std::any_of(life.events.begin(), life.events.end(), [](const AdaptationEvent& e) {
    return e.kind == Kind::kMismatch && e.sample_index < 60 && std::abs(part_of(e) - 6) <= 1;
  })) << life.log();
  EXPECT_LT(arm.error(adaptation.schema(), 0), 0.05) << life.log();
}

TEST(AdaptationTest, WhatNothingExplainsIsOverSoonAfterItEnds) {
  // A part is a hand's breadth beside where it was, elsewhere at each sample, for forty samples.
  BrokenArm arm({Fault::kNone, "", 1}, Regime::kTagIso, 50, 1);
  Adaptation adaptation(arm.engineered(), adaptation_options(Regime::kTagIso));
  Rng rng(1);
  Life life;
  double highest = 0;
  for (int t = 0; t < 140; ++t) {
    ActionPoseSample sample = arm.observe(t);
    for (PartObservation& o : sample.parts) {
      if (o.part != 4 || t < 50 || t >= 90) continue;
      Vector6d error = gaussian6(rng);
      error.head<3>() *= 0.06;
      error.tail<3>() *= 0.4;
      o.X_CB = o.X_CB * exp(error);
      o.X_CB_other.reset();
    }
    for (const auto& e : adaptation.on_sample(sample)) life.events.push_back(e);
    if (t < 90) continue;
    for (const int part : {2, 3, 4, 5})
      highest =
          std::max({highest, adaptation.edge_statistic(part), adaptation.marker_statistic(part)});
  }
  // Else it took as long again.
  EXPECT_LE(highest, 2 * std::log(2 * 7 / adaptation.options().false_alarm_rate) + 1e-9);
  EXPECT_TRUE(adaptation.is_settled()) << life.log();
  for (const int part : {2, 3, 4, 5}) {
    EXPECT_EQ(adaptation.edge_state(part), EdgeState::kOk) << part << life.log();
    EXPECT_EQ(adaptation.marker_state(part), EdgeState::kOk) << part << life.log();
  }
}

TEST(AdaptationTest, WhatIsNeverSeenIsNotSuspected) {
  BrokenArm arm({Fault::kStuck, "", 0.919}, Regime::kTagIso, kBlock, 3);
  Adaptation adaptation(arm.engineered(), adaptation_options(Regime::kTagIso));
  Life life;
  for (int t = 0; t < 2 * kBlock; ++t) {
    ActionPoseSample sample = arm.observe(t);
    std::erase_if(sample.parts,
                  [](const PartObservation& o) { return o.part == 4 || o.part == 7; });
    for (const auto& e : adaptation.on_sample(sample)) life.events.push_back(e);
  }
  EXPECT_TRUE(life.has(Kind::kCandidate));
  for (const AdaptationEvent& e : life.events) {
    EXPECT_GE(e.sample_index, kBlock);
    EXPECT_TRUE(arm.is_near(part_of(e))) << text(e);
  }
  EXPECT_TRUE(std::any_of(life.events.begin(), life.events.end(), [](const AdaptationEvent& e) {
    return e.kind == Kind::kRecovered && e.to == 5 && e.cause == "joint_stuck";
  })) << life.log();
}

TEST(AdaptationTest, TheSameSamplesGiveTheSameEventsAndSchema) {
  for (const Fault fault : {Fault::kGain, Fault::kWorn, Fault::kDrift}) {
    const auto once = [fault] {
      BrokenArm arm({fault, "", 0.85, 0.5, 25}, Regime::kTagIso, 40, 5);
      Adaptation adaptation(arm.engineered(), adaptation_options(Regime::kTagIso));
      const Life life = live(arm, adaptation, 160);
      return std::pair{life.log(), life.error};
    };
    const auto first = once(), second = once();
    EXPECT_FALSE(first.first.empty());
    EXPECT_EQ(first.first, second.first);
    EXPECT_EQ(first.second, second.second);
  }
}

/// A palm on an arm and two fingers on one signal, and the schema of that robot.
std::pair<SyntheticRobot, BodySchema> two_fingers(Rng& rng) {
  SyntheticRobot robot;
  robot.X_CR.translation() << 0, 0, 2;
  robot.links.push_back({.part = 1});
  BodySchema schema;
  schema.root = 1;
  schema.X_CR = robot.X_CR;
  schema.parts = {1};
  for (const auto& [part, parent, signal] :
       {std::tuple{2, 1, 0}, {3, 2, 1}, {4, 3, 2}, {5, 3, 2}}) {
    TrueLink link;
    link.part = part;
    link.parent = parent;
    link.signal = signal;
    link.turn = part == 5 ? -1 : 1;
    link.X_before = random_pose(rng, 0.06, 0.16);
    link.X_after = random_pose(rng, 0.06, 0.16);
    robot.links.push_back(link);
    Edge edge;
    edge.from = parent;
    edge.to = part;
    edge.left = link.X_before;
    ScrewJoint joint;
    joint.signal = signal;
    joint.turn = link.turn;
    joint.X_after = link.X_after;
    edge.joints.push_back(joint);
    edge.parameter_covariance = 1e-6 * Eigen::MatrixXd::Identity(14, 14);
    schema.edges.push_back(edge);
    schema.parts.push_back(part);
  }
  for (int s = 0; s < 3; ++s) robot.signals.push_back({"q" + std::to_string(s + 1), -1.3, 1.3});
  schema.signals = robot.signals;
  schema.complete = true;
  return {robot, schema};
}

/// One finger of two bends; the other, on the same palm and the same signal, does not.
TEST(AdaptationTest, OfTwoFingersTheBentOneIsFound) {
  Rng rng(8);
  const auto [robot, schema] = two_fingers(rng);
  SyntheticRobot bent = robot;
  Vector6d bend;
  bend << 0.02, 0, 0, 0.4, 0, 0.3;
  bent.links[4].X_after = bent.links[4].X_after * exp(bend);

  Adaptation adaptation(schema, adaptation_options(Regime::kTagIso));
  ObservationOptions options;
  options.regime = Regime::kTagIso;
  std::vector<AdaptationEvent> events;
  for (int t = 0; t < 120; ++t) {
    const SyntheticRobot& now = t < 60 ? robot : bent;
    const ActionPoseSample sample = observe(now, robot.random_action(rng), options, t, rng);
    for (const auto& e : adaptation.on_sample(sample)) events.push_back(e);
  }
  ASSERT_FALSE(events.empty());
  for (const AdaptationEvent& e : events) {
    EXPECT_GE(e.sample_index, 60) << text(e);
    EXPECT_EQ(part_of(e), 5) << text(e);
  }
  const Eigen::VectorXd action = Eigen::Vector3d(0.3, -0.5, 0.7);
  const auto X = bent.poses_in_camera(action);
  for (const int finger : {4, 5}) {
    const Pose believed = adaptation.schema().predict(1, finger, action)->X_AB;
    const Pose truth = X.at(1).inverse() * X.at(finger);
    EXPECT_LT((believed.translation() - truth.translation()).norm(), 0.01) << finger;
  }
}

/// The same arm with one edge as a soft body's, one as the chapter's.
TEST(AdaptationTest, EdgesThatAreGaussianProcessesAreMonitoredToo) {
  BrokenArm arm({Fault::kTool, "", 0.85}, Regime::kTagIso, kBlock, 3);
  BodySchema schema = arm.engineered();
  Rng rng(4);
  constexpr int kSamples = 40;
  Eigen::MatrixXd inputs(1, kSamples);
  std::vector<Pose> poses;
  for (int n = 0; n < kSamples; ++n) {
    Eigen::VectorXd theta = Eigen::VectorXd::Zero(7);
    inputs(0, n) = theta(1) = -1.35 + 2.7 * n / (kSamples - 1);
    poses.push_back(schema.edges[1].predict(theta));
  }
  const GpPrior prior{std::nullopt, SquaredExponential{0.5, Eigen::VectorXd::Constant(1, 1.5)},
                      1e-7};
  Edge& chapter = schema.edges[1];
  chapter.matrix_gp = std::make_shared<const MatrixGp>(
      std::vector<int>{1}, inputs, poses, std::vector<GpPrior>(MatrixGp::kNumEntries, prior));
  chapter.left = Pose::Identity();
  chapter.joints.clear();
  chapter.parameter_covariance.resize(0, 0);
  ResidualGp::Prior of_residual{Eigen::VectorXd::Constant(1, 1.0), Vector6d::Constant(1e-6),
                                Vector6d::Constant(1e-6)};
  schema.edges[5].residual_gp = std::make_shared<const ResidualGp>(
      std::vector<int>{5}, Eigen::MatrixXd(inputs), ResidualGp::Residuals::Zero(6, kSamples),
      Eigen::VectorXd::Ones(kSamples), of_residual);

  Adaptation adaptation(schema, adaptation_options(Regime::kTagIso));
  const Life life = live(arm, adaptation, 2 * kBlock);
  ASSERT_FALSE(life.events.empty());
  for (const AdaptationEvent& e : life.events) EXPECT_GE(e.sample_index, kBlock) << text(e);
  EXPECT_LT(life.error[kBlock - 1], 0.02);
  EXPECT_LT(life.error.back(), 0.03) << life.log();
}

TEST(AdaptationTest, AMalformedSampleIsRefusedAndChangesNothing) {
  BrokenArm arm({Fault::kStuck, "", 0.919}, Regime::kTagIso, 40, 3);
  BrokenArm same({Fault::kStuck, "", 0.919}, Regime::kTagIso, 40, 3);
  Adaptation disturbed(arm.engineered(), adaptation_options(Regime::kTagIso));
  Adaptation calm(arm.engineered(), adaptation_options(Regime::kTagIso));
  Life one, other;
  for (int t = 0; t < 80; ++t) {
    const ActionPoseSample sample = arm.observe(t);
    ActionPoseSample bad = sample;
    bad.action.conservativeResize(6);
    EXPECT_THROW(disturbed.on_sample(bad), std::invalid_argument);
    bad = sample;
    bad.action(0) = std::numeric_limits<double>::quiet_NaN();
    EXPECT_THROW(disturbed.on_sample(bad), std::invalid_argument);
    bad = sample;
    if (!bad.parts.empty()) {
      bad.parts[0].X_CB.translation().x() = std::numeric_limits<double>::infinity();
      EXPECT_THROW(disturbed.on_sample(bad), std::invalid_argument);
    }
    // A part that nobody knows is no error.
    ActionPoseSample more = sample;
    PartObservation unknown;
    unknown.part = 99;
    unknown.covariance.setIdentity();
    more.parts.push_back(unknown);
    for (const auto& e : disturbed.on_sample(more)) one.events.push_back(e);
    for (const auto& e : calm.on_sample(same.observe(t))) other.events.push_back(e);
  }
  EXPECT_FALSE(one.events.empty());
  EXPECT_EQ(one.log(), other.log());
}

}  // namespace
}  // namespace bodyschema::test
