#include "processes/structure_learner/positions/position_leaves.h"

#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <set>
#include <string>

#include "common/geometry/angle.h"
#include "processes/structure_learner/learn.h"
#include "tests/support/random_arm.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Regime;
using test::Rng;

constexpr Noise kNoise{0.002, 0.5 * kDegree};

std::vector<ActionPoseSample> noisy(std::vector<ActionPoseSample> samples, Rng& rng) {
  for (ActionPoseSample& sample : samples)
    for (PartObservation& o : sample.parts) {
      Vector6d e = test::gaussian6(rng);
      e.head<3>() *= kNoise.position_m;
      e.tail<3>() *= kNoise.rotation_rad;
      o.X_CB = o.X_CB * exp(e);
    }
  return samples;
}

Eigen::Vector3d true_position(const test::SyntheticRobot& robot, int root, int part,
                              const Eigen::VectorXd& q) {
  const auto poses = robot.poses_in_camera(q);
  return poses.at(root).inverse() * poses.at(part).translation();
}

struct Verdicts {
  int num_right = 0, num_open = 0;
  std::string wrong;  // "" if none
};

// Each part that is connected must be predicted to within a little of the noise, by the signals
// that move it visibly and no others that do not.
void judge_parts(const BodySchema& schema, const test::SyntheticRobot& robot,
                 const std::set<int>& parts, Rng& rng, Verdicts* verdicts) {
  constexpr int kActions = 60;
  const int m = static_cast<int>(robot.signals.size());
  for (const int part : parts) {
    const auto path = schema.predict(schema.root, part, robot.random_action(rng));
    if (!path) {
      ++verdicts->num_open;
      continue;
    }
    double error = 0;
    Eigen::VectorXd truly = Eigen::VectorXd::Zero(m), learned = truly;
    for (int n = 0; n < kActions; ++n) {
      const Eigen::VectorXd q = robot.random_action(rng), other = robot.random_action(rng);
      const auto at = [&](const Eigen::VectorXd& x) {
        return Eigen::Vector3d(schema.predict(schema.root, part, x)->X_AB.translation());
      };
      error += (at(q) - true_position(robot, schema.root, part, q)).squaredNorm() / kActions;
      for (int s = 0; s < m; ++s) {
        Eigen::VectorXd moved = q;
        moved(s) = other(s);
        truly(s) += (true_position(robot, schema.root, part, moved) -
                     true_position(robot, schema.root, part, q))
                        .squaredNorm() /
                    kActions;
        learned(s) += (at(moved) - at(q)).squaredNorm() / kActions;
      }
    }
    const std::string name = robot.name + " part " + std::to_string(part);
    if (std::sqrt(error) > kNoise.position_m) {
      verdicts->wrong += name + " off by " + std::to_string(std::sqrt(error)) + "\n";
      continue;
    }
    bool is_right = true;
    for (int s = 0; s < m; ++s)
      if ((truly(s) > std::pow(kNoise.position_m, 2)) != (learned(s) > 0) &&
          std::max(truly(s), learned(s)) > std::pow(0.7 * kNoise.position_m, 2)) {
        verdicts->wrong += name + " signal " + std::to_string(s) + " moves it by " +
                           std::to_string(std::sqrt(truly(s))) + ", learned " +
                           std::to_string(std::sqrt(learned(s))) + "\n";
        is_right = false;
      }
    verdicts->num_right += is_right;
  }
}

test::SyntheticRobot body(int seed, int num_parts, Rng& rng) {
  test::RandomTreeOptions options;
  options.num_parts = num_parts;
  options.num_hidden = 0;
  options.shared_signal = seed % 3 == 0;
  test::SyntheticRobot robot = test::random_tree(options, rng);
  robot.name = "body " + std::to_string(seed);
  return robot;
}

std::set<int> all_but_root(const test::SyntheticRobot& robot) {
  std::set<int> parts;
  for (const int part : robot.visible_parts())
    if (part != robot.links.front().part) parts.insert(part);
  return parts;
}

/// Estimating the noise takes as long again as learning.
class NoiseTold : public testing::TestWithParam<bool> {
 protected:
  // Bodies of so many parts, of which those that `alone` names have positions alone.
  Verdicts learned(int num_parts,
                   const std::function<std::set<int>(const test::SyntheticRobot&)>& alone) const {
    Verdicts verdicts;
    for (int seed = 1; seed <= num_bodies_; ++seed) {
      Rng rng(seed);
      const auto robot = body(seed, num_parts, rng);
      const std::set<int> parts = alone(robot);
      LearnOptions options;
      if (GetParam()) options.measurement.noise = kNoise;
      const auto samples = test::with_positions_alone(
          noisy(test::babble(robot, 120, {Regime::kFree}, rng), rng), parts);
      judge_parts(learn(robot.signals, samples, options).schema, robot, parts, rng, &verdicts);
    }
    return verdicts;
  }

  const int num_bodies_ = GetParam() ? 20 : 8;
};
INSTANTIATE_TEST_SUITE_P(, NoiseTold, testing::Bool());

TEST_P(NoiseTold, NoPartIsWrongWhereAllBelowARestingRootHavePositionsAlone) {
  const Verdicts verdicts = learned(5, all_but_root);
  EXPECT_EQ(verdicts.wrong, "");
  EXPECT_GE(verdicts.num_right, 3.3 * num_bodies_);  // of four, some three joints from the root
}

TEST_P(NoiseTold, NoPartIsWrongWhereTheLeafAloneHasNoOrientation) {
  const Verdicts verdicts = learned(
      6, [](const test::SyntheticRobot& robot) { return std::set<int>{robot.links.back().part}; });
  EXPECT_EQ(verdicts.wrong, "");
  EXPECT_GE(verdicts.num_right, num_bodies_ - 1);
}

// A leaf on one joint below a root that rests, its position so far from the axis.
test::SyntheticRobot hinge(double radius_m, Rng& rng) {
  test::SyntheticRobot robot;
  robot.signals = {{.name = "q1", .lower = -1, .upper = 1},
                   {.name = "q2", .lower = -1, .upper = 1}};
  robot.X_CR = test::random_pose(rng, 1, 2);
  test::TrueLink joint{.part = 2, .parent = 1, .X_before = test::random_pose(rng, 0.1, 0.2)};
  joint.signal = 0;
  joint.turn = 1;
  joint.X_after.translation().x() = radius_m;
  robot.links = {{.part = 1}, joint};
  return robot;
}

BodySchema learned(const test::SyntheticRobot& robot, int num_samples, Rng& rng,
                   const std::set<int>& alone = {2}) {
  LearnOptions options;
  options.measurement.noise = kNoise;
  return learn(robot.signals,
               test::with_positions_alone(
                   noisy(test::babble(robot, num_samples, {Regime::kFree}, rng), rng), alone),
               options)
      .schema;
}

TEST(PositionLeaves, APositionOnTheAxisIsRigid) {
  Rng rng(1);
  const BodySchema schema = learned(hinge(0, rng), 60, rng);
  ASSERT_TRUE(schema.complete);
  EXPECT_STREQ(schema.edges[0].kind(), "rigid");
  EXPECT_TRUE(schema.edges[0].parameter_covariance.allFinite());
  EXPECT_EQ(schema.position_parts, std::vector<int>{2});
}

TEST(PositionLeaves, TheLeafsOwnRotationIsAGaugeOfNoVariance) {
  Rng rng(2);
  const test::SyntheticRobot robot = hinge(0.2, rng);
  const BodySchema schema = learned(robot, 60, rng);
  ASSERT_TRUE(schema.complete);
  ASSERT_EQ(schema.edges[0].signals(), std::vector<int>{0});
  const ScrewJoint& joint = schema.edges[0].joints[0];
  EXPECT_TRUE(joint.X_after.linear().isIdentity(1e-9)) << joint.X_after.matrix();
  const Eigen::MatrixXd& covariance = schema.edges[0].parameter_covariance;
  EXPECT_TRUE(covariance.allFinite());
  EXPECT_TRUE(covariance.bottomRightCorner(3, 3).isZero(0));
  // What the schema says of its error is so: 5 times three standard errors of some thirty numbers.
  Eigen::VectorXd q(2);
  q << 0.7, 0;
  const auto predicted = schema.predict(1, 2, q);
  const Eigen::Vector3d error = predicted->X_AB.linear().transpose() *
                                (true_position(robot, 1, 2, q) - predicted->X_AB.translation());
  const Eigen::Matrix3d P = predicted->covariance.topLeftCorner<3, 3>();
  EXPECT_LT(error.dot(P.ldlt().solve(error)), 20);
  EXPECT_LT(P.trace(), 3 * std::pow(kNoise.position_m, 2));
}

TEST(PositionLeaves, TwoSignalsThatAlwaysGoTogetherAreBothNamed) {
  Rng rng(3);
  const test::SyntheticRobot robot = hinge(0.2, rng);
  auto samples = noisy(test::babble(robot, 60, {Regime::kFree}, rng), rng);
  samples = test::with_positions_alone(std::move(samples), {2});
  for (ActionPoseSample& sample : samples) sample.action(1) = sample.action(0);
  LearnOptions options;
  options.measurement.noise = kNoise;
  const BodySchema schema = learn(robot.signals, samples, options).schema;
  EXPECT_FALSE(schema.complete);
  ASSERT_EQ(schema.unconnected.size(), 1U);
  EXPECT_NE(
      schema.unconnected[0].detail.find("about as well by part 1 (on q1) as by part 1 (on q2)"),
      std::string::npos)
      << schema.unconnected[0].detail;
}

TEST(PositionLeaves, AFewSamplesAreNotEnoughOrTellTheTruth) {
  for (int seed = 1; seed <= 10; ++seed)
    for (const int num_samples : {1, 2, 3, 4, 5, 6, 8}) {
      Rng rng(seed);
      const BodySchema schema = learned(hinge(0.2, rng), num_samples, rng);
      if (num_samples < 5) EXPECT_FALSE(schema.complete) << seed << ", " << num_samples;
      if (schema.complete) EXPECT_EQ(schema.edges[0].signals(), std::vector<int>{0}) << seed;
    }
}

// As a laser tracker sees it: the base rests, the tip is a point.
TEST_P(NoiseTold, AnArmOfManyJointsIsLearnedFromThePositionsOfItsTip) {
  const test::RandomArmOptions kArms[] = {
      {.num_joints = 3, .own_gains = false},
      {.num_joints = 6, .own_gains = false},
      {.num_joints = 7, .share_sliding = 0.3},
      {.num_joints = 6, .share_sliding = 0, .own_gains = false, .scrambled = true}};
  Verdicts verdicts;
  int num_arms = 0;
  for (const test::RandomArmOptions& options : kArms)
    for (int seed = 1; seed <= 3; ++seed) {
      Rng rng(seed);
      const test::SyntheticRobot robot = test::random_arm(options, rng);
      const int tip = options.num_joints + 1;
      LearnOptions learning;
      learning.root = 1;
      if (GetParam()) learning.measurement.noise = kNoise;
      const auto samples = test::with_positions_alone(noisy_babble(robot, 150, kNoise, rng), {tip});
      judge_parts(learn(robot.signals, samples, learning).schema, robot, {tip}, rng, &verdicts);
      ++num_arms;
    }
  EXPECT_EQ(verdicts.wrong, "");
  EXPECT_GE(verdicts.num_right, num_arms - 1);
}

TEST_P(NoiseTold, OfTooFewPositionsNoArmIsLearnedWrong) {
  for (const int num_samples : {8, 12, 16, 20, 24})
    for (int seed = 1; seed <= 4; ++seed) {
      Rng rng(seed);
      const test::SyntheticRobot robot = test::random_arm({.num_joints = 6}, rng);
      LearnOptions learning;
      learning.root = 1;
      if (GetParam()) learning.measurement.noise = kNoise;
      const auto samples =
          test::with_positions_alone(noisy_babble(robot, num_samples, kNoise, rng), {7});
      const BodySchema schema = learn(robot.signals, samples, learning).schema;
      if (schema.complete) EXPECT_EQ(schema.unused_signals().size(), 0U) << num_samples;
    }
}

// Circle points: joints that were moved one at a time have an order that no position tells.
TEST_P(NoiseTold, AnArmWhoseJointsMovedOneAtATimeIsNotComplete) {
  for (const int num_joints : {2, 3, 4, 5}) {
    Rng rng(num_joints);
    const test::SyntheticRobot robot =
        test::random_arm({.num_joints = num_joints, .share_sliding = 0, .own_gains = false}, rng);
    std::vector<ActionPoseSample> samples = noisy_babble(robot, 120, kNoise, rng);
    for (std::size_t t = 0; t < samples.size(); ++t) {
      ActionPoseSample& sample = samples[t];
      for (int s = 0; s < num_joints; ++s)
        if (s != static_cast<int>(t) % num_joints) sample.action(s) = 0.1;
      const auto X_C = robot.poses_in_camera(sample.action);
      for (PartObservation& o : sample.parts) o.X_CB = X_C.at(o.part);
    }
    LearnOptions learning;
    learning.root = 1;
    if (GetParam()) learning.measurement.noise = kNoise;
    samples = test::with_positions_alone(noisy(std::move(samples), rng), {num_joints + 1});
    const BodySchema schema = learn(robot.signals, samples, learning).schema;
    ASSERT_EQ(schema.unconnected.size(), 1U) << num_joints;
    EXPECT_NE(schema.unconnected[0].detail.find("the order of the joints"), std::string::npos)
        << schema.unconnected[0].detail;
  }
}

TEST(PositionLeaves, ARootWithoutOrientationIsSaidToNeedOne) {
  Rng rng(4);
  const test::SyntheticRobot robot = hinge(0.2, rng);
  const BodySchema schema = learned(robot, 60, rng, {1, 2});
  EXPECT_FALSE(schema.complete);
  ASSERT_FALSE(schema.unconnected.empty());
  EXPECT_NE(schema.unconnected[0].detail.find("orientations"), std::string::npos)
      << schema.unconnected[0].detail;
}

TEST(PositionLeaves, ExactRepetitionsAndConstantActionsDoNoHarm) {
  Rng rng(5);
  const test::SyntheticRobot robot = hinge(0.2, rng);
  const auto one = test::with_positions_alone(test::babble(robot, 1, {Regime::kFree}, rng), {2});
  const std::vector<ActionPoseSample> many(30, one[0]);
  EXPECT_FALSE(learn(robot.signals, many).schema.complete);
  EXPECT_TRUE(learn(robot.signals,
                    test::with_positions_alone(test::babble(robot, 60, {Regime::kFree}, rng), {2}))
                  .schema.complete)
      << "exact positions";
}

}  // namespace
}  // namespace bodyschema
