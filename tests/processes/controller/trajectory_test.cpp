#include "processes/controller/trajectory.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <utility>

namespace bodyschema {
namespace {

/// Two links of 1 m in a plane, turning by their commands.
BodySchema two_links() {
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
  return schema;
}

PoseTarget at(const BodySchema& schema, const Eigen::Vector2d& action) {
  return {.p_RT = schema.predict(1, 3, action)->X_AB.translation()};
}

const Trajectory::Limits kLimits{
    .position_sd_m = 0.01, .error_m = 0.005, .error_rad = 0.02, .off_line_m = 0.02};

std::string objection(const BodySchema& schema, const Eigen::Vector2d& from,
                      std::vector<PoseTarget> way_points, double step_m = 0.02) {
  return Trajectory(std::move(way_points), step_m).objection(schema, 3, from, kLimits);
}

TEST(TrajectoryTest, ALegHasEqualStepsAndEndsAtItsWayPoint) {
  const PoseTarget from{.p_RT = {0, 0, 0}}, to{.p_RT = {0.1, 0, 0}};
  const Trajectory trajectory({from, to, to}, 0.03);
  ASSERT_EQ(trajectory.num_way_points(), 3U);
  ASSERT_EQ(trajectory.leg(0).size(), 1U);
  EXPECT_EQ(trajectory.leg(0)[0].p_RT, from.p_RT);
  const auto& line = trajectory.leg(1);
  ASSERT_EQ(line.size(), 4U);
  for (std::size_t n = 0; n < 4; ++n)
    EXPECT_NEAR(line[n].p_RT.x(), 0.025 * static_cast<double>(n + 1), 1e-12);
  EXPECT_EQ(line.back().p_RT, to.p_RT);
  EXPECT_EQ(trajectory.leg(2).size(), 1U);
}

TEST(TrajectoryTest, ALegTurnsInSmallStepsAlongTheShorterWay) {
  PoseTarget from, to;
  from.q_RT = Eigen::Quaterniond(Eigen::AngleAxisd(3, Eigen::Vector3d::UnitZ()));
  to.q_RT = Eigen::Quaterniond(Eigen::AngleAxisd(-3, Eigen::Vector3d::UnitZ()));
  const Trajectory trajectory({from, to}, 0.03);
  EXPECT_EQ(trajectory.leg(1).size(), 3U);  // 2π − 6 rad
  Eigen::Quaterniond before = *from.q_RT;
  for (const PoseTarget& step : trajectory.leg(1)) {
    EXPECT_LE(before.angularDistance(*step.q_RT), 0.1 + 1e-9);
    before = *step.q_RT;
  }
  EXPECT_NEAR(before.angularDistance(*to.q_RT), 0, 1e-9);
}

TEST(TrajectoryTest, OfOneWayPointOrOfStepsWithoutEndEachLegIsOneStep) {
  const PoseTarget here{.p_RT = {0, 0, 0}}, there{.p_RT = {9, 0, 0}};
  const Trajectory one({here}, 0.02);
  EXPECT_EQ(one.num_way_points(), 1U);
  const Trajectory far({here, there}, std::numeric_limits<double>::infinity());
  ASSERT_EQ(far.leg(1).size(), 1U);
  EXPECT_EQ(far.leg(1)[0].p_RT, there.p_RT);
}

TEST(TrajectoryTest, WhatIsNoneIsRefused) {
  const PoseTarget here{.p_RT = {0, 0, 0}}, there{.p_RT = {500, 0, 0}};
  PoseTarget turned = here;
  turned.q_RT = Eigen::Quaterniond::Identity();
  using Points = std::vector<PoseTarget>;
  EXPECT_THROW(Trajectory(Points{}, 0.02), std::invalid_argument);
  EXPECT_THROW(Trajectory({here, here}, 0), std::invalid_argument);
  EXPECT_THROW(Trajectory({here, here}, std::nan("")), std::invalid_argument);
  EXPECT_THROW(Trajectory({here, turned}, 0.02), std::invalid_argument);
  EXPECT_THROW(Trajectory({here, there}, 0.02), std::invalid_argument) << "in millimetres";
  EXPECT_THROW(Trajectory({here, there}, 1e-300), std::invalid_argument);
}

TEST(TrajectoryTest, WhatIsWithinReachHasNoObjection) {
  const BodySchema schema = two_links();
  const Eigen::Vector2d from(0.5, -1);
  EXPECT_EQ(objection(schema, from, {at(schema, {0.4, -0.8}), at(schema, {0.3, -1.2})}), "");
}

TEST(TrajectoryTest, ALongLookCanBeEnded) {
  const BodySchema schema = two_links();
  const Eigen::Vector2d from(0.5, -1);
  const Trajectory trajectory(
      {at(schema, {0.4, -0.8}), at(schema, {0.3, -1.2}), at(schema, {0.4, -0.8})}, 0.02);
  std::vector<std::size_t> met;
  const auto note = [&](std::size_t n) { met.push_back(n); };
  EXPECT_EQ(trajectory.objection(schema, 3, from, kLimits, note), "");
  EXPECT_TRUE(std::is_sorted(met.begin(), met.end()));
  EXPECT_EQ(met.front(), 0U);
  EXPECT_EQ(met.back(), 2U);
  EXPECT_EQ(met.size(), 1 + trajectory.leg(1).size() + trajectory.leg(2).size());
  const auto end = [](std::size_t n) {
    if (n == 1) throw std::runtime_error("interrupted");
  };
  EXPECT_THROW(trajectory.objection(schema, 3, from, kLimits, end), std::runtime_error);
}

TEST(TrajectoryTest, WhatIsKeptOutIsNamedBeforehand) {
  const BodySchema schema = two_links();
  const Eigen::Vector2d from(0.5, -1), to(0.3, -1.2);
  const Trajectory trajectory({at(schema, {0.4, -0.8}), at(schema, to)}, 0.02);
  Trajectory::Limits limits = kLimits;
  const Eigen::Vector3d half(0.01, 0.01, 0.01), end = at(schema, to).p_RT;
  limits.workspace.keep_out = {Eigen::AlignedBox3d(end - half, end + half)};
  EXPECT_NE(trajectory.objection(schema, 3, from, limits).find("keep_out"), std::string::npos);
}

TEST(TrajectoryTest, ALegThatLeavesTheReachIsNamedThoughItsEndsAreWithin) {
  // The first link turns by ±2 rad only: what is straight behind the arm is out of reach.
  const BodySchema schema = two_links();
  const std::string why =
      objection(schema, {2, 0.3}, {at(schema, {2, 0.3}), at(schema, {-2, -0.3})}, 0.1);
  EXPECT_NE(why.find("the way to point 2 of 2"), std::string::npos) << why;
  EXPECT_NE(why.find("out of reach, no nearer than"), std::string::npos) << why;
}

// Along an arc about the root, the elbow to the right: the first link comes to its limit in the
// middle, and only with the elbow to the left it can go on.
TEST(TrajectoryTest, AnArmThatWouldHaveToTurnOverIsNamed) {
  BodySchema schema = two_links();
  const Eigen::Vector2d begin(0.1, -0.6);
  std::vector<PoseTarget> arc;
  for (const double turn : {0.0, 0.1, 0.2, 0.3, 0.4})
    arc.push_back(at(schema, begin + Eigen::Vector2d(turn, 0)));
  EXPECT_EQ(objection(schema, begin, arc), "");
  schema.signals[0].upper = 0.35;
  const std::string why = objection(schema, begin, arc);
  EXPECT_NE(why.find("the way to point 4 of 5"), std::string::npos) << why;
  // From where the elbow is to the left already, that leg is none to object to.
  const Trajectory trajectory(arc, 0.02);
  EXPECT_NE(trajectory.objection_to_leg(3, schema, 3, Eigen::Vector2d(0.3, -0.6), kLimits), "");
  EXPECT_EQ(trajectory.objection_to_leg(3, schema, 3, Eigen::Vector2d(-0.3, 0.6), kLimits), "");
  EXPECT_NE(why.find("turn over and leave the line by"), std::string::npos) << why;
}

TEST(TrajectoryTest, WhereThePartIsHardlyKnownIsNamed) {
  BodySchema schema = two_links();
  schema.edges[1].parameter_covariance =
      Eigen::MatrixXd::Identity(schema.edges[1].num_parameters(),
                                schema.edges[1].num_parameters()) *
      4e-4;
  const Eigen::Vector2d from(0.5, -1);
  const std::string why = objection(schema, from, {at(schema, {0.4, -0.8})});
  EXPECT_NE(why.find("mm only"), std::string::npos) << why;
}

}  // namespace
}  // namespace bodyschema
