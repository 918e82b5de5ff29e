#include "processes/structure_learner/long_chain/long_chain.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <numeric>

#include "common/geometry/angle.h"
#include "processes/structure_learner/learn.h"
#include "processes/structure_learner/long_chain/chain_positions.h"
#include "processes/structure_learner/long_chain/chain_rotations.h"
#include "processes/structure_learner/long_chain/coupled_joints.h"
#include "tests/support/random_arm.h"

namespace bodyschema {
namespace {

using test::RandomArmOptions;
using test::Rightness;
using test::Rng;

constexpr Noise kNoise{0.001, 0.3 * kDegree};

// An arm, its samples and the pair of base and hand.
struct Case {
  Case(const RandomArmOptions& options, int num_samples, int seed)
      : rng(seed),
        robot(random_arm(options, rng)),
        samples(noisy_babble(robot, num_samples, kNoise, rng)),
        actions(samples, options.num_joints),
        pair(make_pair_data(samples, 1, options.num_joints + 1, {.noise = kNoise}, num_samples)) {}

  std::vector<int> listed() const {
    std::vector<int> result(robot.signals.size());
    std::iota(result.begin(), result.end(), 0);
    return result;
  }
  Fit fit(JointOrder order) const {
    return fit_long_chain(pair, actions, listed(), order, std::sqrt(2.0) * kNoise.rotation_rad)
        .value();
  }

  Rng rng;
  test::SyntheticRobot robot;
  std::vector<ActionPoseSample> samples;
  NormalizedActions actions;
  PairData pair;
};

std::vector<int> order_of(const LocalModel& model) {
  std::vector<int> result;
  for (const LocalModel::Joint& joint : model.joints) result.push_back(joint.signal);
  return result;
}

Rightness learned(const test::SyntheticRobot& robot, const std::vector<ActionPoseSample>& samples,
                  std::optional<Noise> noise) {
  LearnOptions options;
  options.root = 1;
  options.measurement.noise = noise;
  return judge(learn(robot.signals, samples, options).schema, robot);
}

TEST(RotationSearch, FindsTheAxesOfAChainInItsListedOrder) {
  for (const bool own_gains : {true, false}) {
    const Case c({.share_sliding = 0, .own_gains = own_gains}, 40, 3);
    RotationSearch search(c.pair, c.actions, 60);
    const ChainAxes found = search.fit(search.best_of(c.listed(), {}, 60), false, 60);
    EXPECT_LT(found.median_left, 1.5 * kDegree);
    for (int j = 0; j < 7; ++j)
      EXPECT_NEAR(found.axes[j].norm(),
                  std::abs(c.robot.links[j + 1].turn) * c.actions.half_range(j), 0.05);
  }
}

TEST(RotationSearch, LengthsThatAreHeldStay) {
  const Case c({}, 30, 1);
  RotationSearch search(c.pair, c.actions, 60);
  const std::vector<double> lengths(7, 1.2);
  const ChainAxes found = search.best_of(c.listed(), lengths, 1);
  for (const Eigen::Vector3d& axis : found.axes) EXPECT_NEAR(axis.norm(), 1.2, 1e-9);
}

TEST(PositionSearch, AQuarterOfTheStartsFindTheAxes) {
  constexpr int kStarts = 10, kArms = 12;
  int num_found = 0;
  for (int seed = 1; seed <= kArms; ++seed) {
    const Case c({.num_joints = 6, .share_sliding = 0, .own_gains = false}, 60, seed);
    const auto samples = test::with_positions_alone(c.samples, {7});
    const PairData pair = make_pair_data(samples, 1, 7, {.noise = kNoise}, 60);
    PositionSearch search(pair, c.actions, 60, kNoise.position_m);
    std::vector<double> lengths;
    for (const int s : c.listed()) lengths.push_back(c.actions.half_range(s));
    for (int n = 0; n < kStarts; ++n) {
      const ChainAxes found =
          search.fit(search.fit(search.random_start(c.listed(), lengths), true, 60), false, 60);
      if (found.median_left > 3 * kNoise.position_m) continue;
      ++num_found;
      for (int j = 0; j < 6; ++j) EXPECT_NEAR(found.axes[j].norm(), lengths[j], 0.1);
    }
  }
  EXPECT_GE(num_found, kArms * kStarts / 4);
}

TEST(PositionSearch, AnAxisThatIsZeroSlides) {
  const Case c({.num_joints = 5, .share_sliding = 0.5}, 60, 2);
  const auto samples = test::with_positions_alone(c.samples, {6});
  const PairData pair = make_pair_data(samples, 1, 6, {.noise = kNoise}, 60);
  PositionSearch search(pair, c.actions, 60, kNoise.position_m);
  double least = 1;
  for (int n = 0; n < 10; ++n) {
    ChainAxes start = search.random_start(c.listed(), {});
    for (int j = 0; j < 5; ++j)
      if (c.robot.links[j + 1].slide != 0) start.axes[j].setZero();
    const ChainAxes found = search.fit(start, false, 60);
    least = std::min(least, found.median_left);
    for (int j = 0; j < 5; ++j)
      EXPECT_EQ(found.axes[j].isZero(0), c.robot.links[j + 1].slide != 0) << j;
  }
  EXPECT_LT(least, 3 * kNoise.position_m);
}

TEST(LongChain, AJointThatSlidesIsRecognised) {
  const Case c({.num_joints = 5, .share_sliding = 0.5}, 40, 2);
  const Fit fit = c.fit(JointOrder::kListed);
  int num_sliding = 0;
  for (int j = 0; j < 5; ++j) {
    const bool slides = c.robot.links[j + 1].slide != 0;
    num_sliding += slides;
    EXPECT_EQ(std::abs(fit.model.joints[j].turn) < 0.02, slides) << j;
  }
  EXPECT_GT(num_sliding, 0);
  EXPECT_LT(num_sliding, 5);
}

TEST(LongChain, TheOrderIsFoundWhereItIsNotThatOfTheSignals) {
  for (const bool own_gains : {false, true}) {
    const Case c({.num_joints = 6, .share_sliding = 0, .own_gains = own_gains, .scrambled = true},
                 60, 4);
    const Fit fit = with_settled_order(c.fit(JointOrder::kUnknown), c.pair, c.actions);
    std::vector<int> truth;
    for (std::size_t n = 1; n < c.robot.links.size(); ++n) truth.push_back(c.robot.links[n].signal);
    EXPECT_EQ(order_of(fit.model), truth);
  }
}

TEST(LongChain, ASignalThatMovesNothingGetsNoJoint) {
  Case c({.num_joints = 5, .share_sliding = 0}, 40, 5);
  for (ActionPoseSample& sample : c.samples) {
    sample.action.conservativeResize(6);
    sample.action(5) = test::uniform(c.rng, -1, 1);
  }
  const NormalizedActions actions(c.samples, 6);
  const auto all = fit_long_chain(c.pair, actions, {0, 5, 1, 2, 3, 4}, JointOrder::kListed, 0.01);
  ASSERT_TRUE(all);
  const Fit fit = without_idle_joints(*all, c.pair, actions);
  EXPECT_EQ(order_of(fit.model), std::vector<int>({0, 1, 2, 3, 4}));
}

TEST(LongChain, JointsThatCommuteHaveNoOrder) {
  // Two joints about one axis, with a third across it.
  const Case c({.num_joints = 3, .share_sliding = 0}, 30, 6);
  LocalModel model;
  model.joints = {{.signal = 0, .turn = 1}, {.signal = 1, .turn = 0.7}, {.signal = 2, .turn = 0.9}};
  model.joints[1].X_after.linear() =
      Eigen::AngleAxisd(M_PI / 2, Eigen::Vector3d::UnitX()).toRotationMatrix();
  model.joints[1].X_after.translation().x() = 0.2;
  PairData pair = c.pair;
  for (int t = 0; t < pair.size(); ++t)
    pair.hypotheses[pair.frames[t].first_hypothesis].z =
        model.predict(c.actions, pair.frames[t].sample);
  const Fit fit = with_settled_order(evaluate(model, pair, c.actions), pair, c.actions);
  for (const LocalModel::Joint& joint : fit.model.joints) EXPECT_EQ(joint.order_group, -1);
}

TEST(Learn, FindsArmsOfWhichBaseAndHandAloneAreSeen) {
  int num_right = 0;
  for (int seed = 1; seed <= 10; ++seed) {
    const Case c({.num_joints = 6 + seed % 2}, 40, seed);
    const Rightness rightness = learned(c.robot, c.samples, kNoise);
    EXPECT_NE(rightness, Rightness::kWrong) << seed;
    num_right += rightness == Rightness::kRight;
  }
  EXPECT_GE(num_right, 9);
}

// The residual of a model that is too short is no noise.
TEST(Learn, NoiseThatIsNotToldIsNotGuessedFromAChainThatIsTooShort) {
  int num_right = 0;
  for (int seed = 1; seed <= 10; ++seed) {
    for (const int num_samples : {15, 60}) {
      const Case c({.num_joints = 6 + seed % 2}, num_samples, seed);
      const Rightness rightness = learned(c.robot, c.samples, std::nullopt);
      EXPECT_NE(rightness, Rightness::kWrong) << seed;
      num_right += rightness == Rightness::kRight;
    }
  }
  EXPECT_GE(num_right, 9);
}

TEST(Learn, AChainOfWhichAJointHasNoSignalIsIncomplete) {
  for (int missing = 0; missing < 6; ++missing) {
    const Case c({.num_joints = 6, .share_sliding = 0}, 50, 7);
    std::vector<ActionPoseSample> samples = c.samples;
    std::vector<Signal> signals = c.robot.signals;
    signals.erase(signals.begin() + missing);
    for (ActionPoseSample& sample : samples) {
      const Eigen::VectorXd all = sample.action;
      sample.action.resize(5);
      sample.action << all.head(missing), all.tail(5 - missing);
    }
    for (const auto& noise : {std::optional<Noise>(kNoise), std::optional<Noise>()}) {
      LearnOptions options;
      options.root = 1;
      options.measurement.noise = noise;
      EXPECT_FALSE(learn(signals, samples, options).schema.complete) << missing;
    }
  }
}

// As commands are told where signal 1 drives joint 2 as well, by `share`: a cable that leads over
// joint 1, or a parallelogram.
std::vector<ActionPoseSample> with_coupling(std::vector<ActionPoseSample> samples, double share) {
  for (ActionPoseSample& sample : samples) sample.action(2) -= share * sample.action(1);
  return samples;
}

TEST(CoupledJoints, AreFoundAtTheEndsOfAnArm) {
  for (const double share : {0.5, -0.4})
    for (const bool is_told : {true, false}) {
      Rng rng(is_told ? 0 : 1);
      const auto robot = test::random_arm({.num_joints = 4, .share_sliding = 0}, rng);
      const auto samples = with_coupling(noisy_babble(robot, 100, kNoise, rng), share);
      LearnOptions options;
      options.root = 1;
      if (is_told) options.measurement.noise = kNoise;
      const BodySchema schema = learn(robot.signals, samples, options).schema;
      ASSERT_TRUE(schema.complete) << share << " told " << is_told;
      ASSERT_EQ(schema.edges.size(), 1U);
      EXPECT_FALSE(schema.edges[0].residual_gp);
      EXPECT_EQ(schema.edges[0].joints.size(), 5U);
      for (const ActionPoseSample& sample :
           with_coupling(noisy_babble(robot, 20, {1e-6, 1e-6}, rng), share)) {
        const Pose X_seen = sample.find(1)->X_CB.inverse() * sample.find(5)->X_CB;
        const Pose X = schema.predict(1, 5, sample.action)->X_AB;
        EXPECT_LT((X.translation() - X_seen.translation()).norm(), 0.01);
      }
    }
}

TEST(CoupledJoints, AreNoneWhereEachSignalMovesOne) {
  const Case c({.num_joints = 4, .share_sliding = 0}, 60, 1);
  EXPECT_EQ(with_coupled_joints(c.fit(JointOrder::kListed), c.pair, c.actions).model.num_joints(),
            4);
}

// A wrist whose cables run over the joint before, in smooth motion.
TEST(LongChain, JointsThatASecondSignalMovesAreFoundInAStream) {
  Rng rng(5);
  test::SyntheticRobot robot = test::random_arm({.num_joints = 6, .share_sliding = 0}, rng);
  robot.links[5].also = robot.links[6].signal;
  robot.links[5].also_gain = 0.5;
  constexpr Noise kTracker{2e-4, 0.1 * kDegree};
  std::vector<ActionPoseSample> samples = test::noisy_babble(robot, 2000, kTracker, rng);
  for (ActionPoseSample& sample : samples) {
    const auto t = static_cast<double>(sample.sample_index);
    sample.utime = 20'000 * sample.sample_index;
    for (Eigen::Index s = 0; s < sample.action.size(); ++s) {
      const Signal& signal = robot.signals[static_cast<std::size_t>(s)];
      const double wave =
          0.5 * (std::sin((0.031 + 0.007 * s) * t + s) + std::sin(0.013 * t * (s + 1)));
      sample.action(s) = 0.5 * (signal.lower + signal.upper + wave * (signal.upper - signal.lower));
    }
    const auto truth = robot.poses_in_camera(sample.action);
    for (PartObservation& seen : sample.parts) {
      Vector6d error = test::gaussian6(rng);
      error.head<3>() *= kTracker.position_m;
      error.tail<3>() *= kTracker.rotation_rad;
      seen.X_CB = truth.at(seen.part) * exp(error);
    }
  }
  for (const std::optional<Noise>& told : {std::optional(kTracker), std::optional<Noise>()}) {
    LearnOptions options;
    options.measurement.noise = told;
    const BodySchema schema = learn(robot.signals, samples, options).schema;
    ASSERT_EQ(schema.edges.size(), 1U);
    EXPECT_EQ(schema.edges[0].joints.size(), 7U);
    EXPECT_FALSE(schema.edges[0].residual_gp);
    EXPECT_LT(schema.edges[0].rotation_rms_rad, 0.4 * kDegree);
  }
}

}  // namespace
}  // namespace bodyschema
