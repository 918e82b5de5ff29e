// Schemas of every kind: long edges, positions alone, Gaussian processes, parts never seen,
// changes.

#include <fmt/format.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <memory>
#include <set>
#include <string>

#include "common/geometry/angle.h"
#include "processes/refiner/refine.h"
#include "tests/processes/refiner/displaced_robot.h"
#include "tests/support/random_arm.h"

namespace bodyschema {
namespace {

using test::displaced;
using test::exact;
using test::kNoise;
using test::names;
using test::Rng;
using test::SyntheticRobot;
using test::true_start;
using test::worst_error_m;

// A tenth of the noise is told: the root's poses differ by far more, but the parts do not go along.
TEST(RefineSchemas, WhoseNoiseIsToldTooSmallHaveARootThatRests) {
  Rng rng(5);
  const SyntheticRobot robot = test::chapter_robot("a", rng);
  std::vector<ActionPoseSample> samples =
      test::babble(robot, 60, {.regime = test::Regime::kTagIso, .with_covariances = true}, rng);
  for (ActionPoseSample& sample : samples)
    for (PartObservation& seen : sample.parts) seen.covariance /= 100;
  const Refinement result = refine(true_start(robot), refiner_samples(samples), {}, {});
  EXPECT_FALSE(result.root_moves);
  EXPECT_NEAR(result.noise_scale, 10, 2);
  EXPECT_TRUE(names(result.warnings, "times as large as the noise is told to be"));
}

// Tags of an instant's first part turn over, and every root begins where the others say.
TEST(RefineSchemas, WhoseRootMovesAndWhoseFirstPartIsTurnedOver) {
  Rng rng(2);
  SyntheticRobot robot = test::chapter_robot("c", rng);
  const BodySchema start = displaced(true_start(robot));
  std::vector<ActionPoseSample> samples;
  for (int n = 0; n < 40; ++n) {
    Vector6d step;
    step << 0.05 * test::gaussian6(rng).head<3>(), 0.3 * test::gaussian6(rng).head<3>();
    SyntheticRobot moved = robot;
    moved.X_CR = robot.X_CR * exp(step);
    ActionPoseSample& sample =
        samples.emplace_back(test::observe(moved, robot.random_action(rng), {}, n, rng));
    for (PartObservation& seen : sample.parts) seen.covariance = isotropic(kNoise);
    PartObservation& first = sample.parts.front();
    first.X_CB_other = first.X_CB;
    first.error_ratio = 1.1;
    first.X_CB.linear() *= exp_so3(Eigen::Vector3d(1.5, 0, 0));
  }
  const Refinement result = refine(start, refiner_samples(samples), {}, {});
  EXPECT_TRUE(result.root_moves);
  EXPECT_LT(worst_error_m(result.schema, robot, samples), 1e-6) << result.num_iterations;
}

TEST(RefineSchemas, WithSevenJointsOnOneEdge) {
  Rng rng(2);
  const SyntheticRobot robot = test::random_arm({.num_joints = 7}, rng);
  const auto samples = exact(robot, 60, rng);
  BodySchema start = true_start(robot);
  start.parts = {1, 8};
  start.edges = {robot.true_edge(1, 8)};
  const Refinement result = refine(displaced(start), refiner_samples(samples), {}, {});
  EXPECT_LT(worst_error_m(result.schema, robot, samples), 1e-6) << result.num_iterations;
  EXPECT_EQ(result.schema.edges.front().parameter_covariance.rows(), 6 + 8 * 7);
  // It rests on these samples alone, whatever the start rested on.
  for (const ActionPoseSample& sample : samples) start.signals[0].cover(sample.action(0));
  ASSERT_TRUE(result.schema.signals[0].covered);
  EXPECT_EQ(result.schema.signals[0].covered->lower, start.signals[0].covered->lower);
  EXPECT_EQ(result.schema.signals[0].covered->upper, start.signals[0].covered->upper);
}

TEST(RefineSchemas, OfSevenEdgesWhosePartsWereNeverSeen) {
  Rng rng(2);
  const SyntheticRobot robot = test::random_arm({.num_joints = 7}, rng);
  const auto samples = exact(robot, 60, rng);
  const Refinement result = refine(displaced(true_start(robot)), refiner_samples(samples), {}, {});
  EXPECT_LT(worst_error_m(result.schema, robot, samples), 1e-6) << result.num_iterations;
}

TEST(RefineSchemas, WhosePositionsAloneAreKnown) {
  Rng rng(3);
  const SyntheticRobot robot = test::chapter_robot("c", rng);
  const int last = robot.visible_parts().back();
  const auto samples = test::with_positions_alone(exact(robot, 40, rng), {last});
  BodySchema start = displaced(true_start(robot));
  start.position_parts = {last};
  const Refinement result = refine(start, refiner_samples(samples), {}, {});
  EXPECT_LT(worst_error_m(result.schema, robot, samples), 1e-6);
  EXPECT_TRUE(result.undetermined.empty()) << result.undetermined.front();
}

// A target in the hand's axis: its turns move it by what noise says.
TEST(RefineSchemas, NameAJointInWhoseAxisTheOnlyTargetIs) {
  Rng rng(3);
  SyntheticRobot robot = test::chapter_robot("c", rng);
  robot.links.back().X_after = Pose(Eigen::Translation3d(0, 0, 0.1));
  const int last = robot.links.back().part;
  auto samples = test::babble(robot, 60, {.regime = test::Regime::kTagIso}, rng);
  for (ActionPoseSample& sample : samples)
    for (PartObservation& seen : sample.parts) seen.covariance = isotropic({0.003, kDegree});
  samples = test::with_positions_alone(std::move(samples), {last});
  BodySchema start = displaced(true_start(robot));
  start.position_parts = {last};
  const Refinement result = refine(start, refiner_samples(samples), {}, {});
  ASSERT_EQ(result.undetermined.size(), 1U);
  EXPECT_TRUE(names(result.undetermined, "gain of q4"));
  EXPECT_TRUE(names(result.undetermined, "show a part farther from the axis of q4"));
}

TEST(RefineSchemas, LeaveAJointThatRestedAsItWas) {
  Rng rng(3);
  SyntheticRobot robot = test::chapter_robot("c", rng);
  const BodySchema start = displaced(true_start(robot));
  robot.signals[1].lower = robot.signals[1].upper = 0.7;
  const auto samples = exact(robot, 40, rng);
  const Refinement result = refine(start, refiner_samples(samples), {}, {});
  const ScrewJoint &before = start.edges[1].joints.front(),
                   &after = result.schema.edges[1].joints.front();
  EXPECT_EQ(after.turn, before.turn);
  EXPECT_EQ(after.slide, before.slide);
  EXPECT_TRUE(result.schema.edges[1].left.isApprox(start.edges[1].left, 1e-12));
  EXPECT_LT(worst_error_m(result.schema, robot, samples), 1e-6);
  EXPECT_TRUE(names(result.undetermined, "gain of q2"));
  ASSERT_EQ(result.undetermined.size(), 1U);
  EXPECT_TRUE(result.undetermined.front().ends_with(": move q2 farther"));
}

TEST(RefineSchemas, KnowWhereAJointThatRestedIsAndNotWhereItGoes) {
  Rng rng(3);
  SyntheticRobot robot = test::chapter_robot("c", rng);
  const BodySchema start = displaced(true_start(robot));
  robot.signals[1].lower = robot.signals[1].upper = 0.7;
  const auto samples =
      test::babble(robot, 40, {.regime = test::Regime::kTagIso, .with_covariances = true}, rng);
  const Refinement result = refine(start, refiner_samples(samples), {}, {});
  const auto sd_m = [&](double q2) {
    const auto predicted = result.schema.predict(robot.visible_parts().back(), result.schema.root,
                                                 Eigen::Vector4d(0.3, q2, -0.2, 0.4));
    return std::sqrt(predicted->covariance.topLeftCorner<3, 3>().trace());
  };
  EXPECT_LT(sd_m(0.7), 0.005);
  EXPECT_LT(sd_m(0.75), 0.15);
  EXPECT_GT(sd_m(1.4), 0.2);
  EXPECT_TRUE(names(result.held, "axis and gain of q2 (2→3)"));
}

// Learned, a slide turns by what noise makes of it: the axis of so small a turn is nowhere.
TEST(RefineSchemas, ASlideThatHardlyTurnsSlidesAloneUnlessItTurns) {
  for (const double turn : {0.0, 0.03}) {
    Rng rng(4);
    SyntheticRobot robot = test::chapter_robot("c", rng);
    for (test::TrueLink& link : robot.links)
      if (link.signal == 2) {
        link.turn = turn;
        link.slide = 0.05;
      }
    const auto samples =
        test::babble(robot, 60, {.regime = test::Regime::kTagIso, .with_covariances = true}, rng);
    BodySchema start = displaced(true_start(robot));
    ScrewJoint& slide = start.edges[2].joints.front();
    ASSERT_EQ(slide.signal, 2);
    slide.turn = turn > 0 ? 0.5 * slide.turn : 0.002;
    const Refinement result = refine(start, refiner_samples(samples), {}, {});
    const ScrewJoint& refined = result.schema.edges[2].joints.front();
    EXPECT_EQ(refined.turn == 0, turn == 0);
    EXPECT_NEAR(refined.gain * refined.turn, turn, 0.015);
    EXPECT_LT(worst_error_m(result.schema, robot, samples), 0.005);
    for (const RefinedParameter& parameter : result.parameters)
      EXPECT_TRUE(parameter.sd || turn > 0) << parameter.name;
  }
}

TEST(RefineSchemas, TellTheJointsOfOneSignalApart) {
  Rng rng(4);
  SyntheticRobot robot = test::random_arm({.num_joints = 3}, rng);
  robot.links[2].signal = robot.links[1].signal;
  const auto samples = exact(robot, 60, rng);
  BodySchema start = true_start(robot);
  start.parts = {1, 4};
  start.edges = {robot.true_edge(1, 4)};
  const Refinement result = refine(start, refiner_samples(samples), {}, {});
  std::set<std::string> found;
  for (const RefinedParameter& parameter : result.parameters)
    EXPECT_TRUE(found.insert(parameter.name).second) << parameter.name;
}

TEST(RefineSchemas, HoldEdgesWithAGaussianProcessAndRefineTheRest) {
  Rng rng(4);
  const SyntheticRobot robot = test::chapter_robot("c", rng);
  const auto samples = exact(robot, 40, rng);
  const BodySchema truth = true_start(robot);
  BodySchema start = displaced(truth);
  start.edges[1] = truth.edges[1];
  ResidualGp::Prior prior;
  prior.length_scales = Eigen::VectorXd::Ones(1);
  start.edges[1].residual_gp = std::make_shared<ResidualGp>(
      std::vector<int>{1}, Eigen::MatrixXd::Zero(1, 1), ResidualGp::Residuals::Zero(6, 1),
      Eigen::VectorXd::Ones(1), prior);
  const Refinement result = refine(start, refiner_samples(samples), {}, {});
  EXPECT_LT(worst_error_m(result.schema, robot, samples), 1e-6);
  EXPECT_TRUE(result.schema.edges[1].has_process_of(start.edges[1]));
  EXPECT_TRUE(result.schema.edges[1].left.isApprox(start.edges[1].left, 0));
  EXPECT_TRUE(names(result.held, "Gaussian process"));
}

TEST(RefineSchemas, HoldTheFrameOfAPartThatWasNeverSeen) {
  Rng rng(5);
  const SyntheticRobot robot = test::chapter_robot("co", rng);
  const auto samples = exact(robot, 40, rng);
  SyntheticRobot uncovered = robot;
  for (auto& link : uncovered.links) link.hidden = false;
  const Refinement result =
      refine(displaced(true_start(uncovered)), refiner_samples(samples), {}, {});
  EXPECT_TRUE(names(result.held, "part 3"));
  EXPECT_TRUE(result.undetermined.empty()) << result.undetermined.front();
  double worst = 0;
  for (const ActionPoseSample& sample : samples) {
    const auto X = robot.poses_in_camera(sample.action);
    const auto predicted = result.schema.predict(1, 5, sample.action);
    worst = std::max(
        worst, (predicted->X_AB.translation() - X.at(1).inverse() * X.at(5).translation()).norm());
    EXPECT_LT(predicted->covariance.diagonal().head(3).sum(), 1e-4);
  }
  EXPECT_LT(worst, 1e-6);
}

TEST(RefineSchemas, UseSamplesOfTheBodyAsItIsAlone) {
  Rng rng(6);
  const SyntheticRobot robot = test::chapter_robot("a", rng);
  auto samples = exact(robot, 40, rng);
  for (int n = 0; n < 15; ++n)
    for (PartObservation& observation : samples[n].parts)
      if (observation.part == 5) observation.X_CB.translation().x() += 0.05;
  BodySchema start = displaced(true_start(robot));
  for (Edge& edge : start.edges)
    if (edge.to == 5) edge.valid_since_sample = 15;
  const Refinement result = refine(start, refiner_samples(samples), {}, {});
  EXPECT_EQ(result.num_observations, 40 * 5 - 15);
  EXPECT_TRUE(result.outliers.empty());
}

TEST(RefineSchemas, FitSomeOfThousandsOfSamplesOfTheBodyAsItIs) {
  Rng rng(7);
  const SyntheticRobot robot = test::chapter_robot("a", rng);
  auto samples = exact(robot, 3000, rng);
  BodySchema start = displaced(true_start(robot));
  for (Edge& edge : start.edges) edge.valid_since_sample = 1000;
  for (int n = 0; n < 1000; ++n)
    for (PartObservation& observation : samples[n].parts)
      if (observation.part == start.root) observation.part = 99;
  const Refinement result = refine(start, refiner_samples(samples), {}, {});
  EXPECT_EQ(result.num_samples, 400);
  EXPECT_EQ(result.num_available, 2000);
  EXPECT_EQ(result.num_observations, 400 * std::ssize(robot.visible_parts()));
  EXPECT_TRUE(result.outliers.empty());
  EXPECT_TRUE(names(result.held, "what 1000 samples show of the body before it changed"));
  EXPECT_TRUE(names(result.held, "1000 samples that show nothing of the schema"));
}

TEST(RefineSchemas, OfSamplesThatRepeatEachOtherAreThoseOfTheSamplesOnce) {
  Rng rng(4);
  const SyntheticRobot robot = test::chapter_robot("c", rng);
  const auto samples =
      test::babble(robot, 25, {.regime = test::Regime::kTagIso, .with_covariances = true}, rng);
  auto thrice = samples;
  for (int n = 0; n < 2; ++n) thrice.insert(thrice.end(), samples.begin(), samples.end());
  const BodySchema start = displaced(true_start(robot));
  const Refinement once = refine(start, refiner_samples(samples), {}, {});
  const Refinement again = refine(start, refiner_samples(thrice), {}, {});
  EXPECT_EQ(again.num_available, 25);
  EXPECT_TRUE(names(again.held, "50 samples that repeat others exactly"));
  ASSERT_EQ(again.parameters.size(), once.parameters.size());
  for (std::size_t n = 0; n < once.parameters.size(); ++n) {
    EXPECT_EQ(again.parameters[n].change, once.parameters[n].change);
    EXPECT_EQ(again.parameters[n].sd, once.parameters[n].sd);
  }
}

TEST(RefineSchemas, KeepTheNoiseThatIsTold) {
  Rng rng(3);
  const SyntheticRobot robot = test::chapter_robot("a", rng);
  RefineOptions options;
  options.measurement.noise = Noise{0.004, 0.03};
  const Refinement result =
      refine(true_start(robot),
             refiner_samples(test::babble(robot, 10, {.regime = test::Regime::kTagIso}, rng)), {},
             options);
  EXPECT_EQ(result.schema.noise.position_m, 0.004);
  EXPECT_EQ(result.schema.noise.rotation_rad, 0.03);
  EXPECT_TRUE(names(result.held, "bends of q1, q2: read at fewer than 15 positions"));
}

TEST(RefineSchemas, NamePartsThatAreNotInThemAndEdgesThatNothingTells) {
  Rng rng(13);
  const SyntheticRobot robot = test::chapter_robot("c", rng);
  auto samples = exact(robot, 40, rng);
  const int end = robot.visible_parts().back();
  for (ActionPoseSample& sample : samples)
    for (PartObservation& o : sample.parts)
      if (o.part == end) o.part = 99;
  const Refinement result = refine(true_start(robot), refiner_samples(samples), {}, {});
  ASSERT_EQ(result.held.size(), 2U);
  EXPECT_EQ(result.held.front(), "part 99: the schema does not have it");
  EXPECT_TRUE(result.held.back().ends_with(fmt::format("→{}: no part beyond it was seen", end)));
}

}  // namespace
}  // namespace bodyschema
