#include "processes/console/engineered_model.h"

#include <gtest/gtest.h>

#include <fstream>
#include <string>

#include "common/config/yaml.h"
#include "common/geometry/angle.h"
#include "tests/support/temporary_folder.h"

namespace bodyschema {
namespace {

// base -fixed- column -j1 (revolute, tilted axis)- arm -j2 (prismatic)- slide
//                                            arm -j3 (mimics j1)- wing
const char* const kRobot = R"(<robot name="test">
  <link name="base"/><link name="column"/><link name="arm"/><link name="slide"/><link name="wing"/>
  <joint name="j0" type="fixed"><parent link="base"/><child link="column"/>
    <origin xyz="0.1 0.2 0.3" rpy="0.1 0.2 0.3"/></joint>
  <joint name="j1" type="revolute"><parent link="column"/><child link="arm"/>
    <origin xyz="0 0 0.4" rpy="0.5 0 0"/><axis xyz="1 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="j2" type="prismatic"><parent link="arm"/><child link="slide"/>
    <origin xyz="0.3 0 0" rpy="0 0 0.7"/><axis xyz="0 -1 0"/>
    <limit lower="0" upper="0.2" effort="1" velocity="1"/></joint>
  <joint name="j3" type="continuous"><parent link="arm"/><child link="wing"/>
    <origin xyz="0 0.1 0" rpy="0 0 0"/><axis xyz="0 1 0"/>
    <mimic joint="j1" multiplier="-2" offset="0.25"/></joint>
</robot>)";

const char* const kPlacement = R"(root: 3
uncertainty: {position_m: 0.002, rotation_deg: 0.5}
signals:
  - {name: a, joint: j1, gain: 0.5, offset: 0.1, lower: -2, upper: 2}
  - {name: b, joint: j2, gain: -0.01, offset: 0.05, lower: 0, upper: 10}
parts:
  - {part: 1, link: base, X_LB: {position_m: [0.01, 0, 0]}}
  - {part: 3, link: arm, X_LB: {position_m: [0, 0.02, 0], rpy_deg: [0, 90, 0]}}
  - {part: 4, link: arm, X_LB: {position_m: [0, 0, 0.03]}}
  - {part: 6, link: slide, X_LB: {position_m: [0.05, 0, 0], rpy_deg: [10, 0, 0]}}
  - {part: 9, link: wing, X_LB: {position_m: [0, 0, 0]}}
)";

Pose translation(double x, double y, double z) {
  Pose X = Pose::Identity();
  X.translation() << x, y, z;
  return X;
}

Pose turn(double angle, const Eigen::Vector3d& axis) {
  Pose X = Pose::Identity();
  X.linear() = Eigen::AngleAxisd(angle, axis.normalized()).matrix();
  return X;
}

Pose rpy(double r, double p, double y) {
  return turn(y, {0, 0, 1}) * turn(p, {0, 1, 0}) * turn(r, {1, 0, 0});
}

class EngineeredModelTest : public testing::Test {
 protected:
  BodySchema model(const std::string& urdf, const std::string& placement) const {
    std::ofstream(folder_ / "robot.urdf") << urdf;
    std::ofstream(folder_ / "placement.yaml") << placement;
    return engineered_model(folder_ / "robot.urdf", folder_ / "placement.yaml");
  }
  void expect_error(const std::string& urdf, const std::string& placement,
                    const std::string& what) const {
    try {
      model(urdf, placement);
      FAIL() << "no error, expected: " << what;
    } catch (const std::runtime_error& error) {
      EXPECT_NE(std::string(error.what()).find(what), std::string::npos) << error.what();
    }
  }

  test::TemporaryFolder folder_;
};

std::string replaced(std::string text, const std::string& from, const std::string& to) {
  return text.replace(text.find(from), from.size(), to);
}

TEST_F(EngineeredModelTest, PartsMoveAsTheLinksThatCarryThem) {
  const BodySchema schema = model(kRobot, kPlacement);
  EXPECT_TRUE(schema.complete);
  EXPECT_EQ(schema.root, 3);
  EXPECT_EQ(schema.parts, (std::vector<int>{1, 3, 4, 6, 9}));
  ASSERT_EQ(schema.edges.size(), 4U);
  for (const Eigen::Vector2d& q :
       {Eigen::Vector2d(0, 0), Eigen::Vector2d(1.3, 7), Eigen::Vector2d(-2, 3)}) {
    const double j1 = 0.5 * q[0] + 0.1, j2 = -0.01 * q[1] + 0.05, j3 = -2 * j1 + 0.25;
    const Pose X_base_arm = translation(0.1, 0.2, 0.3) * rpy(0.1, 0.2, 0.3) *
                            translation(0, 0, 0.4) * rpy(0.5, 0, 0) * turn(j1, {1, 0, 1});
    const Pose X_arm_slide = translation(0.3, 0, 0) * rpy(0, 0, 0.7) * translation(0, -j2, 0);
    const Pose X_arm_wing = translation(0, 0.1, 0) * turn(j3, {0, 1, 0});
    const Pose X_arm_3 = translation(0, 0.02, 0) * rpy(0, M_PI / 2, 0);
    const std::map<int, Pose> expected = {
        {3, Pose::Identity()},
        {1, X_arm_3.inverse() * X_base_arm.inverse() * translation(0.01, 0, 0)},
        {4, X_arm_3.inverse() * translation(0, 0, 0.03)},
        {6, X_arm_3.inverse() * X_arm_slide * translation(0.05, 0, 0) * rpy(M_PI / 18, 0, 0)},
        {9, X_arm_3.inverse() * X_arm_wing}};
    const auto predicted = schema.predict_all(q);
    ASSERT_EQ(predicted.size(), expected.size());
    for (const auto& [part, X] : expected)
      EXPECT_LT(log(predicted.at(part).inverse() * X).norm(), 1e-12) << "part " << part;
  }
}

TEST_F(EngineeredModelTest, AJointWithoutASignalStandsAtZeroAndItsFollowerAtItsOffset) {
  const std::string placement = replaced(
      kPlacement, "  - {name: a, joint: j1, gain: 0.5, offset: 0.1, lower: -2, upper: 2}\n", "");
  const BodySchema schema = model(kRobot, placement);
  EXPECT_EQ(schema.signals.size(), 1U);
  const Pose X_arm_3 = translation(0, 0.02, 0) * rpy(0, M_PI / 2, 0);
  const Pose expected = X_arm_3.inverse() * translation(0, 0.1, 0) * turn(0.25, {0, 1, 0});
  const auto predicted = schema.predict_all(Eigen::VectorXd::Zero(1));
  EXPECT_LT(log(predicted.at(9).inverse() * expected).norm(), 1e-12);
}

TEST_F(EngineeredModelTest, ASignalWithoutAJointKeepsItsPlaceAndMovesNothing) {
  const BodySchema schema = model(
      kRobot,
      replaced(kPlacement, "  - {name: b", "  - {name: idle, lower: 0, upper: 1}\n  - {name: b"));
  ASSERT_EQ(schema.signals.size(), 3U);
  EXPECT_EQ(schema.signals[1].name, "idle");
  EXPECT_EQ(schema.unused_signals(), std::vector<int>{1});
  expect_error(kRobot, replaced(kPlacement, "joint: j2, ", ""), "gain");
}

TEST_F(EngineeredModelTest, EdgesAreAsUncertainAsThePlacementSays) {
  const BodySchema schema = model(kRobot, kPlacement);
  for (const Edge& edge : schema.edges) {
    const Matrix6d covariance = edge.prediction_covariance(Eigen::Vector2d(0.3, 2));
    EXPECT_NEAR(covariance(5, 5), std::pow(0.5 * kDegree, 2), 1e-12);
    EXPECT_NEAR(covariance(0, 0), 4e-6, 1e-12);
  }
}

TEST_F(EngineeredModelTest, WhatIsWrongIsSaid) {
  expect_error("<robot>", kPlacement, "robot.urdf: expected a URDF");
  expect_error(replaced(kRobot, "</robot>",
                        "<joint name=\"loop\" type=\"fixed\"><parent link=\"slide\"/><child "
                        "link=\"wing\"/></joint></robot>"),
               kPlacement, "link wing is the child of two joints");
  expect_error(kRobot, replaced(kPlacement, "joint: j2", "joint: j3"),
               "joint j3 mimics j1 in the URDF");
  expect_error(kRobot, replaced(kPlacement, "joint: j2", "joint: j7"), "the URDF has no joint j7");
  expect_error(kRobot, replaced(kPlacement, "joint: j2", "joint: j1"), "has a signal already");
  expect_error(kRobot, replaced(kPlacement, "name: b", "name: a"), "another signal is called a");
  expect_error(kRobot, replaced(kPlacement, "joint: j2", "joint: j0"), "j0 is fixed");
  expect_error(kRobot, replaced(kPlacement, "link: slide", "link: sledge"), "no link sledge");
  expect_error(kRobot, replaced(kPlacement, "root: 3", "root: 2"), "expected one of the parts");
  expect_error(kRobot, replaced(kPlacement, "part: 4", "part: 3"), "part 3 stands twice");
  expect_error(kRobot, replaced(kPlacement, "gain: 0.5", "gain: 0"), "gain");
  expect_error(replaced(kRobot, "type=\"prismatic\"", "type=\"planar\""), kPlacement,
               "joint j2: expected revolute");
}

}  // namespace
}  // namespace bodyschema
