#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <iostream>
#include <map>
#include <set>

#include "common/geometry/angle.h"
#include "processes/refiner/expected_sights.h"
#include "processes/refiner/refine.h"
#include "tests/processes/refiner/tagged_robot.h"

namespace bodyschema {
namespace {

using test::Regime;
using test::Rng;
using test::SyntheticRobot;
using test::TaggedRobot;

BodySchema schema_of(const SyntheticRobot& robot) {
  BodySchema schema = test::true_schema(robot);
  schema.X_CR = robot.X_CR;
  return schema;
}

/// As if signal `s` had been held within a share of its range around the middle.
SyntheticRobot narrowed(SyntheticRobot robot, std::size_t s, double share) {
  Signal& signal = robot.signals[s];
  const double middle = 0.5 * (signal.lower + signal.upper);
  const double half = 0.5 * share * (signal.upper - signal.lower);
  signal.lower = middle - half;
  signal.upper = middle + half;
  return robot;
}

std::vector<ActionPoseSample> poses_of(const SyntheticRobot& robot, int num_samples, Rng& rng) {
  return test::babble(robot, num_samples, {.regime = Regime::kTag, .with_covariances = true}, rng);
}

/// How far from the middle, 1 at the limits.
double extent(const Signal& signal, double value) {
  return std::abs(2 * value - signal.lower - signal.upper) / (signal.upper - signal.lower);
}

/// Mean over the first three wanted actions; of actions at random its mean is 0.5.
double first_extent(const Refinement& result, const SyntheticRobot& robot, std::size_t s) {
  double sum = 0;
  for (int n = 0; n < 3; ++n)
    sum +=
        extent(robot.signals[s], result.wanted_actions.at(n).action(static_cast<Eigen::Index>(s)));
  return sum / 3;
}

/// More of a half range than the first three do on the average that nobody chose (0.48 to 0.53).
constexpr double kFar = 0.55;

TEST(WantedActions, MoveFarTheJointThatHardlyMoved) {
  Rng rng(5);
  const SyntheticRobot robot = test::chapter_robot("c", rng);
  for (std::size_t s = 0; s < robot.signals.size(); ++s) {
    for (const double share : {0.0, 0.05}) {
      const auto samples = poses_of(narrowed(robot, s, share), 30, rng);
      const Refinement result = refine(schema_of(robot), refiner_samples(samples), {}, {});
      ASSERT_EQ(std::ssize(result.wanted_actions), kMostWantedActions);
      EXPECT_GT(first_extent(result, robot, s), kFar) << s << " " << share;
      EXPECT_GT(result.wanted_actions.at(2).fall, 0.5) << s << " " << share;
    }
  }
}

TEST(WantedActions, OfCornersMoveFarTheJointThatRested) {
  Rng rng(7);
  const TaggedRobot robot = test::tagged(test::chapter_robot("c", rng), 3, rng);
  const BodySchema start = schema_of(robot.robot);
  double extents = 0;
  for (std::size_t s = 0; s < robot.robot.signals.size(); ++s) {
    TaggedRobot resting = robot;
    resting.robot = narrowed(robot.robot, s, 0);
    const auto samples = test::seen_corners(resting, robot.truth, 25, 0.05, rng);
    RefineOptions options;
    options.placements = options.intrinsics = true;
    const Refinement result = refine(start, samples, robot.truth, options);
    EXPECT_FALSE(result.undetermined.empty());
    EXPECT_EQ(result.schema.edges[s].joints[0].turn, start.edges[s].joints[0].turn);
    extents += first_extent(result, robot.robot, s);
    EXPECT_GT(result.wanted_actions.at(2).fall, 0.95) << s;
  }
  EXPECT_GT(extents / static_cast<double>(robot.robot.signals.size()), kFar);
}

// Tags that face away at most actions.
TEST(WantedActions, AreNoneThatShowNothing) {
  Rng rng(8);
  const TaggedRobot robot = test::tagged(test::chapter_robot("c", rng), 1, rng);
  const auto samples = test::seen_corners(robot, robot.truth, 40, 0.05, rng);
  const Refinement result = refine(schema_of(robot.robot), samples, robot.truth,
                                   {.placements = true, .intrinsics = true});
  EXPECT_FALSE(result.wanted_actions.empty());
}

/// Predicted deviations at actions that nobody chose by: root mean square and worst, of positions.
struct Deviations {
  double rms_m = 0, worst_m = 0;
};
Deviations predicted_deviations(const BodySchema& schema, const SyntheticRobot& robot) {
  Rng rng(99);
  Deviations result;
  int num = 0;
  for (int n = 0; n < 100; ++n) {
    const Eigen::VectorXd action = robot.random_action(rng);
    for (const int part : schema.parts) {
      const auto predicted = schema.predict(schema.root, part, action);
      const double variance = predicted->covariance.diagonal().head<3>().sum();
      result.rms_m += variance;
      result.worst_m = std::max(result.worst_m, std::sqrt(variance));
      ++num;
    }
  }
  result.rms_m = std::sqrt(result.rms_m / num);
  return result;
}

struct Ratios {
  double rms = 0, worst = 0;
};

/// Two joints hardly moved in the samples. Geometric means over robots of the deviations with ten
/// wanted actions over those with ten random ones.
void expect_more_help(const char* kind, double max_view_angle_rad, const Ratios& most) {
  const test::ObservationOptions options = {
      .regime = Regime::kTag, .with_covariances = true, .max_view_angle_rad = max_view_angle_rad};
  constexpr int kRobots = 6;
  double rms = 0, worst = 0, told = 0;
  for (int seed = 1; seed <= kRobots; ++seed) {
    Rng rng(seed);
    const SyntheticRobot robot = test::chapter_robot(kind, rng);
    const BodySchema start = schema_of(robot);
    const SyntheticRobot tame = narrowed(narrowed(robot, 0, 0.1), 1, 0.1);
    const auto samples = test::babble(tame, 25, options, rng);
    const auto with = [&](const std::vector<Eigen::VectorXd>& actions) {
      auto more = samples;
      for (const Eigen::VectorXd& action : actions)
        more.push_back(test::observe(robot, action, options, std::ssize(more), rng));
      return predicted_deviations(refine(start, refiner_samples(more), {}, {}).schema, robot);
    };
    const Refinement before = refine(start, refiner_samples(samples), {}, {});
    std::vector<Eigen::VectorXd> wanted, random;
    for (const WantedAction& action : before.wanted_actions) {
      wanted.push_back(action.action);
      random.push_back(robot.random_action(rng));
    }
    const Deviations by_wanted = with(wanted), by_random = with(random);
    rms += std::log(by_wanted.rms_m / by_random.rms_m) / kRobots;
    worst += std::log(by_wanted.worst_m / by_random.worst_m) / kRobots;
    const double fall = 1 - by_wanted.worst_m / predicted_deviations(before.schema, robot).worst_m;
    told += (before.wanted_actions.back().fall - fall) / kRobots;
  }
  std::cout << kind << ": the rms is " << std::exp(rms) << ", the worst " << std::exp(worst)
            << " of that with random actions; the fall told is off by " << told << std::endl;
  EXPECT_LT(std::exp(rms), most.rms) << kind;
  EXPECT_LT(std::exp(worst), most.worst) << kind;
  EXPECT_NEAR(told, 0, 0.15) << kind;
}

// The first of each set of candidates, without a choice: 0.91 and 0.87, 0.94 and 0.90.
TEST(WantedActions, HelpMoreThanAsManyAtRandom) {
  expect_more_help("c", M_PI, {.rms = 0.89, .worst = 0.85});
  expect_more_help("d", 60 * kDegree, {.rms = 0.92, .worst = 0.87});
}

// Of a command that may bend the samples tell nothing where it was not read.
TEST(WantedActions, GoWhereABentCommandWasNotRead) {
  for (int seed = 1; seed <= 6; ++seed) {
    Rng rng(seed);
    SyntheticRobot robot = test::chapter_robot("c", rng);
    const BodySchema start = schema_of(robot);
    const Signal& whole = robot.signals[0];
    robot.bend = 0.05;
    SyntheticRobot lower = robot;
    lower.signals[0].upper = whole.lower + 0.6 * (whole.upper - whole.lower);
    const Refinement result = refine(start, refiner_samples(poses_of(lower, 60, rng)), {}, {});
    ASSERT_EQ(result.bends.size(), 4U);
    double share = 0;
    for (int n = 0; n < 5; ++n)
      share +=
          (result.wanted_actions.at(n).action(0) - whole.lower) / (whole.upper - whole.lower) / 5;
    EXPECT_GT(share, 0.8);  // 0.44 to 0.91 if gains and offsets alone count
  }
}

TEST(WantedActions, OrderOfSamplesChangesNothing) {
  Rng rng(13);
  const TaggedRobot robot = test::tagged(test::chapter_robot("c", rng), 3, rng);
  auto samples = test::seen_corners(robot, robot.truth, 20, 0.05, rng);
  RefineOptions options;
  for (const bool has_corners : {false, true}) {
    options.placements = options.intrinsics = has_corners;
    const Refinement first = refine(schema_of(robot.robot), samples, robot.truth, options);
    std::shuffle(samples.begin(), samples.end(), rng);
    const Refinement second = refine(schema_of(robot.robot), samples, robot.truth, options);
    ASSERT_EQ(first.wanted_actions.size(), second.wanted_actions.size());
    for (std::size_t n = 0; n < first.wanted_actions.size(); ++n) {
      EXPECT_EQ(first.wanted_actions[n].action, second.wanted_actions[n].action);
      EXPECT_EQ(first.wanted_actions[n].fall, second.wanted_actions[n].fall);
    }
  }
}

TEST(WantedActions, LeaveStuckAndHeldSignalsAsTheyAreAndKeepTheLimits) {
  Rng rng(17);
  const SyntheticRobot robot = narrowed(test::chapter_robot("c", rng), 3, 0);
  const auto samples = poses_of(robot, 25, rng);
  BodySchema schema = schema_of(robot);
  for (Edge& edge : schema.edges)
    for (ScrewJoint& joint : edge.joints)
      if (joint.signal == 2) joint.gain = 0;
  const Refinement result = refine(schema, refiner_samples(samples), {}, {});
  ASSERT_EQ(std::ssize(result.wanted_actions), kMostWantedActions);
  std::set<std::vector<double>> distinct;
  double fall = 0;
  for (const WantedAction& wanted : result.wanted_actions) {
    EXPECT_EQ(wanted.action(2), samples.back().action(2));
    EXPECT_EQ(wanted.action(3), samples.back().action(3));
    for (std::size_t s = 0; s < 2; ++s)
      EXPECT_LE(extent(robot.signals[s], wanted.action(static_cast<Eigen::Index>(s))), 1);
    EXPECT_GE(wanted.fall, fall);
    EXPECT_GE(wanted.reducible_fall, wanted.fall);
    fall = wanted.fall;
    distinct.emplace(wanted.action.begin(), wanted.action.end());
  }
  EXPECT_LT(fall, 1);
  EXPECT_EQ(distinct.size(), result.wanted_actions.size());
  for (Edge& edge : schema.edges)
    for (ScrewJoint& joint : edge.joints) joint.gain = 0;
  EXPECT_TRUE(refine(schema, refiner_samples(samples), {}, {}).wanted_actions.empty());
}

TEST(ExpectedSights, AreTheTagsThatFaceTheCamera) {
  Rng rng(19);
  const TaggedRobot robot = test::tagged(test::chapter_robot("c", rng), 4, rng);
  auto samples = test::seen_corners(robot, robot.truth, 60, 0.05, rng);
  const BodySchema schema = schema_of(robot.robot);
  const std::optional<RigCalibration> rig = robot.truth;
  const std::vector<RefinerSample> others(samples.begin() + 40, samples.end());
  samples.resize(40);
  // A tag that is never seen, though it faces the camera, is not expected.
  const int hidden = samples.front().tags.front().tag;
  for (RefinerSample& seen : samples)
    std::erase_if(seen.tags, [&](const TagSight& sight) { return sight.tag == hidden; });
  const RefineOptions options;
  RefinementProblem problem(schema, samples, rig, options, false);
  const ExpectedSights sights(schema, rig, samples, problem);
  int num_expected = 0, num_seen = 0, num_both = 0;
  for (const RefinerSample& seen : others) {
    std::map<int, const TagSight*> tags;
    for (const TagSight& sight : seen.tags) tags[sight.tag] = &sight;
    for (const auto& [sight, probability] : sights.tags(seen.sample.action)) {
      EXPECT_NE(sight.tag, hidden);
      EXPECT_GT(probability, 0);
      ++num_expected;
      if (!tags.contains(sight.tag)) continue;
      ++num_both;
      EXPECT_LT((sight.corners_px - tags.at(sight.tag)->corners_px).norm(), 1);
    }
    num_seen += static_cast<int>(tags.size()) - (tags.contains(hidden) ? 1 : 0);
  }
  // The synthetic camera reads tags up to 68.8°, and beyond its image too.
  EXPECT_GT(num_both, 0.85 * num_seen);
  EXPECT_GT(num_both, 0.95 * num_expected);
}

}  // namespace
}  // namespace bodyschema
