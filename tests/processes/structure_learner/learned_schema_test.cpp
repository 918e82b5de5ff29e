#include "processes/structure_learner/learned_schema.h"

#include <gtest/gtest.h>

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
  model.num_joints = 2;
  model.signal = {1, 0};
  model.slide = {0.02, 0.1};
  model.turn = {0.7, -1.2};
  for (Pose& A : model.A) A = test::random_pose(rng, 0.1, 0.2);
  EXPECT_TRUE(rescaled(model, from, to).predict(to, 3).isApprox(model.predict(from, 3), 1e-12));
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
