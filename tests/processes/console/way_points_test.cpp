#include "processes/console/way_points.h"

#include <gtest/gtest.h>

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
  EXPECT_EQ(parse_way_points("\xEF\xBB\xBFx,y,z\n1,2,3\n", "").size(), 1U);
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

}  // namespace
}  // namespace bodyschema
