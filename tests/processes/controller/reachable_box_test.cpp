#include "processes/controller/reachable_box.h"

#include <gtest/gtest.h>

#include "common/geometry/angle.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

/// A link of 2 m that turns about z from −30° to 120°, on a slide of 1 m along x.
BodySchema slide_and_link() {
  BodySchema schema;
  schema.parts = {1, 2, 3};
  schema.root = 1;
  schema.signals = {{"slide", 0, 100}, {"turn", -30, 120}};
  Edge slide, link;
  slide.from = 1;
  slide.to = link.from = 2;
  link.to = 3;
  slide.joints.push_back({.signal = 0, .slide = 0.01});
  slide.left.linear() = exp_so3({0, M_PI / 2, 0});  // the joint's z is the root's x
  slide.right.linear() = exp_so3({0, -M_PI / 2, 0});
  link.joints.push_back({.signal = 1, .turn = kDegree});
  link.right.translation() = Eigen::Vector3d(2, 0, 0);
  schema.edges = {slide, link};
  return schema;
}

TEST(ReachableBoxTest, EndsWhereTheLimitsAndTheLinksEnd) {
  const Eigen::AlignedBox3d box = reachable_box(slide_and_link(), 3);
  const Eigen::Vector3d lowest(-1, -1, 0), highest(3, 2, 0);
  EXPECT_LT((box.min() - lowest).norm(), 1e-5) << box.min().transpose();
  EXPECT_LT((box.max() - highest).norm(), 1e-5) << box.max().transpose();
}

TEST(ReachableBoxTest, OfAFixedPartIsAPointAndOfAnUnconnectedOneEmpty) {
  BodySchema schema = slide_and_link();
  schema.edges[0].joints.clear();
  EXPECT_LT(reachable_box(schema, 2).diagonal().norm(), 1e-12);
  EXPECT_TRUE(reachable_box(schema, 7).isEmpty());
}

TEST(ReachableBoxTest, HoldsWhatSevenJointsReach) {
  for (std::uint64_t seed = 1; seed <= 3; ++seed) {
    test::Rng rng(seed);
    const test::SyntheticRobot robot = test::chapter_robot("d", rng);
    const BodySchema schema = test::true_schema(robot);
    for (const int part : schema.parts) {
      const Eigen::AlignedBox3d box = reachable_box(schema, part);
      for (int n = 0; n < 2000; ++n) {
        const Eigen::Vector3d p =
            schema.predict(schema.root, part, robot.random_action(rng))->X_AB.translation();
        ASSERT_LT(box.exteriorDistance(p), 1e-6) << "seed " << seed << ", part " << part;
      }
    }
  }
}

}  // namespace
}  // namespace bodyschema
