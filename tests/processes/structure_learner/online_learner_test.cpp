#include "processes/structure_learner/online_learner.h"

#include <gtest/gtest.h>

#include "common/geometry/angle.h"
#include "common/kinematics/kinematic_path.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Rng;

SharedSamples shared(const std::vector<ActionPoseSample>& samples) {
  SharedSamples result;
  for (const auto& sample : samples)
    result.push_back(std::make_shared<const ActionPoseSample>(sample));
  return result;
}

SharedSamples first(const SharedSamples& samples, int n) {
  return {samples.begin(), samples.begin() + n};
}

/// Everything in a schema that a sample can change, exactly.
void expect_same(const BodySchema& x, const BodySchema& y) {
  EXPECT_EQ(x.complete, y.complete);
  EXPECT_EQ(x.num_samples, y.num_samples);
  EXPECT_EQ(x.parts, y.parts);
  EXPECT_EQ(x.root, y.root);
  EXPECT_EQ(x.X_CR.matrix(), y.X_CR.matrix());
  EXPECT_EQ(x.noise.position_m, y.noise.position_m);
  ASSERT_EQ(x.signals.size(), y.signals.size());
  for (std::size_t s = 0; s < x.signals.size(); ++s)
    EXPECT_EQ(x.signals[s].warp, y.signals[s].warp);
  ASSERT_EQ(x.unconnected.size(), y.unconnected.size());
  for (std::size_t n = 0; n < x.unconnected.size(); ++n)
    EXPECT_EQ(x.unconnected[n].detail, y.unconnected[n].detail);
  ASSERT_EQ(x.edges.size(), y.edges.size());
  for (std::size_t e = 0; e < x.edges.size(); ++e) {
    EXPECT_EQ(x.edges[e].from, y.edges[e].from);
    EXPECT_EQ(x.edges[e].to, y.edges[e].to);
    EXPECT_EQ(x.edges[e].signals(), y.edges[e].signals());
    EXPECT_EQ(x.edges[e].left.matrix(), y.edges[e].left.matrix());
    EXPECT_EQ(x.edges[e].parameter_covariance, y.edges[e].parameter_covariance);
    EXPECT_EQ(x.edges[e].num_outliers, y.edges[e].num_outliers);
  }
}

struct Recording {
  test::SyntheticRobot robot;
  SharedSamples samples;
};

Recording tag_run(const std::string& name, int num_samples, int seed, double bend = 0) {
  Rng rng(seed);
  Recording run{test::chapter_robot(name, rng), {}};
  run.robot.bend = bend;
  run.samples = shared(test::babble(run.robot, num_samples,
                                    {.regime = test::Regime::kTag, .with_covariances = true}, rng));
  return run;
}

TEST(OnlineLearner, CheckpointsAreEverySampleAtFirstThenEveryTwentiethPart) {
  EXPECT_EQ(OnlineLearner::checkpoint_within(0), 0);
  int before = 0;
  for (int n = 1; n <= 3000; ++n) {
    const int c = OnlineLearner::checkpoint_within(n);
    EXPECT_LE(c, n);
    EXPECT_GE(c, before);
    if (n <= OnlineLearner::kEverySample) {
      EXPECT_EQ(c, n);
    }
    EXPECT_GT(c, n / 1.06);
    if (c != before) {
      EXPECT_EQ(c, n);
    }
    before = c;
  }
}

TEST(OnlineLearner, OfACheckpointItIsWhatLearnSays) {
  const Recording run = tag_run("a", 42, 31);
  OnlineLearner online(run.robot.signals, {});
  for (const int n : {6, 12, 30, 42}) {
    ASSERT_EQ(OnlineLearner::checkpoint_within(n), n);
    std::vector<ActionPoseSample> samples;
    for (int i = 0; i < n; ++i) samples.push_back(*run.samples[i]);
    expect_same(online.learn(first(run.samples, n), n), learn(run.robot.signals, samples).schema);
  }
}

// Bent commands, so that a checkpoint has more to hand on than a tree. Asked for every prefix once;
// for a few in a random order, some of them prepared; by new learners.
TEST(OnlineLearner, TheAnswerIsAFunctionOfTheSamplesWhateverWasAskedBefore) {
  const Recording run = tag_run("a", 70, 32, 0.1);
  std::map<std::pair<int, int>, BodySchema> expected;
  OnlineLearner in_order(run.robot.signals, {});
  for (int n = 3; n <= 70; ++n)
    for (const int searched : {n - 1, n})
      expected[{n, searched}] = in_order.learn(first(run.samples, n), searched);
  Rng rng(33);
  OnlineLearner at_random(run.robot.signals, {});
  for (int i = 0; i < 25; ++i) {
    const int n = static_cast<int>(test::uniform(rng, 3, 71));
    const int searched = test::uniform(rng, 0, 1) < 0.5 ? n - 1 : n;
    if (test::uniform(rng, 0, 1) < 0.5) at_random.prepare(first(run.samples, searched));
    SCOPED_TRACE(std::to_string(n) + " after " + std::to_string(searched));
    expect_same(at_random.learn(first(run.samples, n), searched), expected[{n, searched}]);
    if (i < 5) {
      OnlineLearner fresh(run.robot.signals, {});
      expect_same(fresh.learn(first(run.samples, n), searched), expected[{n, searched}]);
    }
  }
}

// Beyond kMaxRefitReadings the schema of a checkpoint stands.
TEST(OnlineLearner, ManySamplesAreLearnedFromAtCheckpoints) {
  const Recording run = tag_run("a", 470, 34);
  OnlineLearner online(run.robot.signals, {});
  const int c = OnlineLearner::checkpoint_within(469);
  ASSERT_LT(c, 469);
  BodySchema schema = online.learn(run.samples, 469);
  EXPECT_TRUE(test::is_right(schema, run.robot));
  EXPECT_EQ(schema.num_samples, c);
  OnlineLearner other(run.robot.signals, {});
  other.prepare(first(run.samples, c));
  expect_same(other.learn(run.samples, 469), schema);
}

// The newest sample counts, and as much as in learn(): between checkpoints only the structure
// waits.
TEST(OnlineLearner, BetweenCheckpointsAllSamplesAreFittedTo) {
  const Recording run = tag_run("a", 64, 35);
  ASSERT_LT(OnlineLearner::checkpoint_within(64), 64);
  OnlineLearner online(run.robot.signals, {});
  const BodySchema schema = online.learn(run.samples, 63);
  EXPECT_EQ(schema.num_samples, 64);
  std::vector<ActionPoseSample> samples;
  for (const auto& sample : run.samples) samples.push_back(*sample);
  const BodySchema expected = learn(run.robot.signals, samples).schema;
  ASSERT_EQ(schema.edges.size(), expected.edges.size());
  for (const int part : schema.parts) {
    Rng rng(36);
    const auto x = KinematicPath::between(schema, 1, part);
    const auto y = KinematicPath::between(expected, 1, part);
    for (int n = 0; n < 10; ++n) {
      const Eigen::VectorXd q = run.robot.random_action(rng);
      EXPECT_LT(log(x->predict(q).inverse() * y->predict(q)).norm(), 1e-6);
    }
  }
}

/// From sample `since` on, the pose of `part` in its parent is another: a bent link.
SharedSamples broken(const SharedSamples& samples, std::size_t since, int from_part,
                     const Pose& bend) {
  SharedSamples result = samples;
  for (std::size_t n = since; n < result.size(); ++n) {
    ActionPoseSample sample = *result[n];
    // All that hangs on the part turns about it, in the camera's frame.
    const PartObservation* part = sample.find(from_part);
    if (!part) {
      std::erase_if(sample.parts, [&](const auto& o) { return o.part > from_part; });
    } else {
      const Pose motion = part->X_CB * bend * part->X_CB.inverse();
      for (PartObservation& o : sample.parts)
        if (o.part > from_part) o.X_CB = motion * o.X_CB;
    }
    result[n] = std::make_shared<const ActionPoseSample>(sample);
  }
  return result;
}

Pose forty_degrees() {
  Vector6d bend = Vector6d::Zero();
  bend(4) = 40 * kDegree;
  return exp(bend);
}

bool connects_beyond(const BodySchema& schema, int part) {
  return std::any_of(schema.edges.begin(), schema.edges.end(),
                     [&](const Edge& edge) { return edge.from <= part && edge.to > part; });
}

std::vector<ActionPoseSample> plain(const SharedSamples& samples) {
  std::vector<ActionPoseSample> result;
  for (const auto& sample : samples) result.push_back(*sample);
  return result;
}

// A link bends so late before a checkpoint that its edge is still valid there, and not any more at
// the last sample before the next.
TEST(OnlineLearner, AnEdgeThatStopsBeingValidBetweenCheckpointsIsLeftOut) {
  const Recording run = tag_run("a", 100, 37);
  const int c = OnlineLearner::checkpoint_within(60), n = c + c / 20 - 1;
  int num_found = 0;
  for (int since = c - 2; since > c - 30; --since) {
    const SharedSamples samples = broken(first(run.samples, n), since, 3, forty_degrees());
    if (connects_beyond(learn(run.robot.signals, plain(samples)).schema, 3)) continue;
    OnlineLearner online(run.robot.signals, {});
    if (!connects_beyond(online.learn(first(samples, c), c), 3)) break;
    ++num_found;
    const BodySchema schema = online.learn(samples, n - 1);
    EXPECT_FALSE(connects_beyond(schema, 3));
    EXPECT_FALSE(schema.complete);
  }
  EXPECT_GT(num_found, 0);
}

/// From sample `since` on the arm's signals are crossed over: what one moved the other moves.
Recording crossed_run(int num_samples, int since, int seed) {
  Rng rng(seed);
  Recording run{test::chapter_robot("a", rng), {}};
  std::vector<ActionPoseSample> samples = test::babble(
      run.robot, num_samples, {.regime = test::Regime::kTag, .with_covariances = true}, rng);
  for (int n = since; n < num_samples; ++n) samples[n].action.reverseInPlace();
  run.samples = shared(samples);
  return run;
}

// The first answer leaves out what is refuted, that of the next checkpoint is a new search.
TEST(OnlineLearner, AnEdgeWhoseSignalsChangeIsLeftOutUntilTheNextSearch) {
  const Recording run = crossed_run(30, 12, 40);
  int num_refuted = 0;
  for (int n = 13; n <= 30; ++n) {
    const SharedSamples samples = first(run.samples, n);
    const LearnedStructure before =
        find_structure(run.robot.signals, plain(first(run.samples, n - 1)), {});
    if (!before.spans()) break;
    OnlineLearner online(run.robot.signals, {});
    const BodySchema answer = online.learn(samples, n - 1);
    expect_same(answer, relearn(before, plain(samples)).schema);
    if (answer.edges.size() == before.search.models.size()) continue;
    ++num_refuted;
    EXPECT_FALSE(answer.complete);
    expect_same(online.learn(samples, n), learn(run.robot.signals, plain(samples)).schema);
  }
  EXPECT_GT(num_refuted, 0);
}

TEST(OnlineLearner, APartThatAppearsBetweenCheckpointsIsUnconnectedUntilTheNext) {
  const Recording run = tag_run("a", 140, 38);
  const int c = OnlineLearner::checkpoint_within(120), n = c + c / 20 - 1;
  ASSERT_EQ(OnlineLearner::checkpoint_within(n), c);
  SharedSamples samples;
  for (int i = 0; i < n; ++i) {
    ActionPoseSample sample = *run.samples[i];
    if (i < c) std::erase_if(sample.parts, [](const auto& o) { return o.part == 5; });
    samples.push_back(std::make_shared<const ActionPoseSample>(sample));
  }
  OnlineLearner online(run.robot.signals, {});
  const BodySchema before = online.learn(first(samples, c), c);
  EXPECT_FALSE(before.has_part(5));
  const BodySchema after = online.learn(samples, n - 1);
  EXPECT_TRUE(after.has_part(5));
  EXPECT_FALSE(after.complete);
  ASSERT_EQ(after.unconnected.size(), 1U);
  EXPECT_EQ(after.unconnected[0].part, 5);
}

TEST(OnlineLearner, WithoutSamplesThereIsNothingAndTheRootIsExpected) {
  LearnOptions options;
  options.root = 1;
  OnlineLearner online({{"q", -1, 1, {}}}, options);
  const BodySchema schema = online.learn({}, 0);
  EXPECT_FALSE(schema.complete);
  EXPECT_EQ(schema.root, -1);
  ASSERT_EQ(schema.unconnected.size(), 1U);
  EXPECT_EQ(schema.unconnected[0].part, 1);
  EXPECT_NO_THROW(online.prepare({}));
}

}  // namespace
}  // namespace bodyschema
