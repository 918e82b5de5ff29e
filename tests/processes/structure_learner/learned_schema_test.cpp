#include "processes/structure_learner/learned_schema.h"

#include <gtest/gtest.h>

#include <map>

#include "processes/structure_learner/edge_fit.h"
#include "processes/structure_learner/root_pose.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using Ends = std::vector<std::pair<int, int>>;

TEST(VisitOutwards, BeginsAtTheRootAndGoesOnBeyondARefusedEdge) {
  BodySchema schema;
  schema.parts = {1, 2, 3, 4};
  schema.root = 3;
  for (const bool is_refused : {false, true}) {
    Ends visited;
    visit_outwards({{1, 2}, {2, 3}, {3, 4}}, schema, [&](int edge, int from, int to) {
      if (is_refused && edge == 1) return false;
      visited.emplace_back(from, to);
      return true;
    });
    EXPECT_EQ(visited, is_refused ? (Ends{{3, 4}, {1, 2}}) : (Ends{{3, 2}, {3, 4}, {2, 1}}));
  }
}

TEST(ReportUnconnected, ExplainsPartsThatWereSeenAndIsCompleteWithoutTheOthers) {
  BodySchema schema;
  schema.parts = {1, 2, 3};
  schema.root = 1;
  schema.edges.resize(1);
  schema.edges[0].from = 1;
  schema.edges[0].to = 2;
  const auto explain = [](int part) {
    return UnconnectedPart{part, Unconnected::kNoValidModel, "why"};
  };
  BodySchema partial = schema;
  report_unconnected({9}, explain, &partial);
  EXPECT_FALSE(partial.complete);
  ASSERT_EQ(partial.unconnected.size(), 2u);
  EXPECT_EQ(partial.unconnected[0].detail, "why");
  EXPECT_EQ(partial.unconnected[1].reason, Unconnected::kNeverSeen);
  schema.parts = {1, 2};
  report_unconnected({9}, explain, &schema);
  EXPECT_TRUE(schema.complete);
  EXPECT_EQ(schema.unconnected.size(), 1u);
}

TEST(Rescaled, PredictsTheSame) {
  test::Rng rng(2);
  const auto robot = test::chapter_robot("a", rng);
  const auto samples = test::babble(robot, 20, {}, rng);
  const NormalizedActions from(samples, 2), to({samples.begin(), samples.begin() + 5}, 2);
  LocalModel model;
  model.joints = {{.signal = 1, .slide = 0.02, .turn = 0.7},
                  {.signal = 0, .slide = 0.1, .turn = -1.2}};
  for (int d = 0; d <= 2; ++d) model.transform(d) = test::random_pose(rng, 0.1, 0.2);
  EXPECT_TRUE(rescaled(model, from, to).predict(to, 3).isApprox(model.predict(from, 3), 1e-12));
}

// Two tags that sit elsewhere and are larger than told, one or both in sight.
TEST(RootPose, ItsCovarianceIsTrueHoweverOftenATagIsSeen) {
  const MeasurementModel measurement{
      .tags = {.position_m = 0.002, .rotation_rad = 0.01, .size_share = 0.003}};
  const Matrix6d noise = isotropic({.position_m = 0.001, .rotation_rad = 0.004});
  constexpr int kRobots = 200;
  test::Rng rng(3);
  const auto drawn = [&](auto size) -> Eigen::Matrix<double, size(), 1> {
    return Eigen::Matrix<double, size(), 1>::NullaryExpr([&] { return test::gaussian(rng); });
  };
  for (const int num_samples : {10, 200}) {
    double mean = 0;
    for (int robot = 0; robot < kRobots; ++robot) {
      Pose X_CR = test::random_pose(rng, 0.3, 3);
      X_CR.translation().z() += 1;
      std::map<int, Eigen::Matrix<double, 7, 1>> of_tag;
      for (const int id : {4, 5}) of_tag[id] = drawn(std::integral_constant<int, 7>{});
      std::vector<ActionPoseSample> samples(num_samples);
      for (ActionPoseSample& sample : samples) {
        PartObservation& seen = sample.parts.emplace_back();
        seen.part = 1;
        seen.tags = {4, 5};
        if (test::uniform(rng, 0, 1) < 0.5) seen.tags.pop_back();
        const auto effect = measurement.effect_of_tag(X_CR, seen.tags.size());
        Vector6d error = noise.llt().matrixL() * drawn(std::integral_constant<int, 6>{});
        seen.covariance = noise;
        for (const int id : seen.tags) {
          error += effect * of_tag.at(id);
          seen.covariance += effect * effect.transpose();
        }
        seen.X_CB = X_CR * exp(error);
      }
      BodySchema schema;
      schema.root = 1;
      estimate_root_pose(samples, measurement, &schema);
      const Vector6d error = log(schema.X_CR.inverse() * X_CR);
      mean += error.dot(schema.X_CR_covariance.ldlt().solve(error)) / kRobots;
    }
    EXPECT_GT(mean, 3) << num_samples;
    EXPECT_LT(mean, 6 + 4 * std::sqrt(12.0 / kRobots)) << num_samples;
  }
}

TEST(RootPose, OneWrongReadingDoesNotMoveIt) {
  test::Rng rng(4);
  const auto robot = test::chapter_robot("a", rng);
  auto samples = test::babble(robot, 40, {test::Regime::kChapter, true}, rng);
  const PartObservation* root = samples[0].find(1);
  const_cast<PartObservation*>(root)->X_CB.translation().x() += 1;
  BodySchema schema;
  schema.root = 1;
  estimate_root_pose(samples, {}, &schema);
  const Vector6d error =
      log(schema.X_CR.inverse() * robot.poses_in_camera(samples[0].action).at(1));
  EXPECT_LT(error.dot(schema.X_CR_covariance.ldlt().solve(error)), 20);
  EXPECT_LT(schema.X_CR_covariance.trace(), root->covariance.trace() / 20);
}

}  // namespace
}  // namespace bodyschema
