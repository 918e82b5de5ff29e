// Why an answer is not to be trusted.

#include <fmt/format.h>
#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <map>
#include <string>
#include <utility>
#include <vector>

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

TEST(RefineWarnings, NameAJointThatTurnsTheOtherWayRound) {
  Rng rng(3);
  const SyntheticRobot robot = test::chapter_robot("c", rng);
  const auto samples = exact(robot, 40, rng);
  const Pose over(Eigen::AngleAxisd(M_PI, Eigen::Vector3d::UnitX()));
  const auto refined = [&](bool reverses_turn, bool turns_axis_over) {
    BodySchema start = displaced(true_start(robot));
    ScrewJoint& joint = start.edges[2].joints.front();
    if (reverses_turn) joint.turn *= -1;
    if (turns_axis_over) {
      start.edges[2].left = start.edges[2].left * over;
      joint.X_after = over * joint.X_after;
    }
    return refine(start, refiner_samples(samples), {}, {});
  };
  const std::vector<std::string> named = {
      "q3 (3→4) goes the other way round than in the model before"};
  for (const Refinement& result : {refined(true, false), refined(false, true)}) {
    EXPECT_LT(worst_error_m(result.schema, robot, samples), 1e-6);
    EXPECT_EQ(result.warnings, named);
  }
  // Both: the same motion.
  EXPECT_TRUE(refined(true, true).warnings.empty());
}

// Joints that scatter in the held-out samples alone.
TEST(RefineWarnings, WarnWhereHeldOutPosesAreFartherOffThanIsTold) {
  Rng rng(5);
  const SyntheticRobot robot = test::chapter_robot("c", rng);
  const test::ObservationOptions noisy{.regime = test::Regime::kTagIso, .with_covariances = true};
  for (const double scatter : {0.0, 0.05}) {
    auto samples = test::babble(robot, 60, noisy, rng);
    for (std::size_t n = 30; n < samples.size(); ++n) {
      Eigen::VectorXd reached = samples[n].action;
      for (double& q : reached) q += scatter * test::gaussian(rng);
      ActionPoseSample held_out =
          test::observe(robot, reached, noisy, samples[n].sample_index, rng);
      held_out.action = samples[n].action;
      held_out.purpose = Purpose::kTest;
      samples[n] = held_out;
    }
    const Refinement result =
        refine(displaced(true_start(robot)), refiner_samples(samples), {}, {});
    EXPECT_EQ(names(result.warnings, "held-out poses of part 5 are"), scatter > 0);
    EXPECT_EQ(result.warnings.empty(), scatter == 0);
  }
}

TEST(RefineWarnings, WarnWherePredictionsAreWorseThanBefore) {
  Rng rng(5);
  const SyntheticRobot robot = test::chapter_robot("c", rng);
  const auto refined = [&](std::vector<ActionPoseSample> samples) {
    for (ActionPoseSample held_out : exact(robot, 20, rng)) {
      held_out.sample_index += std::ssize(samples);
      held_out.purpose = Purpose::kTest;
      samples.push_back(held_out);
    }
    return refine(true_start(robot), refiner_samples(samples), {}, {});
  };
  const auto few =
      test::babble(robot, 4, {.regime = test::Regime::kTagIso, .with_covariances = true}, rng);
  EXPECT_TRUE(names(refined(few).warnings, "held-out positions of part 5 are off by"));
  EXPECT_TRUE(refined(exact(robot, 30, rng)).warnings.empty());
}

TEST(RefineWarnings, WarnWhereObservationsRefuteTheModelAndNotWhereSomeAreWild) {
  Rng rng(11);
  const SyntheticRobot robot = test::chapter_robot("c", rng);
  auto samples = exact(robot, 60, rng);
  for (std::size_t n = 0; n < samples.size(); n += 4)
    for (PartObservation& o : samples[n].parts) o.X_CB.translation().x() += 0.3;
  const BodySchema start = displaced(true_start(robot));
  EXPECT_TRUE(refine(start, refiner_samples(samples), {}, {}).warnings.empty());
  for (ActionPoseSample& sample : samples) std::swap(sample.action(0), sample.action(1));
  const Refinement result = refine(start, refiner_samples(samples), {}, {});
  ASSERT_FALSE(result.warnings.empty());
  EXPECT_NE(result.warnings.front().find("refute the refined model"), std::string::npos);
  EXPECT_GT(result.num_outliers, static_cast<int>(kMostOutliers));
  EXPECT_EQ(result.outliers.size(), kMostOutliers);
}

TEST(RefineWarnings, WarnOfLimitsInAnotherUnit) {
  Rng rng(3);
  const SyntheticRobot robot = test::chapter_robot("c", rng);
  const auto samples = exact(robot, 40, rng);
  BodySchema start = true_start(robot);
  EXPECT_FALSE(names(refine(start, refiner_samples(samples), {}, {}).warnings, "another unit"));
  for (Signal& signal : start.signals) {
    signal.lower /= kDegree;
    signal.upper /= kDegree;
  }
  EXPECT_TRUE(names(refine(start, refiner_samples(samples), {}, {}).warnings, "another unit"));
}

TEST(RefineWarnings, WarnOfFewNumbers) {
  Rng rng(12);
  const SyntheticRobot robot = test::chapter_robot("c", rng);
  const BodySchema start = displaced(true_start(robot));
  const auto warnings = [&](int num_samples) {
    return refine(start, refiner_samples(exact(robot, num_samples, rng)), {}, {}).warnings;
  };
  ASSERT_EQ(warnings(2).size(), 1U);
  EXPECT_NE(warnings(2).front().find("more samples"), std::string::npos);
  EXPECT_TRUE(warnings(20).empty());
}

// Each sample brings the numbers that its own pose of the root takes.
TEST(RefineWarnings, DoNotWarnOfFewNumbersForAMovingRootAndTheEndSeen) {
  Rng rng(14);
  const SyntheticRobot robot = test::random_arm({.num_joints = 4, .share_sliding = 0}, rng);
  const int base = robot.visible_parts().front(), end = robot.visible_parts().back();
  BodySchema start = true_start(robot);
  start.parts = {base, end};
  start.edges = {robot.true_edge(base, end)};
  std::vector<ActionPoseSample> samples;
  for (int n = 0; n < 60; ++n) {
    SyntheticRobot moved = robot;
    moved.X_CR = robot.X_CR * exp(Vector6d(0.05 * test::gaussian6(rng)));
    samples.push_back(test::observe(moved, robot.random_action(rng), {}, n, rng));
    for (PartObservation& seen : samples.back().parts) seen.covariance = isotropic(kNoise);
  }
  const Refinement result = refine(displaced(start), refiner_samples(samples), {}, {});
  EXPECT_TRUE(result.root_moves);
  EXPECT_TRUE(result.warnings.empty());
}

/// Warnings of a fit to samples in tag noise of a robot whose joints go where `reached` says, which
/// may also change the robot.
std::vector<std::string> warnings_of(
    const std::function<Eigen::VectorXd(const Eigen::VectorXd&, int, SyntheticRobot*)>& reached) {
  Rng rng(21);
  const SyntheticRobot robot = test::chapter_robot("c", rng);
  std::vector<ActionPoseSample> samples;
  for (int n = 0; n < 100; ++n) {
    SyntheticRobot now = robot;
    const Eigen::VectorXd action = robot.random_action(rng);
    const Eigen::VectorXd at = reached(action, n, &now);
    samples.push_back(test::observe(
        now, at, {.regime = test::Regime::kTagIso, .with_covariances = true}, n, rng));
    samples.back().action = action;
  }
  // As a URDF has it, with joints that turn alone.
  BodySchema start = true_start(robot);
  for (Edge& edge : start.edges)
    for (ScrewJoint& joint : edge.joints) joint.slide = 0;
  return refine(displaced(start), refiner_samples(samples), {}, {}).warnings;
}

TEST(RefineWarnings, NameACommandThatMovesAnotherJointToo) {
  EXPECT_TRUE(warnings_of([](const auto& action, int, auto*) { return action; }).empty());
  const auto coupled = [](Eigen::VectorXd action, int, SyntheticRobot*) {
    action(2) += 0.05 * action(1);
    return action;
  };
  EXPECT_TRUE(
      names(warnings_of(coupled), "q3 (3→4) is off its command goes with the command of q2"));
}

TEST(RefineWarnings, NameCommandsInAnotherOrder) {
  const auto exchanged = [](Eigen::VectorXd action, int, SyntheticRobot*) {
    std::swap(action(1), action(2));
    return action;
  };
  EXPECT_FALSE(warnings_of(exchanged).empty());
}

TEST(RefineWarnings, NameTheSampleAtWhichAJointSlipped) {
  const auto slipped = [](Eigen::VectorXd action, int n, SyntheticRobot*) {
    if (n >= 50) action(2) += 0.03;
    return action;
  };
  const std::vector<std::string> warnings = warnings_of(slipped);
  EXPECT_TRUE(names(warnings, "q3 (3→4) is off its command changes at sample 50"))
      << fmt::format("{}", fmt::join(warnings, "\n"));
}

TEST(RefineWarnings, NameTheSampleAtWhichTheCameraMovedAndFitBothPlaces) {
  for (const double step_m : {0.01, 0.05}) {
    Rng rng(21);
    const SyntheticRobot robot = test::chapter_robot("c", rng);
    std::vector<ActionPoseSample> samples;
    for (int n = 0; n < 90; ++n) {
      SyntheticRobot now = robot;
      Vector6d step = Vector6d::Zero();
      step(0) = step_m;
      step(4) = step_m;
      if (n >= 36) now.X_CR = exp(step) * now.X_CR;
      samples.push_back(test::observe(now, robot.random_action(rng),
                                      {.regime = test::Regime::kTagIso, .with_covariances = true},
                                      n, rng));
    }
    const Refinement result =
        refine(displaced(true_start(robot)), refiner_samples(samples), {}, {});
    EXPECT_TRUE(result.root_moves);
    ASSERT_EQ(result.warnings.size(), 1U) << fmt::format("{}", fmt::join(result.warnings, "\n"));
    EXPECT_TRUE(names(result.warnings, "from sample 36 on: the camera, or the robot, moved"))
        << result.warnings.front();
    EXPECT_LT(worst_error_m(result.schema, robot, samples), 0.006);
  }
}

TEST(RefineWarnings, NameTheSampleAtWhichTheRootsMarkerMoved) {
  Rng rng(21);
  const SyntheticRobot robot = test::chapter_robot("c", rng);
  std::vector<ActionPoseSample> samples =
      test::babble(robot, 90, {.regime = test::Regime::kTagIso, .with_covariances = true}, rng);
  const BodySchema start = displaced(true_start(robot));
  Vector6d step = Vector6d::Zero();
  step(0) = 0.05;
  for (int n = 60; n < 90; ++n)
    for (PartObservation& seen : samples[n].parts)
      if (seen.part == start.root) seen.X_CB = seen.X_CB * exp(step);
  const Refinement result = refine(start, refiner_samples(samples), {}, {});
  EXPECT_FALSE(result.root_moves);
  EXPECT_TRUE(names(result.warnings, "from sample 60 on: its marker moved on it"));
  EXPECT_LT(worst_error_m(result.schema, robot, samples), 0.006);
}

// Along the parts' axes, or the camera's, as a tracker's drift is.
TEST(RefineWarnings, DeviationsAreThoseOfNoiseThatLasts) {
  for (const auto& [correlation, is_of_camera] :
       std::vector<std::pair<double, bool>>{{0, false}, {0.9, false}, {0.9, true}}) {
    double sum = 0;
    int num = 0;
    for (int seed = 1; seed <= 8; ++seed) {
      Rng rng(seed);
      const SyntheticRobot robot = test::chapter_robot("a", rng);
      std::vector<ActionPoseSample> samples = exact(robot, 60, rng);
      std::map<int, Vector6d> lasting;
      for (ActionPoseSample& sample : samples)
        for (PartObservation& seen : sample.parts) {
          const auto [at, is_first] = lasting.try_emplace(seen.part, test::gaussian6(rng));
          if (!is_first)
            at->second = correlation * at->second +
                         std::sqrt(1 - correlation * correlation) * test::gaussian6(rng);
          Vector6d error = at->second;
          error.head<3>() *= kNoise.position_m;
          error.tail<3>() *= kNoise.rotation_rad;
          if (is_of_camera) {
            const Eigen::Matrix3d R_BC = seen.X_CB.linear().transpose();
            const Vector6d along_camera = error;
            error << R_BC * along_camera.head<3>(), R_BC * along_camera.tail<3>();
          }
          seen.X_CB = seen.X_CB * exp(error);
        }
      const Refinement result =
          refine(displaced(true_start(robot)), refiner_samples(samples), {}, {});
      EXPECT_EQ(result.serial_correlation > 0.5, correlation > 0.5);
      const int end = robot.visible_parts().back();
      for (int n = 0; n < 50; ++n) {
        const Eigen::VectorXd action = robot.random_action(rng);
        const auto truth = robot.poses_in_camera(action);
        const auto predicted = result.schema.predict(result.schema.root, end, action);
        const Vector6d error =
            log(predicted->X_AB.inverse() * truth.at(result.schema.root).inverse() * truth.at(end));
        sum += squared_mahalanobis(error, predicted->covariance) / 6;
        ++num;
      }
    }
    EXPECT_GT(sum / num, 0.3) << correlation;
    EXPECT_LT(sum / num, 2) << correlation;  // 10 without
  }
}

TEST(RefineWarnings, NameAJointThatSlidesAsItTurns) {
  const auto helical = [](const Eigen::VectorXd& action, int, SyntheticRobot* robot) {
    for (test::TrueLink& link : robot->links)
      if (link.signal == 2) link.slide = 0.01 * link.turn;
    return action;
  };
  const std::vector<std::string> warnings = warnings_of(helical);
  EXPECT_TRUE(names(warnings, "q3 (3→4) slides as it turns, by"))
      << fmt::format("{}", fmt::join(warnings, "\n"));
}

TEST(RefineWarnings, NameAJointThatDoesNotMoveOrHasAnotherAxis) {
  const auto dead = [](Eigen::VectorXd action, int, SyntheticRobot*) {
    action(2) = 0.2;
    return action;
  };
  EXPECT_TRUE(names(warnings_of(dead), "q3 (3→4) hardly moves by its command"));
  Rng rng(3);
  const SyntheticRobot robot = test::chapter_robot("c", rng);
  const auto samples = exact(robot, 40, rng);
  BodySchema start = true_start(robot);
  const Pose tilted(Eigen::AngleAxisd(45 * kDegree, Eigen::Vector3d::UnitX()));
  start.edges[2].left = start.edges[2].left * tilted;
  start.edges[2].joints.front().X_after = tilted.inverse() * start.edges[2].joints.front().X_after;
  const Refinement result = refine(start, refiner_samples(samples), {}, {});
  EXPECT_LT(worst_error_m(result.schema, robot, samples), 1e-6);
  EXPECT_TRUE(names(result.warnings, "the axis of q3 (3→4) is 45° from that of the model before"));
}

}  // namespace
}  // namespace bodyschema
