#include "processes/model_monitor/hypotheses/change_search.h"

#include <gtest/gtest.h>

#include "common/kinematics/screw_chain.h"
#include "processes/model_monitor/hypotheses/schema_difference.h"
#include "tests/processes/model_monitor/changed_arm.h"

namespace bodyschema {
namespace {

constexpr int kBent = 3, kOther = 7, kAlmost = 5;

/// An arm that was once bent in two places; a third edge of that schema differs by less than is
/// uncertain about it.
class ChangeSearchTest : public ChangedArm {
 protected:
  ChangeSearchTest() : ChangedArm(5) {
    for (Edge& edge : schema_.edges) {
      const int size = ScrewChainLayout::size(static_cast<int>(edge.joints.size()));
      edge.parameter_covariance = 1e-6 * Eigen::MatrixXd::Identity(size, size);
    }
    schema_.X_CR_covariance = 1e-6 * Matrix6d::Identity();
    const Eigen::VectorXd bend = vector({0.02, 0, 0, 0, 0.5, 0}),
                          little = vector({5e-4, 0, 0, 0, 0, 0});
    stored_ = changed(schema_, {Form::kBent, kBent, 1}, bend);
    stored_ = changed(stored_, {Form::kBent, kOther, 1}, bend);
    stored_ = changed(stored_, {Form::kBent, kAlmost, 1}, little);
  }

  static ElementId edge(int part) { return {ElementId::Kind::kJoint, part}; }
  FoundChanges find(const std::vector<ElementId>& elements) {
    const auto samples = observe(stored_, 3, Vector6d::Constant(1e-3));
    return find_changes(schema_, {stored_}, elements, pointers(samples), {measurement_});
  }

  const Eigen::VectorXd move_ = vector({0.03, 0, 0.01, 0, 0, 0.3});
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
  const BodySchema moved = changed(schema_, {Form::kMarkerMoved, kAlmost}, move_);
  EXPECT_EQ(differences(schema_, moved), (std::vector<ElementId>{tag_element(kAlmost)}));
  EXPECT_EQ(differences(schema_, stored_),
            (std::vector<ElementId>{edge(kBent), edge(kAlmost), edge(kOther)}));
}

TEST_F(ChangeSearchTest, OfTwoPlacesThatChangedBackBothAreRestoredAndNothingElse) {
  const FoundChanges found = find({edge(kOther), edge(kBent)});
  ASSERT_TRUE(found.best);
  EXPECT_EQ(found.best->fitted.change.form, Form::kStored);
  EXPECT_EQ(found.best->element, edge(kOther));  // suspected first
  EXPECT_EQ(found.best->also, (std::vector<ElementId>{edge(kBent)}));
  EXPECT_GT(found.margin(), 12);
  const BodySchema with = with_change(schema_, found.best->fitted);
  for (const int part : schema_.parts)
    EXPECT_EQ(differ_at(schema_, with, part), part == kBent || part == kOther) << part;
}

TEST_F(ChangeSearchTest, AMarkerThatIsBackIsOnePlaceThoughBothEdgesChange) {
  stored_ = changed(schema_, {Form::kMarkerMoved, kAlmost}, move_);
  const FoundChanges found = find({edge(kAlmost)});
  ASSERT_TRUE(found.best);
  EXPECT_EQ(found.best->fitted.change.form, Form::kStored);
  EXPECT_EQ(found.best->element, tag_element(kAlmost));
  EXPECT_TRUE(found.best->also.empty());
}

}  // namespace
}  // namespace bodyschema
