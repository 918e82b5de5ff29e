#include "processes/structure_learner/learn.h"

#include <gtest/gtest.h>

#include <sstream>
#include <utility>

#include "common/geometry/angle.h"
#include "processes/structure_learner/noise_estimate.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::is_right;
using test::Regime;
using test::Rightness;
using test::Rng;

// Robots out of `num_seeds` whose structure is right.
int count_right(const std::string& name, Regime regime, int num_samples, int num_seeds,
                bool given_noise) {
  int right = 0;
  for (int seed = 1; seed <= num_seeds; ++seed) {
    Rng rng(seed);
    const auto robot = test::chapter_robot(name, rng);
    LearnOptions options;
    if (given_noise) options.measurement.noise = test::nominal_noise(regime);
    const auto result =
        learn(robot.signals, test::babble(robot, num_samples, {regime}, rng), options);
    right += is_right(result.schema, robot);
  }
  return right;
}

TEST(Learn, FindsTheChaptersRobotsFromFiveExactSamples) {
  for (const char* name : {"a", "c", "co", "d", "dP"})
    EXPECT_EQ(count_right(name, Regime::kFree, 5, 5, false), 5) << name;
}

TEST(Learn, FindsTheSevenAxisRobotInTheChaptersNoise) {
  EXPECT_GE(count_right("d", Regime::kChapter, 20, 6, true), 6);
}

TEST(Learn, FindsTheSevenAxisRobotDespiteFlipsAndMissingMarkers) {
  EXPECT_GE(count_right("d", Regime::kTag, 25, 6, true), 6);
  EXPECT_GE(count_right("d", Regime::kTag, 25, 6, false), 6);
}

// Mean error of the last part relative to the root over random actions [m, rad].
std::pair<double, double> end_effector_error(const BodySchema& schema,
                                             const test::SyntheticRobot& robot, Rng& rng) {
  constexpr int kActions = 200;
  double position = 0, rotation = 0;
  const int part = robot.visible_parts().back();
  for (int n = 0; n < kActions; ++n) {
    const Eigen::VectorXd q = robot.random_action(rng);
    const auto truth = robot.poses_in_camera(q);
    const auto predicted = schema.predict(schema.root, part, q);
    if (!predicted) return {1e9, 1e9};
    const Pose X_true = truth.at(schema.root).inverse() * truth.at(part);
    position += (predicted->X_AB.translation() - X_true.translation()).norm() / kActions;
    rotation += rotation_angle(predicted->X_AB.inverse() * X_true) / kActions;
  }
  return {position, rotation};
}

TEST(Learn, UnbendsACommandThatIsNotLinearInTheJoint) {
  double position = 0, rotation = 0;
  constexpr int kRobots = 10;
  for (int seed = 1; seed <= kRobots; ++seed) {
    Rng rng(seed);
    auto robot = test::chapter_robot("a", rng);
    robot.bend = 0.1;
    const auto result = learn(robot.signals, test::babble(robot, 20, {}, rng));
    EXPECT_TRUE(is_right(result.schema, robot)) << seed;
    const auto [m, rad] = end_effector_error(result.schema, robot, rng);
    position += m / kRobots;
    rotation += rad / kRobots;
  }
  EXPECT_LT(position, 1e-3);
  EXPECT_LT(rotation, 0.2 * kDegree);
}

// Of a, a joint hangs on one or the other of two parts that are fixed to each other, by how large
// the noise is taken to be; of c, a wild pose bends a command.
TEST(Learn, BentCommandsInTheNoiseOfTagsAreNoSoftParts) {
  const std::pair<const char*, int> robots[] = {{"a", 26}, {"c", 19}};
  for (const auto& [name, seed] : robots) {
    Rng rng(static_cast<Rng::result_type>(seed));
    auto robot = test::chapter_robot(name, rng);
    robot.bend = 0.1;
    const auto samples =
        test::babble(robot, 100, {.regime = Regime::kTag, .with_covariances = true}, rng);
    const BodySchema schema = learn(robot.signals, samples).schema;
    EXPECT_TRUE(is_right(schema, robot)) << name;
    for (const Signal& signal : schema.signals) EXPECT_FALSE(signal.warp.empty()) << name;
    for (const Edge& edge : schema.edges) EXPECT_EQ(edge.residual_gp, nullptr) << name;
    EXPECT_LT(end_effector_error(schema, robot, rng).first, 0.002) << name;
  }
}

TEST(Learn, LeavesAStraightCommandStraight) {
  for (const Regime regime : {Regime::kFree, Regime::kChapter, Regime::kTag}) {
    for (int seed = 1; seed <= 5; ++seed) {
      Rng rng(seed);
      const auto robot = test::chapter_robot("c", rng);
      LearnOptions options;
      options.measurement.noise = test::nominal_noise(regime);
      const auto result = learn(robot.signals, test::babble(robot, 60, {regime}, rng), options);
      for (const Signal& signal : result.schema.signals) {
        EXPECT_TRUE(signal.warp.empty()) << test::name_of(regime) << " seed " << seed;
      }
    }
  }
}

TEST(Learn, PredictsExactlyFromExactSamples) {
  Rng rng(11);
  const auto robot = test::chapter_robot("d", rng);
  const auto result = learn(robot.signals, test::babble(robot, 10, {}, rng));
  for (int n = 0; n < 20; ++n) {
    const Eigen::VectorXd q = robot.random_action(rng);
    const auto truth = robot.poses_in_camera(q);
    for (const auto& [part, X_RB] : result.schema.predict_all(q))
      EXPECT_LT(log((truth.at(1) * X_RB).inverse() * truth.at(part)).norm(), 1e-6) << part;
  }
  EXPECT_TRUE(result.schema.X_CR.isApprox(robot.X_CR, 1e-9));
}

TEST(Learn, HandlesGainsOffsetsBranchesScrewsAndIdleSignals) {
  for (int seed = 1; seed <= 6; ++seed) {
    Rng rng(seed);
    const auto robot = test::random_tree({}, rng);
    const auto result = learn(robot.signals, test::babble(robot, 25, {Regime::kTag}, rng));
    EXPECT_NE(test::judge(result.schema, robot), Rightness::kWrong) << seed;
    EXPECT_TRUE(is_right(learn(robot.signals, test::babble(robot, 15, {}, rng)).schema, robot))
        << seed;
  }
}

TEST(Learn, APartThatWasSeenOnceIsToldSo) {
  Rng rng(1);
  const auto robot = test::random_tree({}, rng);
  auto samples = test::babble(robot, 20, {Regime::kTag}, rng);
  PartObservation once = samples[0].parts.front();
  once.part = 99;
  samples[0].parts.push_back(once);
  LearnOptions given;
  given.measurement.noise = test::nominal_noise(Regime::kTag);
  const auto schema = learn(robot.signals, samples, given).schema;
  ASSERT_FALSE(schema.unconnected.empty());
  EXPECT_TRUE(schema.unconnected.back().detail.starts_with("seen once, at most 1 of them "))
      << schema.unconnected.back().detail;
}

TEST(Learn, FindsTheThreeJointsOfTwoHiddenPartsInARow) {
  int num_right = 0;
  for (int seed = 1; seed <= 6; ++seed) {
    Rng rng(seed);
    test::RandomTreeOptions options;
    options.adjacent_hidden = true;
    const auto robot = test::random_tree(options, rng);
    LearnOptions given;
    given.measurement.noise = test::nominal_noise(Regime::kTag);
    const auto schema =
        learn(robot.signals, test::babble(robot, 30, {Regime::kTag}, rng), given).schema;
    EXPECT_NE(test::judge(schema, robot), Rightness::kWrong) << seed;
    num_right += is_right(schema, robot);
  }
  EXPECT_GE(num_right, 5);
}

TEST(Learn, EdgesPointAwayFromTheRootInOrder) {
  Rng rng(12);
  const auto robot = test::chapter_robot("d", rng);
  LearnOptions options;
  options.root = 6;
  const auto schema = learn(robot.signals, test::babble(robot, 10, {}, rng), options).schema;
  EXPECT_TRUE(is_right(schema, robot));
  std::set<int> reached{6};
  for (const Edge& edge : schema.edges) {
    EXPECT_TRUE(reached.contains(edge.from));
    EXPECT_TRUE(reached.insert(edge.to).second);
  }
}

TEST(Learn, IsAPureFunctionOfItsInput) {
  Rng rng(13);
  const auto robot = test::chapter_robot("d", rng);
  const auto samples = test::babble(robot, 15, {Regime::kTag}, rng);
  const auto one = learn(robot.signals, samples), two = learn(robot.signals, samples);
  ASSERT_EQ(one.schema.edges.size(), two.schema.edges.size());
  for (std::size_t n = 0; n < one.schema.edges.size(); ++n) {
    EXPECT_EQ(one.schema.edges[n].left.matrix(), two.schema.edges[n].left.matrix());
    EXPECT_EQ(one.schema.edges[n].parameter_covariance, two.schema.edges[n].parameter_covariance);
  }
}

TEST(Learn, DoesNotDependOnCommandUnits) {
  Rng rng(14);
  const auto robot = test::chapter_robot("co", rng);
  auto samples = test::babble(robot, 15, {Regime::kTagIso}, rng);
  for (auto& s : samples) s.action = (s.action.array() * 700 + 2048).matrix();
  EXPECT_TRUE(is_right(learn(robot.signals, samples).schema, robot));
}

TEST(Learn, TellsNeverSeenFromTooFewSamples) {
  Rng rng(17);
  const auto robot = test::chapter_robot("c", rng);
  auto samples = test::babble(robot, 20, {}, rng);
  for (std::size_t t = 2; t < samples.size(); ++t)
    std::erase_if(samples[t].parts, [](auto& o) { return o.part == 5; });
  LearnOptions options;
  options.expected_parts = {1, 2, 3, 4, 5, 6};
  const auto schema = learn(robot.signals, samples, options).schema;
  EXPECT_FALSE(schema.complete);
  ASSERT_EQ(schema.unconnected.size(), 2u);
  EXPECT_EQ(schema.unconnected[0].part, 5);
  EXPECT_EQ(schema.unconnected[0].reason, Unconnected::kNotEnoughData);
  EXPECT_EQ(schema.unconnected[1].part, 6);
  EXPECT_EQ(schema.unconnected[1].reason, Unconnected::kNeverSeen);
}

TEST(Learn, AHiddenPartIsReportedButTheTreeOverTheOthersIsComplete) {
  Rng rng(19);
  const auto robot = test::chapter_robot("co", rng);
  LearnOptions options;
  options.expected_parts = {1, 2, 3, 4, 5};
  const auto schema = learn(robot.signals, test::babble(robot, 20, {}, rng), options).schema;
  EXPECT_TRUE(schema.complete);
  EXPECT_TRUE(test::is_right(schema, robot));
  ASSERT_EQ(schema.unconnected.size(), 1u);
  EXPECT_EQ(schema.unconnected[0].part, 3);
  EXPECT_EQ(schema.unconnected[0].reason, Unconnected::kNeverSeen);
}

TEST(Learn, SaysSoWhereNoModelIsValid) {
  Rng rng(18);
  const auto robot = test::chapter_robot("a", rng);
  auto samples = test::babble(robot, 30, {}, rng);
  for (auto& s : samples)
    for (auto& o : s.parts)
      if (o.part == 5) o.X_CB = test::random_pose(rng, 1, 2);
  LearnOptions options;
  options.measurement.noise = Noise{0.001, 0.01};
  const auto schema = learn(robot.signals, samples, options).schema;
  ASSERT_EQ(schema.unconnected.size(), 1u);
  EXPECT_EQ(schema.unconnected[0].part, 5);
  EXPECT_EQ(schema.unconnected[0].reason, Unconnected::kNoValidModel);
  const std::string& detail = schema.unconnected[0].detail;
  EXPECT_NE(
      detail.find("no model with up to 2 signals is valid to any connected part, nor any with "
                  "a Gaussian process beside its joints"),
      std::string::npos)
      << detail;
}

// So few poses that a wrong structure fits by chance are no structure. A wrong edge may have
// evidence enough all the same (13 of 600 robots), a whole wrong body had none (0 of 600).
TEST(Learn, FewPosesAreRatherIncompleteThanWrong) {
  constexpr int kRobots = 60;
  int num_wrong = 0, num_complete_and_wrong = 0;
  for (int seed = 1; seed <= kRobots; ++seed) {
    Rng rng(1000 + seed);
    const auto robot = test::chapter_robot("d", rng);
    const auto samples =
        test::babble(robot, 4 + seed % 2, {.regime = Regime::kTag, .with_covariances = true}, rng);
    const BodySchema schema = learn(robot.signals, samples).schema;
    const bool is_wrong = test::judge(schema, robot) == test::Rightness::kWrong;
    num_wrong += is_wrong;
    num_complete_and_wrong += is_wrong && schema.complete;
  }
  EXPECT_EQ(num_complete_and_wrong, 0);
  EXPECT_LE(num_wrong, kRobots / 20);
}

TEST(Learn, OnePartOrOneSampleIsNoStructure) {
  Rng rng(82);
  const auto robot = test::chapter_robot("a", rng);
  auto samples = test::babble(robot, 20, {}, rng);
  const BodySchema of_one_sample = learn(robot.signals, {samples[0]}).schema;
  EXPECT_FALSE(of_one_sample.complete);
  EXPECT_EQ(of_one_sample.undecided_signals, (std::vector<int>{0, 1}));
  EXPECT_EQ(of_one_sample.unconnected.size(), 4U);
  for (ActionPoseSample& sample : samples)
    std::erase_if(sample.parts, [](const auto& o) { return o.part != 2; });
  const BodySchema of_one_part = learn(robot.signals, samples).schema;
  EXPECT_FALSE(of_one_part.complete);
  EXPECT_EQ(of_one_part.root, 2);
  EXPECT_EQ(of_one_part.undecided_signals, (std::vector<int>{0, 1}));
  ASSERT_EQ(of_one_part.unconnected.size(), 1U);
  EXPECT_EQ(of_one_part.unconnected[0].part, 2);
  EXPECT_EQ(of_one_part.unconnected[0].reason, Unconnected::kNotEnoughData);
  LearnOptions elsewhere;
  elsewhere.root = 1;  // never seen: each part is told once
  EXPECT_EQ(learn(robot.signals, samples, elsewhere).schema.unconnected.size(), 2U);
}

// Which signals have no effect is told of those that moved enough within their limits.
TEST(Learn, ASignalThatMovedLittleWithinItsLimitsIsUndecided) {
  for (const double share : {1.0, 0.01}) {
    Rng rng(83);
    test::SyntheticRobot robot = test::chapter_robot("a", rng);
    robot.signals.push_back({"idle", -1, 1, {}});
    std::vector<ActionPoseSample> samples;
    for (int t = 0; t < 30; ++t) {
      Eigen::VectorXd q = robot.random_action(rng);
      q(2) *= share;
      samples.push_back(test::observe(robot, q, {Regime::kTagIso}, t, rng));
    }
    const BodySchema schema = learn(robot.signals, samples).schema;
    EXPECT_TRUE(test::is_right(schema, robot));
    EXPECT_EQ(schema.unused_signals(), share == 1 ? std::vector<int>{2} : std::vector<int>{});
    EXPECT_EQ(schema.undecided_signals, share == 1 ? std::vector<int>{} : std::vector<int>{2});
  }
}

TEST(Learn, AConstantSignalExplainsNothing) {
  Rng rng(19);
  const auto robot = test::chapter_robot("a", rng);
  std::vector<ActionPoseSample> samples;
  for (int t = 0; t < 15; ++t) {
    Eigen::VectorXd q = robot.random_action(rng);
    q(1) = 0.3;
    samples.push_back(test::observe(robot, q, {Regime::kTagIso}, t, rng));
  }
  const auto schema = learn(robot.signals, samples).schema;
  EXPECT_TRUE(schema.complete);
  EXPECT_EQ(schema.unused_signals(), std::vector<int>{});
  EXPECT_EQ(schema.undecided_signals, std::vector<int>{1});
}

TEST(Learn, ReadsTheOtherHypothesisOfFlippedMarkers) {
  Rng rng(20);
  const auto robot = test::chapter_robot("c", rng);
  const auto result =
      learn(robot.signals, test::babble(robot, 30, {Regime::kTag, true, true}, rng));
  EXPECT_TRUE(is_right(result.schema, robot));
  int outliers = 0;
  for (const Edge& edge : result.schema.edges) outliers += edge.num_outliers;
  EXPECT_LE(outliers, 2);
}

TEST(Learn, NothingSeenIsAnEmptySchema) {
  const auto none = learn({{"q1", -1, 1}}, {});
  EXPECT_FALSE(none.schema.complete);
  EXPECT_EQ(none.schema.root, -1);
  EXPECT_EQ(none.schema.last_sample_index, -1);
  ActionPoseSample sample;
  sample.action.setZero(1);
  sample.parts.resize(1);
  const auto one = learn({{"q1", -1, 1}}, {sample});
  EXPECT_FALSE(one.schema.complete);  // one part alone is no structure
  EXPECT_TRUE(one.schema.edges.empty());
}

TEST(Learn, RefusesActionsOfTheWrongSize) {
  ActionPoseSample sample;
  sample.action.setZero(2);
  EXPECT_THROW(learn({{"q1", -1, 1}}, {sample}), std::invalid_argument);
  LearnOptions options;
  options.max_signals = -1;
  EXPECT_THROW(learn({}, {}, options), std::invalid_argument);
}

TEST(SyntheticRobot, CsvRoundTripKeepsThePoses) {
  Rng rng(21);
  const auto robot = test::chapter_robot("c", rng);
  const auto samples = test::babble(robot, 3, {Regime::kTag}, rng);
  std::stringstream csv;
  test::write_csv(samples, csv);
  int num_signals = 0;
  const auto read = test::read_csv(csv, &num_signals);
  ASSERT_EQ(num_signals, 4);
  ASSERT_EQ(read.size(), 3u);
  for (std::size_t t = 0; t < 3; ++t) {
    ASSERT_EQ(read[t].parts.size(), samples[t].parts.size());
    for (std::size_t n = 0; n < read[t].parts.size(); ++n)
      EXPECT_TRUE(read[t].parts[n].X_CB.isApprox(samples[t].parts[n].X_CB, 1e-9));
  }
}

}  // namespace
double mean_error_m(const BodySchema& schema, const test::SyntheticRobot& robot, int part,
                    test::Rng& rng) {
  constexpr int kPoses = 50;
  double sum = 0;
  for (int n = 0; n < kPoses; ++n) {
    const Eigen::VectorXd action = robot.random_action(rng);
    const auto X_CB = robot.poses_in_camera(action);
    const auto predicted = schema.predict(1, part, action);
    if (!predicted) return std::numeric_limits<double>::infinity();
    const Pose truth = X_CB.at(1).inverse() * X_CB.at(part);
    sum += (predicted->X_AB.translation() - truth.translation()).norm() / kPoses;
  }
  return sum;
}

// Edges that are fitted to two markers each end 1.5 times as far off (ALGORITHM: columns P and G).
TEST(Learn, FitsTheWholeTreeToAllMarkersWhereTheRootRests) {
  double resting = 0, moving = 0;
  for (int seed = 1; seed <= 8; ++seed) {
    test::Rng rng(seed);
    const test::SyntheticRobot robot = test::chapter_robot("c", rng);
    test::ObservationOptions observation;
    observation.regime = test::Regime::kTagIso;
    observation.with_covariances = true;
    auto samples = test::babble(robot, 30, observation, rng);
    const LearnResult still = learn(robot.signals, samples);
    ASSERT_TRUE(test::is_right(still.schema, robot)) << seed;
    EXPECT_LT((still.schema.X_CR.translation() - robot.X_CR.translation()).norm(), 0.003);
    // The same relative poses, seen by a camera that somebody carries about.
    for (ActionPoseSample& sample : samples) {
      const Pose X = test::random_pose(rng, 0, 0.5);
      for (PartObservation& o : sample.parts) o.X_CB = X * o.X_CB;
    }
    const LearnResult carried = learn(robot.signals, samples);
    ASSERT_TRUE(test::is_right(carried.schema, robot)) << seed;
    test::Rng poses(100 + seed);
    resting += mean_error_m(still.schema, robot, 5, poses) / 8;
    poses = test::Rng(100 + seed);
    moving += mean_error_m(carried.schema, robot, 5, poses) / 8;
  }
  EXPECT_LT(resting, 0.8 * moving);
}

// 1.3 m from the origin of a tracker. Rotation noise of the frame in which all is told would be
// 19 mm there, and explain anything.
TEST(Learn, TheFrameThatPosesAreToldInHasNoNoise) {
  constexpr Noise kTold{5e-4, 0.85 * kDegree};
  Rng rng(1);
  std::vector<ActionPoseSample> samples(40);
  for (int t = 0; t < 40; ++t) {
    samples[t].sample_index = t;
    samples[t].utime = 2'000'000 * std::int64_t{t};
    samples[t].action = Eigen::VectorXd::Constant(1, test::uniform(rng, -1, 1));
    Vector6d noise = test::gaussian6(rng);
    noise.head<3>() *= kTold.position_m;
    noise.tail<3>() *= kTold.rotation_rad;
    Pose slide = Pose::Identity();
    slide.translation() = Eigen::Vector3d(1.3, 0.004 * samples[t].action(0), 0);
    samples[t].parts = {{.part = 0}, {.part = 1, .X_CB = slide * exp(noise)}};
  }
  LearnOptions options;
  options.measurement.noise = kTold;
  const MeasurementModel by = find_structure({{"q1", -1, 1}}, samples, options).options.measurement;
  EXPECT_TRUE(by.covariance(samples[0].parts[0]).isZero(1e-9));
  EXPECT_NEAR(by.covariance(samples[0].parts[1])(0, 0), 25e-8, 1e-9);

  const auto estimate = estimate_noise(samples, 1);
  ASSERT_TRUE(estimate);
  EXPECT_NEAR(estimate->position_m, 1.2 * kTold.position_m, 0.2 * kTold.position_m);
  EXPECT_NEAR(estimate->rotation_rad, 1.2 * kTold.rotation_rad, 0.4 * kTold.rotation_rad);
}

}  // namespace bodyschema
