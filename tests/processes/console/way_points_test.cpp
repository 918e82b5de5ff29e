#include "processes/console/way_points.h"

#include <gtest/gtest.h>

#include <cmath>

namespace bodyschema {
namespace {

std::string problem_of(const std::string& text) {
  try {
    parse_way_points(text, "path.csv");
    return "";
  } catch (const WayPointError& error) {
    return error.what();
  }
}

TEST(WayPointsTest, PositionsAndPosesAreReadAsTheyStand) {
  const auto positions = parse_way_points("x, y, z\r\n0.1,-0.2,3e-1\r\n\n 0.4,0.5,0.6 \n", "");
  ASSERT_EQ(positions.size(), 2U);
  EXPECT_EQ(positions[0].p_RT, Eigen::Vector3d(0.1, -0.2, 0.3));
  EXPECT_FALSE(positions[0].q_RT);
  EXPECT_EQ(positions[1].p_RT, Eigen::Vector3d(0.4, 0.5, 0.6));
  const auto poses = parse_way_points("x,y,z,qw,qx,qy,qz\n0,0,1,0.6,0,0,-0.8\n", "");
  ASSERT_EQ(poses.size(), 1U);
  ASSERT_TRUE(poses[0].q_RT);
  EXPECT_NEAR(poses[0].q_RT->w(), 0.6, 1e-12);
  EXPECT_NEAR(poses[0].q_RT->z(), -0.8, 1e-12);
}

TEST(WayPointsTest, WhatIsWrongIsNamedWithItsLine) {
  EXPECT_EQ(problem_of(""), "path.csv: no way point");
  EXPECT_EQ(problem_of("x,y,z\n"), "path.csv: no way point");
  EXPECT_EQ(problem_of("x,y\n1,2\n"),
            "path.csv: line 1: expected the header x,y,z or x,y,z,qw,qx,qy,qz, found 'x,y'");
  EXPECT_EQ(problem_of("x,y,z\n1,2,3\n1,2\n"), "path.csv: line 3: 2 numbers, the header has 3");
  for (const char* cell : {"nan", "inf", "", "1e9", "0.1m", "0x1"})
    EXPECT_NE(problem_of(std::string("x,y,z\n1,2,") + cell + "\n"), "") << cell;
  EXPECT_EQ(problem_of("x,y,z,qw,qx,qy,qz\n0,0,1,1,0,0,1\n"),
            "path.csv: line 2: qw,qx,qy,qz is no unit quaternion");
}

TEST(WayPointsTest, AStraightLineHasEqualStepsAndEndsAtItsEnd) {
  const PoseTarget from{.p_RT = {0, 0, 0}}, to{.p_RT = {0.1, 0, 0}};
  const auto line = straight_line(from, to, 0.03);
  ASSERT_EQ(line.size(), 4U);
  for (std::size_t n = 0; n < 4; ++n)
    EXPECT_NEAR(line[n].p_RT.x(), 0.025 * static_cast<double>(n + 1), 1e-12);
  EXPECT_EQ(line.back().p_RT, to.p_RT);
  EXPECT_EQ(straight_line(to, to, 0.03).size(), 1U);
}

TEST(WayPointsTest, ALineTurnsInSmallStepsAlongTheShorterWay) {
  PoseTarget from, to;
  from.q_RT = Eigen::Quaterniond(Eigen::AngleAxisd(3, Eigen::Vector3d::UnitZ()));
  to.q_RT = Eigen::Quaterniond(Eigen::AngleAxisd(-3, Eigen::Vector3d::UnitZ()));
  const auto line = straight_line(from, to, 0.03);
  EXPECT_EQ(line.size(), 3U);  // 2π − 6 rad
  Eigen::Quaterniond before = *from.q_RT;
  for (const PoseTarget& step : line) {
    EXPECT_LE(before.angularDistance(*step.q_RT), 0.1 + 1e-9);
    before = *step.q_RT;
  }
  EXPECT_NEAR(before.angularDistance(*to.q_RT), 0, 1e-9);
}

// Two links of 1 m in a plane, turning by their commands.
TEST(WayPointsTest, AnArmThatTurnsOverLeavesTheLine) {
  BodySchema schema;
  schema.parts = {1, 2, 3};
  schema.root = 1;
  schema.signals = {{"a", -2, 2}, {"b", -2, 2}};
  for (const int joint : {0, 1}) {
    Edge& edge = schema.edges.emplace_back();
    edge.from = joint + 1;
    edge.to = joint + 2;
    edge.joints.push_back({.signal = joint, .turn = 1});
    edge.right.translation() = Eigen::Vector3d(1, 0, 0);
  }
  const auto position = [&](const Eigen::Vector2d& q) -> Eigen::Vector3d {
    return schema.predict(1, 3, q)->X_AB.translation();
  };
  const Eigen::Vector2d from(0.5, -1), to(0.52, -1.01), over(-0.49, 1.01);
  ASSERT_LT((position(to) - position(over)).norm(), 0.02);
  EXPECT_LT(leaves_line_by_m(schema, 3, from, to, position(to)), 1e-4);
  EXPECT_GT(leaves_line_by_m(schema, 3, from, over, position(over)), 0.1);
}

}  // namespace
}  // namespace bodyschema
