#include "processes/structure_learner/baseline/learn_baseline.h"

#include <gtest/gtest.h>

#include "common/geometry/angle.h"
#include "processes/structure_learner/baseline/fit_matrix_gp.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::judge;
using test::Regime;
using test::Rightness;
using test::Rng;

// What the prototype assumed of exact data.
constexpr Noise kFloor{.position_m = 0.001, .rotation_rad = 0.3 * kDegree};

BaselineOptions options_for(const Noise& noise) {
  BaselineOptions options;
  options.set_noise(noise);
  return options;
}

// The 2-DOF robot's four edges with the signals they have in truth.
BodySchema learn_known_structure(const test::SyntheticRobot& robot,
                                 const std::vector<ActionPoseSample>& samples) {
  BodySchema schema;
  schema.signals = robot.signals;
  schema.parts = robot.visible_parts();
  schema.root = 1;
  const std::vector<std::vector<int>> signals{{}, {0}, {1}, {}};
  for (int e = 0; e < 4; ++e) {
    Eigen::MatrixXd inputs(signals[e].size(), samples.size());
    std::vector<Pose> z;
    for (std::size_t t = 0; t < samples.size(); ++t) {
      inputs.col(t) = samples[t].action(signals[e]);
      z.push_back(samples[t].find(e + 1)->X_CB.inverse() * samples[t].find(e + 2)->X_CB);
    }
    Edge edge;
    edge.from = e + 1;
    edge.to = e + 2;
    edge.matrix_gp = std::make_shared<const MatrixGp>(fit_matrix_gp(signals[e], inputs, z));
    schema.edges.push_back(edge);
  }
  return schema;
}

// Mean position error of the end effector in the trunk over 200 poses, mean of 24 robots.
double mean_error_m(int num_samples) {
  constexpr int kRobots = 24, kPoses = 200;
  double sum = 0;
  for (int seed = 1; seed <= kRobots; ++seed) {
    Rng rng(seed);
    const auto robot = test::chapter_robot("a", rng);
    const BodySchema schema =
        learn_known_structure(robot, test::babble(robot, num_samples, {Regime::kFree}, rng));
    for (int n = 0; n < kPoses; ++n) {
      const Eigen::VectorXd q = robot.random_action(rng);
      const auto truth = robot.poses_in_camera(q);
      const Eigen::Vector3d p_hat = schema.predict(1, 5, q)->X_AB.translation();
      sum += (p_hat - (truth.at(1).inverse() * truth.at(5)).translation()).norm();
    }
  }
  return sum / (kRobots * kPoses);
}

// The prototype of the design had 1.97, 0.0084 and 0.00087 mm on 24 robots of its own; single
// robots spread over two orders of magnitude.
TEST(FitMatrixGp, ConvergesOnExactDataAsThePrototypeDid) {
  const double after_5 = mean_error_m(5), after_10 = mean_error_m(10), after_20 = mean_error_m(20);
  EXPECT_LT(after_5, 3 * 1.97e-3);
  EXPECT_GT(after_5, 1.97e-3 / 3);
  EXPECT_LT(after_10, 3 * 8.4e-6);
  EXPECT_GT(after_10, 8.4e-6 / 3);
  EXPECT_LT(after_20, 3 * 8.7e-7);
  EXPECT_GT(after_20, 8.7e-7 / 3);
}

// Entries that are independent in the model but not in truth cost the rotation's covariance a
// factor of nearly 3.
TEST(FitMatrixGp, KnowsHowFarItsPositionsAreOffAndUnderstatesItsRotations) {
  double position = 0, rotation = 0;
  constexpr int kRobots = 20, kSamples = 25;
  for (int seed = 1; seed <= kRobots; ++seed) {
    Rng rng(seed);
    const auto robot = test::chapter_robot("a", rng);
    Eigen::MatrixXd inputs(1, kSamples);
    std::vector<Pose> z;
    for (int t = 0; t < kSamples; ++t) {
      const Eigen::VectorXd q = robot.random_action(rng);
      const auto X = robot.poses_in_camera(q);
      inputs(0, t) = q(0);
      z.push_back(X.at(2).inverse() * X.at(3) * exp(0.01 * test::gaussian6(rng)));
    }
    const auto loo = fit_matrix_gp({0}, inputs, z).leave_one_out();
    for (int t = 0; t < kSamples; ++t) {
      const Eigen::Vector3d p = loo.residual[t].head<3>(), w = loo.residual[t].tail<3>();
      const Matrix6d& covariance = loo.covariance[t];
      position += p.dot(covariance.topLeftCorner<3, 3>().llt().solve(p)) / (kRobots * kSamples);
      rotation += w.dot(covariance.bottomRightCorner<3, 3>().llt().solve(w)) / (kRobots * kSamples);
    }
  }
  EXPECT_NEAR(position, 3, 0.5);  // χ²₃
  EXPECT_NEAR(rotation, 8, 1);
}

TEST(FitMatrixGp, RefusesWhatItCannotLearnFrom) {
  const std::vector<Pose> one(1, Pose::Identity()), two(2, Pose::Identity());
  EXPECT_THROW(fit_matrix_gp({}, Eigen::MatrixXd(0, 1), one), std::invalid_argument);
  EXPECT_THROW(fit_matrix_gp({0}, Eigen::MatrixXd(0, 2), two), std::invalid_argument);
  EXPECT_THROW(fit_matrix_gp({0}, Eigen::MatrixXd::Zero(1, 3), two), std::invalid_argument);
}

TEST(ModelQualities, HaveTheTwoPropertiesOfTheChapter) {
  Rng rng(2);
  for (int n = 0; n < 200; ++n) {
    std::vector<ModelScore> valid(10);
    // Densities above 1 as well: with exact poses log-likelihoods reach tens of nats.
    for (ModelScore& m : valid)
      m = {static_cast<int>(test::uniform(rng, 0, 4)), test::uniform(rng, -50, 50)};
    const std::vector<double> q = model_qualities(valid);
    for (int a = 0; a < 10; ++a) {
      for (int b = 0; b < 10; ++b) {
        if (valid[a].num_signals < valid[b].num_signals) {
          EXPECT_GT(q[a], q[b]);
        }
        if (valid[a].num_signals == valid[b].num_signals) {
          EXPECT_EQ(valid[a].log_likelihood > valid[b].log_likelihood, q[a] > q[b]);
        }
      }
    }
  }
  EXPECT_TRUE(model_qualities({}).empty());
}

TEST(LearnBaseline, FindsTheChaptersSmallerRobotsFromTwentyExactSamples) {
  for (const char* name : {"a", "c", "co"}) {
    for (int seed = 1; seed <= 5; ++seed) {
      Rng rng(seed);
      const auto robot = test::chapter_robot(name, rng);
      const auto result = learn_baseline(
          robot.signals, test::babble(robot, 20, {Regime::kFree}, rng), options_for(kFloor));
      EXPECT_EQ(judge(result.schema, robot), Rightness::kRight) << name << seed;
      for (const Edge& edge : result.schema.edges) EXPECT_STREQ(edge.kind(), "matrix_gp");
    }
  }
}

TEST(LearnBaseline, LearnsLayerAfterLayerUntilATreeSpans) {
  Rng rng(1);
  // Figure 7: five parts, four signals; 10 pairs rigid and 10·4 with one signal.
  const auto c = test::chapter_robot("c", rng);
  const auto samples = test::babble(c, 20, {Regime::kFree}, rng);
  const auto result = learn_baseline(c.signals, samples, options_for(kFloor));
  EXPECT_EQ(result.num_fits, 10 + 40);
  EXPECT_EQ(result.num_valid, 4);
  // Figure 8: the third part hidden, so pairs of signals as well: 6·(1 + 4 + 6).
  auto hidden = samples;
  for (auto& s : hidden) std::erase_if(s.parts, [](const auto& o) { return o.part == 3; });
  BaselineOptions options = options_for(kFloor);
  options.expected_parts = {1, 2, 3, 4, 5};
  const auto without = learn_baseline(c.signals, hidden, options);
  EXPECT_EQ(without.num_fits, 6 * 11);
  ASSERT_EQ(without.schema.edges.size(), 3u);
  EXPECT_EQ(without.schema.edges[1].from, 2);
  EXPECT_EQ(without.schema.edges[1].to, 4);
  EXPECT_EQ(without.schema.edges[1].signals(), (std::vector<int>{1, 2}));
  ASSERT_EQ(without.schema.unconnected.size(), 1u);
  EXPECT_EQ(without.schema.unconnected[0].part, 3);
  EXPECT_EQ(without.schema.unconnected[0].reason, Unconnected::kNeverSeen);
  EXPECT_TRUE(without.schema.complete);
}

// Algorithm 1 may stop at the first tree because of the second property of the quality.
TEST(LearnBaseline, LaterLayersNeverChangeTheStructure) {
  for (int seed = 1; seed <= 3; ++seed) {
    Rng rng(seed);
    const auto robot = test::chapter_robot("a", rng);
    for (const Regime regime : {Regime::kFree, Regime::kChapter}) {
      const auto samples = test::babble(robot, 15, {regime}, rng);
      BaselineOptions options =
          options_for(regime == Regime::kFree ? kFloor : test::nominal_noise(regime));
      const auto first = learn_baseline(robot.signals, samples, options);
      options.stop_at_first_tree = false;
      const auto all = learn_baseline(robot.signals, samples, options);
      EXPECT_EQ(all.num_fits, 10 * (1 + 2 + 1));
      EXPECT_GE(all.num_valid, first.num_valid);
      ASSERT_EQ(all.schema.edges.size(), first.schema.edges.size());
      for (std::size_t e = 0; e < all.schema.edges.size(); ++e) {
        EXPECT_EQ(all.schema.edges[e].to, first.schema.edges[e].to);
        EXPECT_EQ(all.schema.edges[e].signals(), first.schema.edges[e].signals());
      }
    }
  }
}

// Figure 6: two signals move one part; with q2 at rest {q1} explains all, with both only {q1,q2}.
TEST(LearnBaseline, PrefersTheSimplerOfTwoValidModels) {
  Rng rng(3);
  test::SyntheticRobot robot = test::chapter_robot("c", rng);
  for (const int part : {2, 4, 5}) robot.links[part - 1].hidden = true;  // leaves 1 and 3
  std::vector<ActionPoseSample> one_moves, both_move;
  for (int t = 0; t < 30; ++t) {
    Eigen::VectorXd q = robot.random_action(rng);
    q.tail<2>().setZero();
    both_move.push_back(test::observe(robot, q, {Regime::kFree}, t, rng));
    q(1) = 0;
    one_moves.push_back(test::observe(robot, q, {Regime::kFree}, t, rng));
  }
  // The second signal's rest is no rest to the last digit: it is still a candidate.
  one_moves[0].action(1) = 1e-6;
  const auto simple = learn_baseline(robot.signals, one_moves, options_for(kFloor)).schema;
  ASSERT_EQ(simple.edges.size(), 1u);
  EXPECT_EQ(simple.edges[0].signals(), std::vector<int>{0});
  const auto larger = learn_baseline(robot.signals, both_move, options_for(kFloor)).schema;
  ASSERT_EQ(larger.edges.size(), 1u);
  EXPECT_EQ(larger.edges[0].signals(), (std::vector<int>{0, 1}));
}

// What the chapter's thresholds cannot see: kept, so that the comparison is fair.
TEST(LearnBaseline, TheChaptersThresholdsTakeAJointOfSixtyDegreesForRigid) {
  Rng rng(4);
  test::SyntheticRobot robot = test::chapter_robot("a", rng);
  robot.signals[0].lower = -60 * kDegree;
  robot.signals[0].upper = 60 * kDegree;
  const auto schema =
      learn_baseline(robot.signals, test::babble(robot, 100, {Regime::kFree}, rng)).schema;
  EXPECT_TRUE(schema.complete);
  EXPECT_EQ(judge(schema, robot), Rightness::kWrong);
}

TEST(LearnBaseline, EdgesPointAwayFromTheRootAndPredictEveryPart) {
  Rng rng(5);
  const auto robot = test::chapter_robot("c", rng);
  BaselineOptions options = options_for(kFloor);
  options.root = 3;
  const auto schema =
      learn_baseline(robot.signals, test::babble(robot, 30, {Regime::kFree}, rng), options).schema;
  EXPECT_EQ(judge(schema, robot), Rightness::kRight);
  std::set<int> reached{3};
  for (const Edge& edge : schema.edges) {
    EXPECT_TRUE(reached.contains(edge.from));
    EXPECT_TRUE(reached.insert(edge.to).second);
  }
  for (int n = 0; n < 10; ++n) {
    const Eigen::VectorXd q = 0.8 * robot.random_action(rng);
    const auto truth = robot.poses_in_camera(q);
    const auto predicted = schema.predict_all(q);
    EXPECT_EQ(predicted.size(), 5u);
    for (const auto& [part, X_RB] : predicted)
      EXPECT_LT(log((truth.at(3) * X_RB).inverse() * truth.at(part)).norm(), 1e-4) << part;
  }
}

TEST(LearnBaseline, TellsWhyAPartIsNotConnected) {
  Rng rng(6);
  const auto robot = test::chapter_robot("a", rng);
  auto samples = test::babble(robot, 20, {Regime::kFree}, rng);
  for (std::size_t t = 0; t < samples.size(); ++t) {
    for (auto& o : samples[t].parts)
      if (o.part == 4) o.X_CB = test::random_pose(rng, 1, 2);
    if (t >= 2) std::erase_if(samples[t].parts, [](const auto& o) { return o.part == 5; });
  }
  const auto schema = learn_baseline(robot.signals, samples, options_for(kFloor)).schema;
  EXPECT_FALSE(schema.complete);
  ASSERT_EQ(schema.unconnected.size(), 2u);
  EXPECT_EQ(schema.unconnected[0].part, 4);
  EXPECT_EQ(schema.unconnected[0].reason, Unconnected::kNoValidModel);
  EXPECT_EQ(schema.unconnected[1].part, 5);
  EXPECT_EQ(schema.unconnected[1].reason, Unconnected::kNotEnoughData);
}

TEST(LearnBaseline, EstimatesTheRootsPose) {
  Rng rng(7);
  const auto robot = test::chapter_robot("a", rng);
  const auto schema =
      learn_baseline(robot.signals, test::babble(robot, 60, {Regime::kChapter}, rng)).schema;
  const Vector6d error = log(robot.X_CR.inverse() * schema.X_CR);
  EXPECT_LT(error.head<3>().norm(), 4 * 0.0254 * std::sqrt(3.0 / 60));
  EXPECT_LT(error.tail<3>().norm(), 4 * 6.1 * kDegree * std::sqrt(3.0 / 60));
}

TEST(LearnBaseline, LearnsFromAnEvenShareOfManySamples) {
  Rng rng(8);
  const auto robot = test::chapter_robot("a", rng);
  const auto samples = test::babble(robot, 60, {Regime::kFree}, rng);
  std::vector<ActionPoseSample> third;
  for (std::size_t t = 0; t < samples.size(); t += 3) third.push_back(samples[t]);
  BaselineOptions options = options_for(kFloor);
  options.max_samples = 20;
  const auto few = learn_baseline(robot.signals, third, options).schema;
  const auto many = learn_baseline(robot.signals, samples, options).schema;
  EXPECT_EQ(many.edges[1].num_samples, 20);
  const Eigen::VectorXd q = robot.random_action(rng);
  EXPECT_EQ(few.predict(1, 5, q)->X_AB.matrix(), many.predict(1, 5, q)->X_AB.matrix());
}

TEST(LearnBaseline, NothingSeenIsAnEmptySchema) {
  const auto none = learn_baseline({{"q1", -1, 1}}, {});
  EXPECT_FALSE(none.schema.complete);
  EXPECT_EQ(none.schema.root, -1);
  EXPECT_EQ(none.num_fits, 0);
}

TEST(LearnBaseline, RefusesOptionsAndActionsOutOfRange) {
  ActionPoseSample sample;
  sample.action.setZero(2);
  EXPECT_THROW(learn_baseline({{"q1", -1, 1}}, {sample}), std::invalid_argument);
  BaselineOptions options;
  options.max_signals = -1;
  EXPECT_THROW(learn_baseline({}, {}, options), std::invalid_argument);
  options = {};
  options.max_samples = 2;
  EXPECT_THROW(learn_baseline({}, {}, options), std::invalid_argument);
  options = {};
  options.sigma_position_m = 0;
  EXPECT_THROW(learn_baseline({}, {}, options), std::invalid_argument);
}

}  // namespace
}  // namespace bodyschema
