#include "processes/structure_learner/unconnected.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <string>
#include <vector>

#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Regime;
using test::Rng;

bool contains(const std::vector<UnconnectedPart>& parts, const std::string& words) {
  return std::ranges::any_of(parts, [&](const UnconnectedPart& part) {
    return part.detail.find(words) != std::string::npos;
  });
}

// Of 80 samples the last eight are of a base that was moved, or of none: poses of part 1.
LearnResult learned_with_a_moved_base(bool is_moved, bool is_monitored) {
  Rng rng(4);
  const test::SyntheticRobot robot = test::chapter_robot("c", rng);
  auto samples = test::babble(robot, 80, {.regime = Regime::kTagIso}, rng);
  const Pose by = test::random_pose(rng, 0.02, 0.02);
  for (std::size_t n = samples.size() - 8; is_moved && n < samples.size(); ++n)
    for (PartObservation& o : samples[n].parts)
      if (o.part == 1) o.X_CB = o.X_CB * by;
  LearnOptions options;
  options.measurement.noise = test::nominal_noise(Regime::kTagIso);
  options.is_monitored = is_monitored;
  return learn(robot.signals, samples, options);
}

TEST(Refused, IsAnEdgeWhoseBaseWasMovedLateAndThePartsThatHangOnItAreTold) {
  EXPECT_TRUE(learned_with_a_moved_base(false, false).schema.complete);
  EXPECT_TRUE(learned_with_a_moved_base(true, true).schema.complete);
  const LearnResult result = learned_with_a_moved_base(true, false);
  EXPECT_FALSE(result.schema.complete);
  ASSERT_EQ(result.refused.size(), 1u);
  EXPECT_EQ(result.refused.begin()->second, Refusal::kWrongAtAnEnd);
  EXPECT_TRUE(contains(result.schema.unconnected, "was moved meanwhile"));
  EXPECT_TRUE(contains(result.schema.unconnected, "it hangs on part"));
}

TEST(Learn, FindsAnotherWayAroundPartsThatAreSaidToShareNoEdge) {
  Rng rng(3);
  const test::SyntheticRobot robot = test::chapter_robot("c", rng);
  const auto samples =
      test::babble(robot, 60, {.regime = Regime::kTagIso, .with_covariances = true}, rng);
  LearnOptions options;
  const BodySchema direct = learn(robot.signals, samples, options).schema;
  ASSERT_TRUE(direct.complete);
  const Edge& last = direct.edges.back();
  options.unconnectable = {std::minmax(last.from, last.to)};
  const BodySchema around = learn(robot.signals, samples, options).schema;
  EXPECT_TRUE(around.complete);
  for (const Edge& edge : around.edges)
    EXPECT_NE(std::minmax(edge.from, edge.to), std::minmax(last.from, last.to));
}

// Three hinges on one signal, each bent in its own way: no bend of the command is that of all.
TEST(Learn, FindsJointsThatBendOneCommandUnalike) {
  for (unsigned seed = 1; seed <= 2; ++seed) {
    Rng rng(seed);
    const Noise noise{3e-4, 0.006};
    std::vector<Pose> markers;
    for (int part = 1; part <= 4; ++part) markers.push_back(test::random_pose(rng, 0.005, 0.01));
    std::vector<ActionPoseSample> samples(120);
    for (ActionPoseSample& sample : samples) {
      sample.sample_index = &sample - samples.data();
      sample.utime = 2'000'000 * sample.sample_index;
      const double s = test::uniform(rng, 0, 1);
      sample.action = Eigen::VectorXd::Constant(1, 0.03 * s);
      const double angles[] = {1.5 * (1 - std::exp(-2.5 * s)), 1.7 * s * s,
                               0.15 * std::log1p(std::exp(12 * (s - 0.5)))};
      Pose X = Pose::Identity();
      X.translation().z() = 0.4;
      for (int part = 1; part <= 4; ++part) {
        if (part > 1)
          X = X * Eigen::Translation3d(0.06, 0, 0) *
              Eigen::AngleAxisd(angles[part - 2], Eigen::Vector3d::UnitY());
        sample.parts.push_back(test::seen_at(part, X * markers[part - 1], noise, rng));
      }
    }
    LearnOptions options;
    options.measurement.noise = noise;
    EXPECT_TRUE(learn({{"tendon", 0, 0.03}}, samples, options).schema.complete) << seed;
  }
}

// A command, and what the drive reports of it.
TEST(Unconnected, PartsOfSignalsThatMoveAlikeAreToldSo) {
  Rng rng(5);
  const test::SyntheticRobot robot = test::chapter_robot("c", rng);
  auto samples = test::babble(robot, 30, {.regime = Regime::kTagIso}, rng);
  std::vector<Signal> signals = robot.signals;
  signals.push_back({"reported", -200, 200});
  const auto n = static_cast<Eigen::Index>(robot.signals.size());
  for (ActionPoseSample& sample : samples) {
    // The last part is elsewhere each time: nothing explains it.
    for (PartObservation& o : sample.parts)
      if (o.part == 5) o.X_CB = o.X_CB * test::random_pose(rng, 0.2, 0.3);
    sample.action.conservativeResize(n + 1);
    sample.action(n) = 57 * sample.action(0) + 3;
  }
  LearnOptions options;
  options.measurement.noise = test::nominal_noise(Regime::kTagIso);
  const BodySchema schema = learn(signals, samples, options).schema;
  EXPECT_TRUE(
      contains(schema.unconnected, robot.signals[0].name + ", reported move alike at all samples"));
}

// Where signals that move alike explain a joint as well as each other, its edge is left open, be it
// found between its own parts or by all of them; where they differ by what poses show, it is told.
TEST(Unconnected, AreJointsOfASignalThatAnotherOneFollows) {
  for (const double miss : {0.0, 0.0005, 0.02})
    for (int seed = 1; seed <= 2; ++seed) {
      Rng rng(seed);
      const test::SyntheticRobot robot = test::chapter_robot("c", rng);
      auto samples = test::babble(robot, 60, {.regime = Regime::kTagIso}, rng);
      std::vector<Signal> signals = robot.signals;
      for (const Signal& signal : robot.signals) signals.push_back(signal);
      const auto n = static_cast<Eigen::Index>(robot.signals.size());
      for (ActionPoseSample& sample : samples) {
        sample.action.conservativeResize(2 * n);
        for (Eigen::Index s = 0; s < n; ++s)
          sample.action(n + s) = sample.action(s) + miss * test::gaussian(rng);
      }
      LearnOptions options;
      options.measurement.noise = test::nominal_noise(Regime::kTagIso);
      const BodySchema schema = learn(signals, samples, options).schema;
      if (miss == 0) EXPECT_TRUE(schema.edges.empty()) << seed;
      if (miss < 0.01) EXPECT_FALSE(schema.complete) << seed;
      if (miss > 0.01) EXPECT_EQ(judge(schema, robot), test::Rightness::kRight) << seed;
    }
}

// Of two joints with nothing seen between them, each moved while the other rests, either may come
// first; some poses in which both are moved tell it.
TEST(Unconnected, AreJointsWhoseOrderIsNotTold) {
  for (const int num_together : {0, 8})
    for (int seed = 1; seed <= 4; ++seed) {
      Rng rng(seed);
      const test::SyntheticRobot robot = test::chapter_robot("co", rng);
      const auto num_signals = static_cast<Eigen::Index>(robot.signals.size());
      std::vector<ActionPoseSample> samples;
      for (int n = 0; n < 80 + num_together; ++n) {
        Eigen::VectorXd action = robot.random_action(rng);
        for (Eigen::Index s = 0; n < 80 && s < num_signals; ++s)
          if (s != n % num_signals) action(s) = 0.2;
        samples.push_back(test::observe(robot, action, {Regime::kTagIso}, n, rng));
      }
      LearnOptions options;
      options.measurement.noise = test::nominal_noise(Regime::kTagIso);
      const BodySchema schema = learn(robot.signals, samples, options).schema;
      if (num_together > 0)
        EXPECT_EQ(judge(schema, robot), test::Rightness::kRight) << seed;
      else
        EXPECT_TRUE(contains(schema.unconnected, "the order of the joints of ")) << seed;
    }
}

// An object that is in the hand at most samples, and on a table else; and one that is always in the
// hand, where its tag or that of the hand is read turned over as often.
TEST(Unconnected, IsAPartThatKeepsToASecondPlace) {
  constexpr int kHand = 4, kObject = 5;
  for (const int turned : {0, kHand, kObject})
    for (int seed = 1; seed <= 4; ++seed) {
      const bool is_on_table = turned == 0;
      Rng rng(seed);
      const test::SyntheticRobot robot = test::chapter_robot("c", rng);
      auto samples = test::babble(robot, 100, {.regime = Regime::kTagIso}, rng);
      const Noise noise = test::nominal_noise(Regime::kTagIso);
      const Pose X_CT = robot.X_CR * test::random_pose(rng, 0.3, 0.5);
      for (std::size_t n = 0; n < samples.size(); n += 6)
        for (PartObservation& o : samples[n].parts) {
          if (is_on_table && o.part == kObject) o = test::seen_at(kObject, X_CT, noise, rng);
          if (o.part == turned)
            o = test::seen_at(o.part, o.X_CB * Eigen::AngleAxisd(0.6, Eigen::Vector3d::UnitX()),
                              noise, rng);
        }
      LearnOptions options;
      options.measurement.noise = noise;
      options.measurement.outlier_rate = 0.1;
      const BodySchema schema = learn(robot.signals, samples, options).schema;
      EXPECT_EQ(contains(schema.unconnected, "keeps to one other place"), is_on_table)
          << turned << " " << seed;
      EXPECT_EQ(schema.complete, !is_on_table) << turned << " " << seed;
    }
}

// Between the two joints of an edge, and at every sixth sample alone.
TEST(Unconnected, IsAPartBeyondAJointThatIsNotRecorded) {
  for (const double turn : {0.0, 0.4})
    for (int seed = 1; seed <= 4; ++seed) {
      Rng rng(seed);
      const test::SyntheticRobot robot = test::chapter_robot("co", rng);
      test::SyntheticRobot turned = robot;
      const auto hidden = std::ranges::find(turned.links, true, &test::TrueLink::hidden);
      hidden->X_after = hidden->X_after * Eigen::AngleAxisd(turn, Eigen::Vector3d::UnitX());
      std::vector<ActionPoseSample> samples;
      for (int n = 0; n < 100; ++n)
        samples.push_back(test::observe(n % 6 == 0 ? turned : robot, robot.random_action(rng),
                                        {.regime = Regime::kFree}, n, rng));
      LearnOptions options;
      options.measurement.noise = Noise{0.001, 0.005};
      options.measurement.outlier_rate = 0.1;
      const BodySchema schema = learn(robot.signals, samples, options).schema;
      EXPECT_EQ(contains(schema.unconnected, "a joint that is not recorded is elsewhere"), turn > 0)
          << seed;
      EXPECT_EQ(schema.complete, turn == 0) << seed;
    }
}

// Where an edge begins, about the tag of the part before it: as if that were read turned over, but
// the edge to that part has it right, or it rests.
TEST(Unconnected, IsAPartThatAJointBehindATagTurnsWhichIsNotRecorded) {
  const Noise noise{0.001, 0.005};
  for (const bool is_root : {false, true})
    for (const double turn : {0.0, 0.4}) {
      Rng rng(1);
      std::vector<ActionPoseSample> samples(100);
      for (int n = 0; n < 100; ++n) {
        ActionPoseSample& sample = samples[static_cast<std::size_t>(n)];
        sample.sample_index = n;
        sample.utime = 2'000'000 * std::int64_t{n};
        sample.action = Eigen::Vector2d(test::uniform(rng, -1, 1), test::uniform(rng, -1, 1));
        Pose X = Pose::Identity();
        if (!is_root) {
          sample.parts.push_back(test::seen_at(1, X, noise, rng));
          X = X * Eigen::AngleAxisd(sample.action(0), Eigen::Vector3d::UnitZ()) *
              Eigen::Translation3d(0.2, 0, 0);
        }
        sample.parts.push_back(test::seen_at(2, X, noise, rng));
        X = X * Eigen::AngleAxisd(n % 6 == 0 ? turn : 0, Eigen::Vector3d::UnitY()) *
            Eigen::Translation3d(0.3, 0, 0) *
            Eigen::AngleAxisd(sample.action(1), Eigen::Vector3d::UnitX()) *
            Eigen::Translation3d(0, 0.1, 0);
        sample.parts.push_back(test::seen_at(3, X, noise, rng));
      }
      LearnOptions options;
      options.measurement.noise = noise;
      const BodySchema schema = learn({{"q1", -1, 1}, {"q2", -1, 1}}, samples, options).schema;
      EXPECT_EQ(contains(schema.unconnected, "a joint that is not recorded is elsewhere"),
                turn > 0);
      EXPECT_EQ(schema.complete, turn == 0);
    }
}

}  // namespace
}  // namespace bodyschema
