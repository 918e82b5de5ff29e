// The controller and the monitor together, on an arm that bends while a path is followed.

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <string>

#include "common/geometry/angle.h"
#include "tests/support/steered_arm.h"

namespace bodyschema::test {
namespace {

constexpr int kEndEffector = 5;

struct Course {
  double worst_late_m = 0;  ///< from the fourth target on
  double worst_early_m = 0;
  int num_probes = 0, num_reached = 0;
};

/// Targets that the bent arm reaches: where small swings about its middle bring it.
Course follow(bool adapts) {
  Rng rng(5);
  SyntheticRobot robot = chapter_robot("c", rng);
  SteeredArm arm(robot, true_schema(robot), std::string(BODYSCHEMA_CONFIG) + "/arm4",
                 {.regime = Regime::kTag, .adapts = adapts, .seed = 5});
  Vector6d bend = Vector6d::Zero();
  bend.tail<3>() = 45 * kDegree * robot.links[2].X_after.translation().unitOrthogonal();
  robot.links[2].X_after = exp(bend) * robot.links[2].X_after;
  arm.set_robot(robot);
  Course course;
  for (int n = 0; n < 12; ++n) {
    Eigen::VectorXd action(4);
    for (int s = 0; s < 4; ++s) action[s] = 0.5 * std::sin(0.6 * n + s);
    const auto X_CB = robot.poses_in_camera(action);
    const Eigen::Vector3d p_RT = (X_CB.at(1).inverse() * X_CB.at(kEndEffector)).translation();
    const auto [status, error_m] = arm.go_to(kEndEffector, p_RT);
    course.num_reached += status.control_state == control_status_t::CONTROL_REACHED;
    course.num_probes += status.num_probes;
    double& worst_m = n < 3 ? course.worst_early_m : course.worst_late_m;
    worst_m = std::max(worst_m, error_m);
  }
  return course;
}

TEST(SteeringTest, AnArmWhoseMiddleLinkIsBentIsSteeredByItsAdaptedSchema) {
  const Course fixed = follow(false), adapted = follow(true);
  EXPECT_GT(fixed.worst_late_m, 0.05);
  EXPECT_EQ(adapted.num_reached, 12);
  EXPECT_LT(adapted.worst_late_m, 0.003);
  EXPECT_LE(adapted.num_probes, 6);
}

}  // namespace
}  // namespace bodyschema::test
