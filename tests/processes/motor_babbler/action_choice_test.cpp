#include "processes/motor_babbler/action_choice.h"

#include <gtest/gtest.h>

#include <cmath>

#include "common/geometry/angle.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

/// Part 2 turns about part 1 with signal 0; signal 1 moves nothing. The camera looks at both.
BodySchema hinge() {
  BodySchema schema;
  schema.signals = {{"q1", -1, 1, {}}, {"q2", -1, 1, {}}};
  schema.parts = {1, 2};
  schema.root = 1;
  schema.complete = true;
  schema.last_sample_index = 9;
  schema.X_CR.translation() << 0, 0, 2;
  schema.noise = {0.001, 0.005};
  Edge edge;
  edge.from = 1;
  edge.to = 2;
  edge.left.linear() = exp_so3({0.9, 0.2, 0});
  ScrewJoint joint;
  joint.turn = 1.5;
  joint.X_after.translation() << 0.2, 0, 0.1;
  edge.joints = {joint};
  edge.parameter_covariance = 1e-6 * Eigen::MatrixXd::Identity(14, 14);
  schema.edges = {edge};
  return schema;
}

SeenAction seen_at(double q1, double q2, std::set<int> parts, std::int64_t index = 0) {
  return {index, true, Eigen::Vector2d(q1, q2), std::move(parts)};
}

std::size_t choose(const BodySchema& schema, const std::vector<SeenAction>& past,
                   const std::vector<Eigen::Vector2d>& candidates) {
  return choose_action(schema, past, {candidates.begin(), candidates.end()});
}

TEST(VisibilityModelTest, KnowsNothingBeforeTheFirstSample) {
  const BodySchema schema = hinge();
  for (const auto& [part, p] : VisibilityModel(schema, {}).probabilities(Eigen::Vector2d(0, 0)))
    EXPECT_DOUBLE_EQ(p, 0.5) << part;
}

TEST(VisibilityModelTest, APartIsSeenAgainFromWhereItWasSeen) {
  std::vector<SeenAction> past;
  for (int n = 0; n < 10; ++n) {
    past.push_back(seen_at(0.8, 0.1 * n, {1, 2}));
    past.push_back(seen_at(-0.8, 0.1 * n, {1}));
  }
  const BodySchema schema = hinge();
  const VisibilityModel model(schema, past);
  EXPECT_GT(model.probabilities(Eigen::Vector2d(0.8, -0.9)).at(2), 0.9);
  EXPECT_LT(model.probabilities(Eigen::Vector2d(-0.8, -0.9)).at(2), 0.1);
  for (const double q : {-0.8, 0.0, 0.8})
    EXPECT_GT(model.probabilities(Eigen::Vector2d(q, 0)).at(1), 0.9);
}

TEST(VisibilityModelTest, OfAPartWithoutAnEdgeItGoesByTheSignals) {
  BodySchema schema = hinge();
  schema.unconnected = {{3, Unconnected::kNotEnoughData, ""}};
  std::vector<SeenAction> past;
  for (int n = 0; n < 10; ++n) {
    past.push_back(seen_at(0.1 * n, 0.8, {1, 3}));
    past.push_back(seen_at(0.1 * n, -0.8, {1}));
  }
  const VisibilityModel model(schema, past);
  EXPECT_GT(model.probabilities(Eigen::Vector2d(0.5, 0.8)).at(3), 0.8);
  EXPECT_LT(model.probabilities(Eigen::Vector2d(0.5, -0.8)).at(3), 0.2);
}

// Markers that are seen within 70° only: mean squared error of the probabilities at new actions,
// against that of each part's share of the past.
TEST(VisibilityModelTest, PredictsTheSyntheticCameraBetterThanTheSharesDo) {
  double model_error = 0, share_error = 0;
  for (std::uint64_t seed = 1; seed <= 5; ++seed) {
    test::Rng rng(seed);
    const test::SyntheticRobot robot = test::chapter_robot("d", rng);
    const BodySchema schema = test::true_schema(robot);
    const double angle = 70 * kDegree;
    std::vector<SeenAction> past;
    for (int n = 0; n < 60; ++n) {
      const Eigen::VectorXd action = robot.random_action(rng);
      past.push_back({n, true, action, test::facing_parts(robot, action, angle)});
    }
    const VisibilityModel model(schema, past);
    for (int n = 0; n < 200; ++n) {
      const Eigen::VectorXd action = robot.random_action(rng);
      const std::set<int> facing = test::facing_parts(robot, action, angle);
      for (const auto& [part, p] : model.probabilities(action)) {
        double share = 0;
        for (const SeenAction& seen : past) share += double(seen.parts.count(part)) / past.size();
        model_error += std::pow(p - double(facing.count(part)), 2);
        share_error += std::pow(share - double(facing.count(part)), 2);
      }
    }
  }
  EXPECT_LT(model_error, 0.7 * share_error);
}

TEST(ActionChoiceTest, PrefersWhatTheModelIsUnsureOf) {
  BodySchema schema = hinge();
  // Only the joint's turn is unknown: it shows more, the further the joint turns.
  schema.edges[0].parameter_covariance.setZero();
  schema.edges[0].parameter_covariance(7, 7) = 1e-2;
  const std::vector<SeenAction> past = {seen_at(0, 0, {1, 2}), seen_at(0.5, 0, {1, 2}),
                                        seen_at(-0.5, 0, {1, 2})};
  EXPECT_EQ(choose(schema, past, {{0.1, 0}, {0.9, 0}, {-0.2, 0}}), 1U);
}

TEST(ActionChoiceTest, WhatWasTakenSinceTheSchemaCountsAsLearned) {
  BodySchema schema = hinge();
  schema.edges[0].parameter_covariance.setZero();
  schema.edges[0].parameter_covariance(7, 7) = 1e-2;
  // Both directions are equally informative on the turn; after many samples at one of them, the
  // other is more informative on the residual of the model.
  std::vector<SeenAction> past;
  for (int n = 0; n < 6; ++n) past.push_back(seen_at(0.9, 0, {1, 2}, 10 + n));
  EXPECT_EQ(choose(schema, past, {{0.9, 0}, {-0.9, 0}}), 1U);
  // The turn is known by then; before, it was worth more than any residual.
  EXPECT_EQ(choose(schema, past, {{0.9, 0}, {0, 0.9}}), 1U);
  for (SeenAction& seen : past) seen.is_learned_from = false;
  EXPECT_EQ(choose(schema, past, {{0.9, 0}, {0, 0.9}}), 0U);
}

TEST(ActionChoiceTest, OnlySamplesThatTheSchemaLacksMakeItSurer) {
  BodySchema schema = hinge();
  schema.edges[0].parameter_covariance.setZero();
  schema.edges[0].parameter_covariance(7, 7) = 1e-2;
  std::vector<SeenAction> past;
  for (int n = 0; n < 400; ++n)  // no action is new to the residual of the model
    past.push_back(seen_at(0.1 * (n % 20) - 0.95, 0.1 * (n / 20) - 0.95, {1, 2}));
  for (int n = 0; n < 60; ++n) past.push_back(seen_at(0.9, 0, {1, 2}));
  EXPECT_EQ(choose(schema, past, {{0.9, 0}, {0, 0.9}}), 0U);
  for (int n = 0; n < 60; ++n) past[400 + n].sample_index = schema.last_sample_index + 1 + n;
  EXPECT_EQ(choose(schema, past, {{0.9, 0}, {0, 0.9}}), 1U);
}

TEST(ActionChoiceTest, BothPartsOfAnEdgeMustBeSeen) {
  std::vector<SeenAction> past;
  for (int n = 0; n < 10; ++n) {
    past.push_back(seen_at(0.8, 0, {1, 2}));
    past.push_back(seen_at(-0.8, 0, {1}));
  }
  // The lower side is less known, but nothing can be learned there.
  EXPECT_EQ(choose(hinge(), past, {{-0.8, 0}, {0.8, 0}}), 1U);
}

TEST(ActionChoiceTest, SignalsThatNoEdgeUsesAreMovedToo) {
  std::vector<SeenAction> past;
  for (int n = 0; n < 10; ++n) past.push_back(seen_at(0.2 * n - 1, 0, {1, 2}));
  EXPECT_EQ(choose(hinge(), past, {{0.5, 0}, {0.5, 0.9}}), 1U);
}

TEST(ActionChoiceTest, LooksForPartsWithoutAnEdgeWhereTheyMayBeSeen) {
  BodySchema schema = hinge();
  schema.complete = false;
  schema.unconnected = {{3, Unconnected::kNotEnoughData, ""}};
  std::vector<SeenAction> past;
  for (int n = 0; n < 40; ++n) past.push_back(seen_at(0.02 * n, -0.8, {1, 2}));
  for (int n = 0; n < 4; ++n) past.push_back(seen_at(0.2 * n, 0.8, {1, 2, 3}));
  EXPECT_EQ(choose(schema, past, {{0.5, -0.8}, {0.5, 0.8}}), 1U);
  // An unseen part is searched at actions that were not tried yet.
  schema.unconnected = {{4, Unconnected::kNeverSeen, ""}};
  EXPECT_EQ(choose(schema, past, {{0.5, -0.8}, {-1, 0}, {0.5, 0.8}}), 1U);
}

TEST(ActionChoiceTest, TheFirstOfEqualsIsChosen) {
  EXPECT_EQ(choose(hinge(), {}, {{0.3, 0.3}, {0.3, 0.3}}), 0U);
}

TEST(ActionChoiceTest, AnEdgeWithoutParametersIsNoHarm) {
  BodySchema schema = hinge();
  schema.edges[0].parameter_covariance.resize(0, 0);
  const std::vector<SeenAction> past = {seen_at(0.5, 0.5, {1, 2}, 20)};
  EXPECT_EQ(choose(schema, past, {{0.5, 0.5}, {-0.9, 0.9}}), 1U);
}

TEST(ActionChoiceTest, WithoutACandidateThereIsNoChoice) {
  EXPECT_THROW(choose_action(hinge(), {}, {}), std::invalid_argument);
}

}  // namespace
}  // namespace bodyschema
