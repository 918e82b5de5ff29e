#include "processes/model_monitor/change_search.h"

#include <gtest/gtest.h>

#include "processes/model_monitor/schema_difference.h"
#include "tests/support/broken_arm.h"

namespace bodyschema {
namespace {

using Form = BodyChange::Form;

constexpr int kBent = 3, kOther = 7, kAlmost = 5;

/// An arm that was once bent in two places; a third edge of that schema differs by less than is
/// uncertain about it.
class ChangeSearchTest : public testing::Test {
 protected:
  ChangeSearchTest() {
    for (Edge& edge : schema_.edges)
      edge.parameter_covariance =
          1e-6 * Eigen::MatrixXd::Identity(6 + 8 * edge.joints.size(), 6 + 8 * edge.joints.size());
    schema_.X_CR_covariance = 1e-6 * Matrix6d::Identity();
    Eigen::VectorXd bend(6), little(6);
    bend << 0.02, 0, 0, 0, 0.5, 0;
    little << 5e-4, 0, 0, 0, 0, 0;
    stored_ = changed(schema_, {Form::kRight, kBent}, bend);
    stored_ = changed(stored_, {Form::kRight, kOther}, bend);
    stored_ = changed(stored_, {Form::kRight, kAlmost}, little);
  }

  std::vector<ActionPoseSample> observe(const BodySchema& body, int count) {
    std::vector<ActionPoseSample> samples;
    for (int t = 0; t < count; ++t) {
      ActionPoseSample& sample = samples.emplace_back();
      sample.sample_index = t;
      sample.action.resize(7);
      for (double& q : sample.action) q = test::uniform(rng_, -1.3, 1.3);
      for (const auto& [part, X_RB] : body.predict_all(sample.action)) {
        PartObservation& o = sample.parts.emplace_back();
        o.part = part;
        o.X_CB = body.X_CR * X_RB;
        o.covariance = 1e-6 * Matrix6d::Identity();
      }
    }
    return samples;
  }

  test::Rng rng_{5};
  BodySchema schema_ =
      test::BrokenArm({test::Fault::kNone, "", 1}, test::Regime::kTagIso, 1, 3).engineered();
  BodySchema stored_;
};

TEST_F(ChangeSearchTest, WhatIsAlikeIsNoDifference) {
  for (const int part : schema_.parts) {
    const bool is_changed = part == kBent || part == kOther;
    EXPECT_EQ(differ_at(schema_, stored_, part), is_changed || part == kAlmost) << part;
    EXPECT_EQ(is_alike_at(schema_, stored_, part), !is_changed) << part;
  }
  EXPECT_FALSE(is_alike(schema_, stored_));
  EXPECT_TRUE(is_alike(schema_, schema_));
  BodySchema moved = schema_;
  moved.X_CR.translation().x() += 0.1;
  EXPECT_TRUE(differ_at(schema_, moved, schema_.root));
  EXPECT_FALSE(is_alike_at(schema_, moved, schema_.root));
}

TEST_F(ChangeSearchTest, AMarkerThatMovedIsOnePlaceAndNotTheEdgesOnEitherSide) {
  Eigen::VectorXd move(6);
  move << 0.03, 0, 0.01, 0, 0, 0.3;
  const BodySchema moved = changed(schema_, {Form::kMarkerMoved, kAlmost}, move);
  EXPECT_EQ(differences(schema_, moved), (std::vector<Place>{{kAlmost, true}}));
  EXPECT_EQ(differences(schema_, stored_),
            (std::vector<Place>{{kBent, false}, {kAlmost, false}, {kOther, false}}));
}

TEST_F(ChangeSearchTest, OfTwoPlacesThatChangedBackBothAreRestoredAndNothingElse) {
  const auto samples = observe(stored_, 3);
  std::vector<const ActionPoseSample*> pointers;
  for (const ActionPoseSample& sample : samples) pointers.push_back(&sample);
  const ChangeSearch search{MeasurementModel{}};
  const FoundChanges found =
      find_changes(schema_, {stored_}, {{kOther, false}, {kBent, false}}, pointers, search);
  ASSERT_TRUE(found.best);
  EXPECT_EQ(found.best->fitted.change.form, Form::kStored);
  EXPECT_EQ(found.best->place, (Place{kOther, false}));  // suspected first
  EXPECT_EQ(found.best->also, (std::vector<Place>{{kBent, false}}));
  EXPECT_GT(found.margin(), 12);
  const BodySchema with = with_change(schema_, found.best->fitted);
  for (const int part : schema_.parts)
    EXPECT_EQ(differ_at(schema_, with, part), part == kBent || part == kOther) << part;
}

TEST_F(ChangeSearchTest, AMarkerThatIsBackIsOnePlaceThoughBothEdgesChange) {
  Eigen::VectorXd move(6);
  move << 0.03, 0, 0.01, 0, 0, 0.3;
  stored_ = changed(schema_, {Form::kMarkerMoved, kAlmost}, move);
  const auto samples = observe(stored_, 3);
  std::vector<const ActionPoseSample*> pointers;
  for (const ActionPoseSample& sample : samples) pointers.push_back(&sample);
  const FoundChanges found = find_changes(schema_, {stored_}, {{kAlmost, false}}, pointers,
                                          ChangeSearch{MeasurementModel{}});
  ASSERT_TRUE(found.best);
  EXPECT_EQ(found.best->fitted.change.form, Form::kStored);
  EXPECT_EQ(found.best->place, (Place{kAlmost, true}));
  EXPECT_TRUE(found.best->also.empty());
}

}  // namespace
}  // namespace bodyschema
