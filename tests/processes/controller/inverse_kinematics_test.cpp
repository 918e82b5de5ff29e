#include "processes/controller/inverse_kinematics.h"

#include <gtest/gtest.h>

#include <random>

#include "common/geometry/angle.h"
#include "common/schema/standard_deviations.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Rng;

const InverseKinematicsOptions kOptions{
    .tolerance_m = 1e-4, .damping_m = 0.05, .max_iterations = 100, .max_starts = 20};

BodySchema seven_joints(std::uint64_t seed) {
  Rng rng(seed);
  return test::true_schema(test::chapter_robot("d", rng));
}

Eigen::VectorXd random_action(const BodySchema& schema, Rng& rng) {
  Eigen::VectorXd action(schema.signals.size());
  for (std::size_t i = 0; i < schema.signals.size(); ++i)
    action[i] = test::uniform(rng, schema.signals[i].lower, schema.signals[i].upper);
  return action;
}

Eigen::Vector3d position(const BodySchema& schema, int part, const Eigen::VectorXd& action) {
  return schema.predict(schema.root, part, action)->X_AB.translation();
}

void expect_within_limits(const BodySchema& schema, const Eigen::VectorXd& action) {
  ASSERT_EQ(action.size(), static_cast<Eigen::Index>(schema.signals.size()));
  for (Eigen::Index i = 0; i < action.size(); ++i) {
    const Signal& signal = schema.signals[i];
    ASSERT_TRUE(std::isfinite(action[i]));
    EXPECT_GE(action[i], signal.lower);
    EXPECT_LE(action[i], signal.upper);
  }
}

/// Two links of 1 m and 0.5 m in a plane, both turning ±90°: part 3 reaches from the root's origin
/// sqrt(1.25) to 1.5 m.
BodySchema planar() {
  BodySchema schema;
  schema.parts = {1, 2, 3};
  schema.root = 1;
  schema.signals = {{"a", -90, 90}, {"b", -1, 1}};
  Edge upper, fore;
  upper.from = 1;
  upper.to = fore.from = 2;
  fore.to = 3;
  upper.joints.push_back({.signal = 0, .turn = kDegree});
  upper.right.translation() = Eigen::Vector3d(1, 0, 0);
  fore.joints.push_back({.signal = 1, .turn = M_PI / 2});
  fore.right.translation() = Eigen::Vector3d(0.5, 0, 0);
  schema.edges = {upper, fore};
  return schema;
}

TEST(InverseKinematicsTest, NoRoundingLeadsBeyondALimit) {
  for (const auto& [lower, upper] : {std::pair(-3.0718, -0.0698), std::pair(-0.9, 0.2)}) {
    ASSERT_GT(lower + (upper - lower), upper);
    BodySchema schema = planar();
    schema.signals[1] = {"b", lower, upper};
    // Where b is beyond its upper limit, and a at rest.
    const PoseTarget target{position(schema, 3, Eigen::Vector2d(0, upper + 0.05)), std::nullopt};
    schema.signals[0] = {"a", 0, 0};
    const auto solution =
        solve_pose(schema, 3, target, schema.signals, Eigen::Vector2d(0, upper - 0.2), kOptions);
    EXPECT_NEAR(solution.action[1], upper, 1e-12);
    expect_within_limits(schema, solution.action);
  }
}

TEST(InverseKinematicsTest, ItsJacobianIsTheDerivativeInTheRootsFrame) {
  Rng rng(1);
  for (int i = 0; i < 50; ++i) {
    const BodySchema schema = seven_joints(i % 5);
    const Eigen::VectorXd action = random_action(schema, rng);
    for (const int part : schema.parts) {
      const auto path = KinematicPath::between(schema, schema.root, part);
      const Eigen::MatrixXd J = pose_jacobian(*path, action);
      for (Eigen::Index s = 0; s < action.size(); ++s) {
        const double h = 1e-6 * (schema.signals[s].upper - schema.signals[s].lower);
        Eigen::VectorXd more = action, less = action;
        more[s] += h;
        less[s] -= h;
        const Pose X_more = schema.predict(schema.root, part, more)->X_AB;
        const Pose X_less = schema.predict(schema.root, part, less)->X_AB;
        const Eigen::AngleAxisd turn(X_more.linear() * X_less.linear().transpose());
        Vector6d numeric;
        numeric << X_more.translation() - X_less.translation(), turn.angle() * turn.axis();
        numeric /= 2 * h;
        EXPECT_LT((J.col(s) - numeric).norm(), 1e-6 * std::max(1.0, numeric.norm()));
      }
    }
  }
}

TEST(InverseKinematicsTest, EveryPositionOfForwardKinematicsIsFoundFromElsewhere) {
  Rng rng(2);
  for (int i = 0; i < 200; ++i) {
    const BodySchema schema = seven_joints(i % 10);
    const int part = schema.parts[3 + rng() % (schema.parts.size() - 3)];
    const Eigen::Vector3d p_RT = position(schema, part, random_action(schema, rng));
    const auto solution = solve_pose(schema, part, {.p_RT = p_RT}, schema.signals,
                                     random_action(schema, rng), kOptions);
    EXPECT_TRUE(solution.is_within_tolerance) << i << ": " << solution.error_m;
    expect_within_limits(schema, solution.action);
    EXPECT_NEAR((position(schema, part, solution.action) - p_RT).norm(), solution.error_m, 1e-9);
    EXPECT_LE(solution.error_m, kOptions.tolerance_m);
  }
}

TEST(InverseKinematicsTest, EveryPositionIsFoundAlongOneEdgeOfAllJointsToo) {
  Rng rng(3);
  for (int i = 0; i < 100; ++i) {
    Rng geometry(i % 10);
    const test::SyntheticRobot robot = test::chapter_robot("d", geometry);
    BodySchema schema = test::true_schema(robot);
    schema.parts = {1, 8};
    schema.edges = {robot.true_edge(1, 8)};
    ASSERT_EQ(schema.edges[0].joints.size(), 6U);
    const Eigen::Vector3d p_RT = position(schema, 8, random_action(schema, rng));
    const auto solution =
        solve_pose(schema, 8, {.p_RT = p_RT}, schema.signals, random_action(schema, rng), kOptions);
    EXPECT_TRUE(solution.is_within_tolerance) << i << ": " << solution.error_m;
    expect_within_limits(schema, solution.action);
    EXPECT_LT((position(schema, 8, solution.action) - p_RT).norm(), kOptions.tolerance_m);
  }
}

PoseTarget pose(const BodySchema& schema, int part, const Eigen::VectorXd& action) {
  const Pose X_RB = schema.predict(schema.root, part, action)->X_AB;
  return {X_RB.translation(), Eigen::Quaterniond(X_RB.linear())};
}

TEST(InverseKinematicsTest, PosesOfForwardKinematicsAreFoundFromElsewhere) {
  InverseKinematicsOptions options = kOptions;
  options.max_starts = 100;
  Rng rng(4);
  constexpr int kTargets = 200;
  int num_found = 0;
  for (int i = 0; i < kTargets; ++i) {
    const BodySchema schema = seven_joints(i % 10);
    const int part = schema.parts[3 + rng() % (schema.parts.size() - 3)];
    const PoseTarget target = pose(schema, part, random_action(schema, rng));
    const auto solution =
        solve_pose(schema, part, target, schema.signals, random_action(schema, rng), options);
    expect_within_limits(schema, solution.action);
    const PoseTarget reached = pose(schema, part, solution.action);
    EXPECT_NEAR((reached.p_RT - target.p_RT).norm(), solution.error_m, 1e-9);
    EXPECT_NEAR(reached.q_RT->angularDistance(*target.q_RT), solution.error_rad, 1e-7);
    if (!solution.is_within_tolerance) continue;
    ++num_found;
    EXPECT_LE(solution.error_m, options.tolerance_m);
    EXPECT_LE(solution.error_rad, options.tolerance_rad);
  }
  EXPECT_GE(num_found, 0.99 * kTargets);
}

/// Joint a puts the end anywhere on a circle, and turns it as much: an orientation that does not
/// belong to the position is met half-way, as far as a radian weighs.
TEST(InverseKinematicsTest, WhereAPoseIsOutOfReachPositionAndRotationAreTradedByTheirWeight) {
  BodySchema schema = planar();
  schema.parts = {1, 2};
  schema.edges.pop_back();
  const PoseTarget target{{1, 0, 0},
                          Eigen::Quaterniond(Eigen::AngleAxisd(0.1, Eigen::Vector3d::UnitZ()))};
  for (const double weight : {0.01, 1.0, 100.0}) {
    InverseKinematicsOptions options = kOptions;
    options.metres_per_radian = weight;
    const auto solution =
        solve_pose(schema, 2, target, schema.signals, Eigen::Vector2d(20, 0), options);
    EXPECT_FALSE(solution.is_within_tolerance);
    // min (2 sin φ/2)² + w² (0.1 − φ)²; 2 sin φ/2 is φ to 0.04 %.
    const double phi = 0.1 * weight * weight / (1 + weight * weight);
    EXPECT_NEAR(solution.action[0] * kDegree, phi, 1e-3 * 0.1);
  }
}

TEST(InverseKinematicsTest, NoOrientationIsAskedOfAPartOfWhichPositionsAloneAreKnown) {
  BodySchema schema = planar();
  schema.position_parts = {3};
  const PoseTarget target = pose(schema, 3, Eigen::Vector2d(10, 0.2));
  const Eigen::Vector2d current(0, 0);
  EXPECT_THROW(solve_pose(schema, 3, target, schema.signals, current, kOptions),
               std::invalid_argument);
  EXPECT_TRUE(solve_pose(schema, 3, {.p_RT = target.p_RT}, schema.signals, current, kOptions)
                  .is_within_tolerance);
}

TEST(InverseKinematicsTest, AtTheTargetNothingMoves) {
  const BodySchema schema = seven_joints(3);
  Rng rng(3);
  const Eigen::VectorXd action = random_action(schema, rng);
  const auto solution = solve_pose(schema, 10, {.p_RT = position(schema, 10, action)},
                                   schema.signals, action, kOptions);
  EXPECT_LT((solution.action - action).norm(), 1e-9);
  EXPECT_TRUE(solution.is_within_tolerance);
}

TEST(InverseKinematicsTest, SignalsThatDoNotMoveThePartStayWhereTheyAre) {
  const BodySchema schema = planar();
  const Eigen::Vector2d current(10, 0.3);
  const Eigen::Vector3d p_RT(std::cos(0.5), std::sin(0.5), 0);
  const auto solution = solve_pose(schema, 2, {.p_RT = p_RT}, schema.signals, current, kOptions);
  EXPECT_TRUE(solution.is_within_tolerance);
  EXPECT_NEAR(solution.action[1], 0.3, 1e-15);
  EXPECT_NEAR(solution.action[0], 0.5 / kDegree, 0.01);
}

TEST(InverseKinematicsTest, OutOfReachTheNearestApproachIsTold) {
  const BodySchema schema = planar();
  // Beyond the stretched arm, a singularity; before the folded one, a limit; beside the plane.
  const struct {
    Eigen::Vector3d p_RT;
    double error_m;
  } cases[] = {{{2, 0, 0}, 0.5},
               {{1.9, 0.3, 0}, std::hypot(1.9, 0.3) - 1.5},
               {{0.5, 0, 0}, std::sqrt(1.25) - 0.5},
               {{1.5, 0, 0.2}, 0.2},
               {{0, 0, 0}, std::sqrt(1.25)}};
  Rng rng(4);
  for (const auto& c : cases) {
    for (int i = 0; i < 10; ++i) {
      const auto solution = solve_pose(schema, 3, {.p_RT = c.p_RT}, schema.signals,
                                       random_action(schema, rng), kOptions);
      EXPECT_FALSE(solution.is_within_tolerance);
      EXPECT_NEAR(solution.error_m, c.error_m, 1e-3) << c.p_RT.transpose();
      expect_within_limits(schema, solution.action);
    }
  }
}

// Behind the arm it comes as near to the left as to the right, but for this much.
TEST(InverseKinematicsTest, OutOfReachNearerByLessThanTheToleranceIsNoReasonToGoElsewhere) {
  BodySchema schema = planar();
  schema.edges[1].joints[0].turn = M_PI;
  for (const double side : {-1, 1}) {
    for (const double nearer_m : {1e-5, 1e-3}) {
      const PoseTarget target{.p_RT = Eigen::Vector3d(-3, -side * nearer_m, 0)};
      const auto solution = solve_pose(schema, 3, target, schema.signals,
                                       Eigen::Vector2d(80 * side, 0.5 * side), kOptions);
      const bool stays = nearer_m < kOptions.tolerance_m;
      EXPECT_NEAR(solution.action[0], stays ? 90 * side : -90 * side, 1e-6) << nearer_m;
    }
  }
}

TEST(InverseKinematicsTest, TheStretchedArmLeavesItsSingularity) {
  const BodySchema schema = planar();
  for (const double reach : {1.5, 1.4999, 1.3, 1.2}) {
    const auto solution = solve_pose(schema, 3, {.p_RT = Eigen::Vector3d(reach, 0, 0)},
                                     schema.signals, Eigen::Vector2d(0, 0), kOptions);
    EXPECT_TRUE(solution.is_within_tolerance) << reach << ": " << solution.error_m;
    expect_within_limits(schema, solution.action);
  }
}

TEST(InverseKinematicsTest, NothingIsEverNotANumber) {
  Rng rng(5);
  for (int i = 0; i < 100; ++i) {
    BodySchema schema = seven_joints(i % 10);
    // Stuck signals, a limit without a range to speak of, a current action beyond the limits.
    for (Edge& edge : schema.edges)
      for (ScrewJoint& joint : edge.joints)
        if (rng() % 3 == 0) joint.gain = 0;
    std::vector<Signal> limits = schema.signals;
    limits[rng() % limits.size()].upper = limits[0].lower + 1e-9;
    limits[0].upper = limits[0].lower + 1e-9;
    for (Signal& limit : limits) limit.upper = std::max(limit.upper, limit.lower + 1e-9);
    const Eigen::VectorXd beyond = 100 * random_action(schema, rng);
    const Eigen::Vector3d p_RT(test::uniform(rng, -900, 900), test::uniform(rng, -1, 1), 0);
    const auto solution = solve_pose(schema, 10, {.p_RT = p_RT}, limits, beyond, kOptions);
    schema.signals = limits;
    expect_within_limits(schema, solution.action);
    EXPECT_TRUE(std::isfinite(solution.error_m));
  }
}

TEST(InverseKinematicsTest, OtherSolutionsDifferFromThoseAvoided) {
  const BodySchema schema = seven_joints(6);
  Rng rng(6);
  const Eigen::VectorXd current = random_action(schema, rng);
  const Eigen::Vector3d p_RT = position(schema, 10, random_action(schema, rng));
  std::vector<Eigen::VectorXd> avoided;
  for (int i = 0; i < 5; ++i) {
    const auto solution =
        solve_pose(schema, 10, {.p_RT = p_RT}, schema.signals, current, kOptions, avoided);
    ASSERT_TRUE(solution.is_within_tolerance) << i;
    for (const Eigen::VectorXd& other : avoided) {
      double farthest = 0;
      for (Eigen::Index s = 0; s < current.size(); ++s)
        farthest = std::max(farthest, std::abs(solution.action[s] - other[s]) /
                                          (schema.signals[s].upper - schema.signals[s].lower));
      EXPECT_GE(farthest, 0.1);
    }
    avoided.push_back(solution.action);
  }
}

TEST(InverseKinematicsTest, TheSameQuestionGetsTheSameAnswer) {
  const BodySchema schema = seven_joints(7);
  Rng rng(7);
  const Eigen::VectorXd current = random_action(schema, rng);
  const auto ask = [&] {
    return solve_pose(schema, 10, {.p_RT = {5, 5, 5}}, schema.signals, current, kOptions).action;
  };
  EXPECT_EQ(ask(), ask());
}

TEST(InverseKinematicsTest, APartWithoutAWayToTheRootIsRefused) {
  BodySchema schema = planar();
  schema.edges.pop_back();
  EXPECT_FALSE(chain_to(schema, 3));
  EXPECT_TRUE(chain_to(schema, 2));
  EXPECT_TRUE(chain_to(schema, 1));
  EXPECT_THROW(
      solve_pose(schema, 3, {.p_RT = {1, 0, 0}}, schema.signals, Eigen::Vector2d(0, 0), kOptions),
      std::invalid_argument);
  EXPECT_THROW(solve_pose(schema, 2, {.p_RT = {1, 0, 0}}, schema.signals, Eigen::Vector3d(0, 0, 0),
                          kOptions),
               std::invalid_argument);
}

// A redundant arm: where a solution is near a limit, the null space leads away from it.
TEST(PostureTest, ASolutionLeavesRoomToTheLimitsAndStaysOne) {
  const BodySchema schema = seven_joints(3);
  InverseKinematicsOptions as_found = kOptions;
  as_found.posture_steps = 0;
  Rng rng(1);
  double sum_found = 0, sum_settled = 0;
  for (int n = 0; n < 200; ++n) {
    const Eigen::VectorXd current = random_action(schema, rng);
    const PoseTarget target{.p_RT = position(schema, 8, random_action(schema, rng))};
    const auto found = solve_pose(schema, 8, target, schema.signals, current, as_found);
    const auto settled = solve_pose(schema, 8, target, schema.signals, current, kOptions);
    ASSERT_TRUE(found.is_within_tolerance);
    ASSERT_TRUE(settled.is_within_tolerance);
    expect_within_limits(schema, settled.action);
    const auto cost = [&](const Eigen::VectorXd& action) {
      return posture_cost(schema, 8, false, schema.signals, action, kOptions);
    };
    EXPECT_LE(cost(settled.action), cost(found.action) + 1e-9);
    if (cost(found.action) == 0) EXPECT_EQ(settled.action, found.action);
    sum_found += cost(found.action);
    sum_settled += cost(settled.action);
  }
  EXPECT_GT(sum_found, 20);
  EXPECT_LT(sum_settled, 0.1 * sum_found);
}

TEST(PostureTest, ASolutionKeepsToWhatSamplesCovered) {
  BodySchema schema = seven_joints(3), middle = schema;
  const std::vector<Signal>& limits = schema.signals;
  for (std::size_t i = 0; i < limits.size(); ++i) {  // half of each range
    const double quarter = (limits[i].upper - limits[i].lower) / 4;
    middle.signals[i].lower += quarter;
    middle.signals[i].upper -= quarter;
    schema.signals[i].covered = {middle.signals[i].lower, middle.signals[i].upper};
  }
  Rng rng(2);
  int num_inside = 0;
  for (int n = 0; n < 100; ++n) {
    const PoseTarget target{.p_RT = position(schema, 8, random_action(middle, rng))};
    Eigen::VectorXd current(limits.size());
    for (std::size_t i = 0; i < limits.size(); ++i)
      current[i] = test::uniform(rng, limits[i].lower, limits[i].upper);
    const auto solution = solve_pose(schema, 8, target, limits, current, kOptions);
    ASSERT_TRUE(solution.is_within_tolerance);
    bool is_inside = true;
    for (std::size_t i = 0; i < limits.size(); ++i)
      is_inside &= solution.action[i] >= middle.signals[i].lower &&
                   solution.action[i] <= middle.signals[i].upper;
    num_inside += is_inside;
  }
  EXPECT_GE(num_inside, 90);
}

TEST(PostureTest, OneThatDoesNotMoveThePartStaysWhereItIs) {
  const BodySchema schema = seven_joints(3);
  Rng rng(3);
  Eigen::VectorXd current = random_action(schema, rng);
  const PoseTarget target{.p_RT = position(schema, 5, random_action(schema, rng))};
  current.tail<2>() << schema.signals[5].upper, schema.signals[6].lower;
  const auto solution = solve_pose(schema, 5, target, schema.signals, current, kOptions);
  EXPECT_TRUE(solution.is_within_tolerance);
  EXPECT_EQ(solution.action.tail<2>(), current.tail<2>());
}

TEST(PostureTest, ASingularOneCosts) {
  const BodySchema schema = planar();
  const auto cost = [&](double b) {
    return posture_cost(schema, 3, false, schema.signals, Eigen::Vector2d(0, b), kOptions);
  };
  EXPECT_EQ(cost(0.5), 0);
  EXPECT_NEAR(cost(0), 1, 1e-9);  // stretched out
  EXPECT_GT(cost(0.02), 0);
  EXPECT_GT(cost(0.98), 0);  // at its limit
}

// The gain of the second joint is hardly known: far from its zero the part may be anywhere.
TEST(PostureTest, ASolutionAvoidsWhereThePartIsHardlyKnown) {
  const BodySchema sure = seven_joints(3);
  BodySchema schema = sure;
  Edge& edge = schema.edges[1];
  const Eigen::Index turn = 7;
  edge.parameter_covariance.setZero(edge.num_parameters(), edge.num_parameters());
  edge.parameter_covariance(turn, turn) = std::pow(0.3 * edge.joints[0].turn, 2);
  const auto sd_m = [&](const Eigen::VectorXd& action) {
    return deviations_of(schema.predict(1, 8, action)->covariance).position_m;
  };
  Rng rng(4);
  double sum_sure = 0, sum = 0;
  for (int n = 0; n < 100; ++n) {
    const Eigen::VectorXd current = random_action(schema, rng);
    const PoseTarget target{.p_RT = position(schema, 8, random_action(schema, rng))};
    const auto solution = solve_pose(schema, 8, target, schema.signals, current, kOptions);
    ASSERT_TRUE(solution.is_within_tolerance);
    sum += sd_m(solution.action);
    sum_sure += sd_m(solve_pose(sure, 8, target, sure.signals, current, kOptions).action);
  }
  EXPECT_GT(sum_sure / 100, 2 * kOptions.uncertain_m);
  EXPECT_LT(sum, 0.7 * sum_sure);
}

}  // namespace
}  // namespace bodyschema
