#include "processes/model_monitor/health/moved_tags.h"

#include <gtest/gtest.h>

#include <set>
#include <vector>

#include "tests/support/broken_arm.h"

namespace bodyschema {
namespace {

constexpr int kPart = 4, kTag = 41, kOther = 42;

/// An engineered arm of which one part is seen, without noise.
class MovedTagsTest : public testing::Test {
 protected:
  ActionPoseSample seen(std::int64_t index, int tag, bool is_in_place) const {
    ActionPoseSample sample;
    sample.sample_index = index;
    sample.action = Eigen::VectorXd::Constant(7, 0.1 * static_cast<double>(index % 10));
    PartObservation& o = sample.parts.emplace_back();
    o.part = kPart;
    o.tags = {tag};
    o.X_CB = schema_.X_CR * schema_.predict_all(sample.action).at(kPart);
    if (!is_in_place) o.X_CB = o.X_CB * Eigen::Translation3d(0.1, 0, 0);
    o.covariance = 1e-6 * Matrix6d::Identity();
    return sample;
  }
  /// In one picture the one tag has the part in its place, the other elsewhere: on the part, or at
  /// a place of its own in the room.
  ActionPoseSample contradictory(std::int64_t index, bool is_lying) const {
    ActionPoseSample sample = seen(index, kTag, false);
    if (is_lying) {
      const Eigen::VectorXd home = Eigen::VectorXd::Zero(7);
      sample.parts[0].X_CB = schema_.X_CR * schema_.predict_all(home).at(kPart);
    }
    sample.contradictions = {sample.parts[0], seen(index, kOther, true).parts[0]};
    sample.parts.clear();
    return sample;
  }
  std::vector<MovedTags::Finding> look(MovedTags* tags, const ActionPoseSample& sample) const {
    return tags->look(sample, schema_, schema_, {});
  }

  const BodySchema schema_ =
      test::BrokenArm({test::Fault::kNone, "", 1}, test::Regime::kTagIso, 1, 3).engineered();
};

TEST_F(MovedTagsTest, WhatAloneShowsAPartForLongIsBelievedAgainAlsoOverARestart) {
  for (const int num_before : {0, 20, 29, 100}) {
    MovedTags tags({{kTag, 0, 0, -1}});
    for (int n = 0; n < num_before; ++n) tags.look_back(seen(n, kTag, false), schema_, {});
    EXPECT_TRUE(tags.has_moved(kTag));
    int num = 0;
    while (tags.has_moved(kTag) && num < 100) {
      const auto findings = look(&tags, seen(num_before + num, kTag, false));
      ++num;
      if (findings.empty()) continue;
      ASSERT_EQ(findings.size(), 1U);
      EXPECT_TRUE(findings[0].is_back);
      EXPECT_EQ(findings[0].tag, kTag);
    }
    EXPECT_EQ(num, std::max(1, 30 - num_before));
  }
  // Another tag shows it now and then.
  MovedTags tags({{kTag, 0, 0, -1}});
  for (int n = 0; n < 200; ++n)
    EXPECT_TRUE(look(&tags, seen(n, n % 10 == 9 ? kOther : kTag, n % 10 == 9)).empty());
}

TEST_F(MovedTagsTest, WhereATagWasBeforeItMovedDoesNotBringItBack) {
  MovedTags tags({{kTag, 60, 50, -1}});
  for (int n = 0; n < 50; ++n) tags.look_back(seen(n, kTag, true), schema_, {});
  for (int n = 50; n < 60; ++n) tags.look_back(seen(n, kTag, false), schema_, {});
  for (int n = 60; n < 63; ++n) {
    const auto findings = look(&tags, seen(n, kTag, true));
    EXPECT_EQ(findings.size(), n == 62 ? 1U : 0U) << n;
  }
  EXPECT_FALSE(tags.has_moved(kTag));
}

TEST_F(MovedTagsTest, OneThatIsAloneInTheWrongPlaceHasMoved) {
  MovedTags tags({});
  std::vector<MovedTags::Finding> findings;
  for (int n = 0; n < 7; ++n) {
    EXPECT_TRUE(findings.empty()) << n;
    findings = look(&tags, seen(n, n % 2 ? kOther : kTag, n % 2));
  }
  ASSERT_EQ(findings.size(), 1U);
  EXPECT_EQ(findings[0].tag, kTag);
  EXPECT_EQ(findings[0].since, 0);
}

TEST_F(MovedTagsTest, OneThatOthersContradictInThreePicturesHasMoved) {
  for (const bool is_lying : {false, true}) {
    MovedTags tags({});
    std::vector<MovedTags::Finding> findings;
    for (int n = 1; n < 4; ++n) {
      EXPECT_TRUE(findings.empty()) << n;
      findings = look(&tags, contradictory(n, is_lying));
    }
    ASSERT_EQ(findings.size(), 1U);
    EXPECT_EQ(findings[0].tag, kTag);
    EXPECT_EQ(findings[0].since, 1);
    EXPECT_EQ(findings[0].is_on_part, !is_lying);
    EXPECT_EQ(tags.is_lying(kTag), is_lying);
    EXPECT_FALSE(tags.has_moved(kOther));
  }
}

/// What lies in the room shows nothing of the part, however long it alone is seen.
TEST_F(MovedTagsTest, OneThatLiesInTheRoomIsNotTakenBack) {
  MovedTags tags({});
  for (int n = 1; n < 4; ++n) look(&tags, contradictory(n, true));
  ASSERT_TRUE(tags.is_lying(kTag));
  for (int n = 4; n < 100; ++n) {
    ActionPoseSample sample = contradictory(n, true);
    sample.contradictions.pop_back();
    EXPECT_TRUE(look(&tags, sample).empty()) << n;
  }
  for (int n = 100; n < 103; ++n)
    EXPECT_EQ(look(&tags, seen(n, kTag, true)).size(), n == 102 ? 1U : 0U) << n;
  EXPECT_FALSE(tags.has_moved(kTag));
}

/// Where other tags of its part are elsewhere too, each time somewhere else, the body is wrong.
TEST_F(MovedTagsTest, NoneHasMovedWhereOthersAreElsewhereToo) {
  for (const bool are_two_seen : {false, true}) {
    MovedTags tags({});
    for (int n = 0; n < 40; ++n) {
      ActionPoseSample sample = seen(n, n % 2 ? kTag : kOther, n % 4 == 0);
      if (n % 4 == 2) {
        sample.parts[0].X_CB = sample.parts[0].X_CB * Eigen::Translation3d(0, 0.01 * n, 0);
        if (are_two_seen) sample.parts[0].tags = {kTag, kOther};
      }
      EXPECT_TRUE(look(&tags, sample).empty()) << n;
    }
  }
}

TEST_F(MovedTagsTest, NoneHasMovedWhereTheBodyAsItStandsExplainsIt) {
  BodySchema standing = schema_;
  for (Edge& edge : standing.edges)
    if (edge.to == kPart)
      for (ScrewJoint& joint : edge.joints) joint.gain *= 0.5;
  MovedTags tags({});
  for (int n = 0; n < 40; ++n) {
    ActionPoseSample sample = seen(n, n % 2 ? kTag : kOther, true);
    // kTag is seen at one action alone.
    sample.action.setConstant(n % 2 ? 0.8 : 0);
    sample.parts[0].X_CB = standing.X_CR * standing.predict_all(sample.action).at(kPart);
    EXPECT_TRUE(tags.look(sample, schema_, standing, {}).empty()) << n;
  }
}

TEST_F(MovedTagsTest, TwoOfFourThatMovedAreBothNamed) {
  MovedTags tags({});
  std::multiset<int> named;
  for (int n = 0; n < 60; ++n) {
    ActionPoseSample sample = seen(n, kTag + n % 4, n % 4 > 1);
    if (n % 4 == 1) sample.parts[0].X_CB = sample.parts[0].X_CB * Eigen::Translation3d(0, 0.1, 0);
    for (const auto& finding : look(&tags, sample)) {
      EXPECT_FALSE(finding.is_back);
      named.insert(finding.tag);
    }
  }
  EXPECT_EQ(named, (std::multiset<int>{kTag, kOther}));
}

TEST_F(MovedTagsTest, ATagThatIsSeenInItsPlaceDoesNotLieInTheRoom) {
  MovedTags tags({});
  int n = 0;
  for (; n < 20 && !tags.is_lying(kTag); ++n) look(&tags, contradictory(n, true));
  ASSERT_TRUE(tags.is_lying(kTag));
  look(&tags, seen(n, kTag, true));
  EXPECT_FALSE(tags.is_lying(kTag));
  EXPECT_TRUE(tags.has_moved(kTag));  // once in its place may be chance
}

}  // namespace
}  // namespace bodyschema
