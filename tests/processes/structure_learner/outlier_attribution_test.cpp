#include "processes/structure_learner/outlier_attribution.h"

#include <gtest/gtest.h>

#include "processes/structure_learner/learn.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::is_right;
using test::Regime;
using test::Rng;

TEST(OutlierAttribution, BlamesTheMarkerThatWasWrong) {
  Rng rng(15);
  const auto robot = test::chapter_robot("c", rng);
  auto samples = test::babble(robot, 30, {Regime::kFree}, rng);
  const auto spoil = [&](int t, int part) {
    for (auto& o : samples[t].parts)
      if (o.part == part) o.X_CB.linear() = o.X_CB.linear() * exp_so3({0.7, 0, 0});
  };
  spoil(4, 3);   // inner part
  spoil(9, 5);   // leaf
  spoil(20, 1);  // root
  const auto result = learn(robot.signals, samples);
  EXPECT_TRUE(is_right(result.schema, robot));
  ASSERT_EQ(result.outliers.size(), 3u);
  EXPECT_EQ(result.outliers[0].sample_index, 4);
  EXPECT_EQ(result.outliers[0].part, 3);
  EXPECT_EQ(result.outliers[1].sample_index, 9);
  EXPECT_EQ(result.outliers[1].part, 5);
  EXPECT_EQ(result.outliers[2].sample_index, 20);
  EXPECT_EQ(result.outliers[2].part, 1);
}

TEST(OutlierAttribution, BlamesTheMovingPartOfTwoByTheRestingRoot) {
  Rng rng(16);
  test::SyntheticRobot robot = test::chapter_robot("a", rng);
  auto samples = test::babble(robot, 20, {}, rng);
  for (auto& s : samples)
    std::erase_if(s.parts, [](auto& o) { return o.part != 1 && o.part != 3; });
  samples[3].parts[0].X_CB.translation().x() += 0.1;
  samples[5].parts[1].X_CB.translation().x() += 0.1;
  const auto result = learn(robot.signals, samples);
  ASSERT_EQ(result.outliers.size(), 2u);
  EXPECT_EQ(result.outliers[0].part, 1);
  EXPECT_EQ(result.outliers[1].part, 3);
}

}  // namespace
}  // namespace bodyschema
