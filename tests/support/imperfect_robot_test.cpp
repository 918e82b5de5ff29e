#include "tests/support/imperfect_robot.h"

#include <gtest/gtest.h>

#include <cmath>

#include "common/geometry/angle.h"

namespace bodyschema::test {
namespace {

constexpr int kNumSamples = 300;

Imperfection with(double Imperfection::*member, double value) {
  Imperfection imperfection;
  imperfection.*member = value;
  return imperfection;
}

/// Angle of the one joint of a chain, from its two true poses; up to a constant.
double true_angle(const ImperfectRobot& robot, const Eigen::Isometry3d& X_at_zero) {
  const Eigen::Isometry3d X = robot.poses()[0].inverse() * robot.poses()[1];
  return Eigen::AngleAxisd((X_at_zero.inverse() * X).linear()).angle();
}

struct Spread {
  double position_m = 0, rotation_rad = 0;  ///< rms per axis of all seen against true poses
};
Spread spread_of(const Imperfection& imperfection) {
  ImperfectRobot robot(4, true, imperfection, 1);
  Spread spread;
  int count = 0;
  for (int n = 0; n < kNumSamples; ++n) {
    for (const PartObservation& o : robot.go(robot.random_action()).parts) {
      const Eigen::Isometry3d X =
          robot.poses()[static_cast<std::size_t>(o.part) - 1].inverse() * o.X_CB;
      spread.position_m += X.translation().squaredNorm() / 3;
      spread.rotation_rad += std::pow(Eigen::AngleAxisd(X.linear()).angle(), 2) / 3;
      ++count;
    }
  }
  return {std::sqrt(spread.position_m / count), std::sqrt(spread.rotation_rad / count)};
}

TEST(ImperfectRobotTest, APerfectOneIsSeenWithItsNoise) {
  const Spread spread = spread_of({});
  // The tag sits 3 cm from the part's origin: its rotation noise is a lever.
  EXPECT_NEAR(spread.position_m, std::hypot(0.003, 0.03 * kDegree * std::sqrt(2. / 3)), 1e-4);
  EXPECT_NEAR(spread.rotation_rad, 1 * kDegree, 0.05 * kDegree);
}

TEST(ImperfectRobotTest, CorrelatedNoiseIsAsLargeAtFirstAsLater) {
  double squares = 0;
  constexpr int kNumRobots = 100, kNumParts = 3;
  for (int seed = 0; seed < kNumRobots; ++seed) {
    ImperfectRobot robot(kNumParts - 1, true, with(&Imperfection::correlation, 0.9),
                         static_cast<std::uint64_t>(seed));
    const ActionPoseSample sample = robot.go(robot.random_action());
    for (int n = 0; n < kNumParts; ++n) {
      const Eigen::Isometry3d X = robot.poses()[n].inverse() * sample.parts.at(n).X_CB;
      squares += std::pow(Eigen::AngleAxisd(X.linear()).angle(), 2) / 3;
    }
  }
  EXPECT_NEAR(std::sqrt(squares / (kNumRobots * kNumParts)), 1 * kDegree, 0.1 * kDegree);
}

TEST(ImperfectRobotTest, ASeedIsARobot) {
  ImperfectRobot a(5, false, {}, 7), b(5, false, {}, 7), c(5, false, {}, 8);
  const auto at_a = a.babble(3), at_b = b.babble(3), at_c = c.babble(3);
  EXPECT_EQ(at_a[2].action, at_b[2].action);
  EXPECT_EQ(at_a[2].parts[4].X_CB.matrix(), at_b[2].parts[4].X_CB.matrix());
  EXPECT_NE(at_a[2].action, at_c[2].action);
  EXPECT_EQ(at_a[2].parts.size(), 6U);
  EXPECT_EQ(a.signals().size(), 5U);
}

TEST(ImperfectRobotTest, PlayIsLostWhereTheJointTurnsBack) {
  ImperfectRobot robot(1, true, with(&Imperfection::backlash_deg, 2.0), 1);
  const auto go = [&](double degrees) {
    robot.go(Eigen::VectorXd::Constant(1, degrees * kDegree));
  };
  go(10);
  const Eigen::Isometry3d X = robot.poses()[0].inverse() * robot.poses()[1];
  go(8.5);
  EXPECT_NEAR(true_angle(robot, X) / kDegree, 0, 1e-9);
  go(5);
  EXPECT_NEAR(true_angle(robot, X) / kDegree, 3, 1e-9);
}

TEST(ImperfectRobotTest, CommandsAreRoundedToSteps) {
  ImperfectRobot robot(1, true, with(&Imperfection::command_step_deg, 5.0), 1);
  const auto go = [&](double degrees) {
    robot.go(Eigen::VectorXd::Constant(1, degrees * kDegree));
  };
  go(9);
  const Eigen::Isometry3d X = robot.poses()[0].inverse() * robot.poses()[1];
  go(12.4);
  EXPECT_NEAR(true_angle(robot, X) / kDegree, 0, 1e-9);
  go(12.6);
  EXPECT_NEAR(true_angle(robot, X) / kDegree, 5, 1e-9);
}

TEST(ImperfectRobotTest, GravityTurnsNoJointFartherThanItsDroop) {
  ImperfectRobot firm(1, true, {}, 3), soft(1, true, with(&Imperfection::droop_deg, 2.0), 3);
  double most = 0;
  for (int n = -90; n <= 90; n += 5) {
    const Eigen::VectorXd action = Eigen::VectorXd::Constant(1, n * kDegree);
    firm.go(action);
    soft.go(action);
    const double angle =
        Eigen::AngleAxisd((firm.poses()[1].inverse() * soft.poses()[1]).linear()).angle() / kDegree;
    EXPECT_LE(angle, 2);
    most = std::max(most, angle);
  }
  EXPECT_GT(most, 0.1);
}

TEST(ImperfectRobotTest, ABiasIsOfTheSizeThatItSays) {
  Imperfection biased;
  biased.view_bias_m = 0.01;
  biased.view_bias_deg = 3;
  double position2 = 0, rotation2 = 0;
  for (int seed = 1; seed <= 20; ++seed) {
    ImperfectRobot robot(4, true, biased, static_cast<std::uint64_t>(seed));
    int count = 0;
    Spread sum;
    for (int n = 0; n < 50; ++n)
      for (const PartObservation& o : robot.go(robot.random_action()).parts) {
        const Eigen::Isometry3d X =
            robot.poses()[static_cast<std::size_t>(o.part) - 1].inverse() * o.X_CB;
        sum.position_m += X.translation().squaredNorm() / 3;
        sum.rotation_rad += std::pow(Eigen::AngleAxisd(X.linear()).angle(), 2) / 3;
        ++count;
      }
    position2 += sum.position_m / count / 20;
    rotation2 += sum.rotation_rad / count / 20;
  }
  EXPECT_NEAR(std::sqrt(rotation2) / kDegree, std::hypot(3, 1), 0.5);
  EXPECT_GT(std::sqrt(position2), 0.009);
  EXPECT_LT(std::sqrt(position2), 0.013);
}

TEST(ImperfectRobotTest, CorrelatedNoiseIsNoLargerAndStaysLonger) {
  EXPECT_NEAR(spread_of(with(&Imperfection::correlation, 0.9)).rotation_rad / kDegree, 1, 0.15);
  ImperfectRobot robot(1, true, with(&Imperfection::correlation, 0.9), 1);
  double product = 0, square = 0, last = 0;
  for (int n = 0; n < 3000; ++n) {
    const auto sample = robot.go(Eigen::VectorXd::Zero(1));
    const double now = (robot.poses()[0].inverse() * sample.parts[0].X_CB).linear()(0, 1);
    product += now * last;
    square += now * now;
    last = now;
  }
  EXPECT_NEAR(product / square, 0.9, 0.05);
}

TEST(ImperfectRobotTest, WhatIsRareOrMissingIsSoByItsShare) {
  ImperfectRobot blind(3, true, with(&Imperfection::missing_share, 0.3), 1);
  std::size_t num_seen = 0;
  for (const ActionPoseSample& sample : blind.babble(kNumSamples)) num_seen += sample.parts.size();
  EXPECT_NEAR(static_cast<double>(num_seen) / (4 * kNumSamples), 0.7, 0.05);
  for (const auto member : {&Imperfection::flip_share, &Imperfection::outlier_share}) {
    ImperfectRobot robot(3, true, with(member, 0.2), 1);
    int num_off = 0;
    for (int n = 0; n < kNumSamples; ++n)
      for (const PartObservation& o : robot.go(robot.random_action()).parts) {
        const auto& X_CB = robot.poses()[static_cast<std::size_t>(o.part) - 1];
        num_off += Eigen::AngleAxisd((X_CB.inverse() * o.X_CB).linear()).angle() > 8 * kDegree;
      }
    EXPECT_NEAR(num_off / (4.0 * kNumSamples), 0.2, 0.05);
  }
  const Spread heavy = spread_of(with(&Imperfection::student_nu, 3));
  EXPECT_GT(heavy.rotation_rad / kDegree, 0.6);
  EXPECT_LT(heavy.rotation_rad / kDegree, 2);
}

TEST(ImperfectRobotTest, ABentLinkMovesItsPartAndWhatItCarriesInTheParentAlone) {
  ImperfectRobot robot(3, true, {}, 1);
  const Eigen::VectorXd action = robot.random_action();
  robot.go(action);
  const auto before = robot.poses();
  robot.bend(3, 0.03, 20 * kDegree);
  robot.go(action);
  const auto& after = robot.poses();
  EXPECT_TRUE(after[1].isApprox(before[1]));
  const Eigen::Isometry3d step = before[2].inverse() * after[2];
  EXPECT_NEAR(step.translation().norm(), 0.03, 1e-12);
  EXPECT_NEAR(Eigen::AngleAxisd(step.linear()).angle(), 20 * kDegree, 1e-12);
  EXPECT_TRUE((after[2].inverse() * after[3]).isApprox(before[2].inverse() * before[3]));
}

TEST(ImperfectRobotTest, MiscalibrationMovesWhatIsSeenByWhatItSays) {
  Imperfection off;
  off.focal_length = 0.02;
  // 2 m away: 4 cm nearer.
  EXPECT_NEAR(spread_of(off).position_m, 2 * 0.02 / std::sqrt(3), 0.006);
  EXPECT_GT(spread_of(with(&Imperfection::tag_size, 0.01)).position_m, 0.006);
  EXPECT_GT(spread_of(with(&Imperfection::distortion, 0.5)).position_m, 0.0035);
  Imperfection misplaced;
  misplaced.placement_m = 0.01;
  misplaced.placement_deg = 3;
  EXPECT_GT(spread_of(misplaced).rotation_rad / kDegree, 1.8);
}

TEST(ImperfectRobotTest, ARangeIsThatOfEveryJoint) {
  const ImperfectRobot robot(7, false, with(&Imperfection::range_deg, 30.0), 1);
  for (const Signal& signal : robot.signals())
    EXPECT_NEAR(signal.upper - signal.lower, 30 * kDegree, 1e-12);
}

TEST(ImperfectRobotTest, EveryRowOfTheTableHasANameAndIsAnImperfection) {
  const auto& all = imperfections();
  EXPECT_EQ(all.front().name, "none");
  for (std::size_t a = 1; a < all.size(); ++a) {
    for (std::size_t b = 0; b < a; ++b) EXPECT_NE(all[a].name, all[b].name);
    // The arm goes elsewhere, or its observation differs.
    ImperfectRobot robot(3, true, all[a], 1), perfect(3, true, {}, 1);
    bool is_other = false;
    for (int n = 0; n < 20; ++n) {
      const Eigen::VectorXd action = perfect.random_action();
      const auto seen = robot.go(action).parts, seen_perfect = perfect.go(action).parts;
      is_other |= !robot.poses()[3].isApprox(perfect.poses()[3], 1e-9) ||
                  seen.size() != seen_perfect.size() ||
                  !seen[0].X_CB.isApprox(seen_perfect[0].X_CB, 1e-9);
    }
    ImperfectRobot wanderer(3, true, all[a], 1), other(3, true, {}, 1);
    is_other |= wanderer.wander(2, 10)[0].action != other.wander(2, 10)[0].action;
    const Signal is = robot.signals()[0], was = perfect.signals()[0];
    EXPECT_TRUE(is_other || is.upper != was.upper) << all[a].name;
  }
}

}  // namespace
}  // namespace bodyschema::test
