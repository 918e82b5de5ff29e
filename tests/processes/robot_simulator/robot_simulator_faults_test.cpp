// Class RobotSimulator: faults.

#include <gtest/gtest.h>

#include <algorithm>
#include <random>

#include "common/geometry/angle.h"
#include "tests/processes/robot_simulator/robot_simulator_bench.h"

namespace bodyschema::test {
namespace {

fault_command_t fault(std::int64_t id, std::int8_t kind, const std::string& place = "",
                      int number = -1, double amount_deg = 0) {
  fault_command_t result{};
  result.sender = "test";
  result.epoch = 1;
  result.fault_id = id;
  result.fault = kind;
  result.place = place;
  result.number = number;
  result.amount_deg = amount_deg;
  return result;
}
using Broken = fault_command_t;

Pose part_in_world(const sim_state_t& state, int part) {
  const auto at = std::find(state.true_part.begin(), state.true_part.end(), part);
  return from_message(state.X_WB.at(at - state.true_part.begin()));
}

/// Pose of a part in another's frame.
Pose relative(const sim_state_t& state, int from, int to) {
  return part_in_world(state, from).inverse() * part_in_world(state, to);
}

const std::vector<double> kSomewhere = {0.3, -10, 0.4, -0.2, 15, 0.5, 60};
const std::vector<double> kElsewhere = {-0.3, 10, 0.1, 0.2, -15, 0.1, 30};

TEST(RobotSimulator, AFaultBeginsARestOfItsOwn) {
  RobotSimulator simulator(config("arm7"));
  simulator.on_command(move_to(0, kSomewhere));
  const Status before = simulator.status();
  const auto answer = simulator.on_fault(fault(7, Broken::FAULT_BEND, "forearm", -1, 5));
  ASSERT_TRUE(answer.state.has_value());
  EXPECT_EQ(answer.state->fault_epoch, 1);
  EXPECT_EQ(answer.state->fault_id, 7);
  EXPECT_EQ(answer.state->fault_answer, "");
  EXPECT_EQ(answer.state->faults, std::vector<std::string>{"bend forearm 5 deg"});
  EXPECT_EQ(answer.state->action_id, 0);
  // The camera takes a few frames from the state's time on; earlier frames are older.
  EXPECT_GT(answer.state->utime, before.utime + 500'000);
  ASSERT_EQ(answer.statuses.size(), 1U);
  EXPECT_EQ(answer.statuses[0].state, Status::STATE_SETTLED);
  EXPECT_EQ(answer.statuses[0].action_id, 0);
  EXPECT_EQ(answer.statuses[0].utime, answer.state->utime);
  EXPECT_EQ(answer.statuses[0].rest_since_utime, answer.state->utime);
  // The command is repeated until it is acknowledged, and acts once.
  const auto again = simulator.on_fault(fault(7, Broken::FAULT_BEND, "forearm", -1, 5));
  EXPECT_TRUE(again.statuses.empty());
  EXPECT_EQ(bytes(again.state.value()), bytes(answer.state.value()));
}

TEST(RobotSimulator, SaysWhatThereIsWhereAFaultNamesNothing) {
  RobotSimulator simulator(config("arm2"));
  const sim_state_t before = simulator.state();
  const auto expect_refused = [&](const fault_command_t& command, const std::string& word) {
    const auto answer = simulator.on_fault(command);
    EXPECT_TRUE(answer.statuses.empty());
    ASSERT_TRUE(answer.state.has_value());
    EXPECT_EQ(answer.state->fault_id, command.fault_id);
    EXPECT_NE(answer.state->fault_answer.find(word), std::string::npos)
        << answer.state->fault_answer;
    EXPECT_EQ(answer.state->utime, before.utime);
    EXPECT_EQ(answer.state->num_faults, 0);
  };
  expect_refused(fault(0, Broken::FAULT_STUCK, "q9"), "there are q1, q2");
  expect_refused(fault(1, Broken::FAULT_BEND, "leg", -1, 5), "there are base, turret, arm");
  expect_refused(fault(2, Broken::FAULT_TOOL, "", 2), "there are 0 (block), 1 (block on a crooked");
  expect_refused(fault(3, Broken::FAULT_MARKER_LOST, "", 99), "no tag 99; there are 0, ");
  expect_refused(fault(4, Broken::FAULT_DRIFT, "", -1, 1), "no link ''");
}

TEST(RobotSimulator, DoesNotBreakWhereTheBrokenArmWouldTouchItself) {
  RobotSimulator simulator(config("arm2"));
  simulator.on_fault(fault(0, Broken::FAULT_BEND, "turret", -1, 90));
  const sim_state_t bent = simulator.state();
  ASSERT_EQ(bent.faults.at(0), "bend turret 90 deg");
  // Bends add up: folded back upon itself.
  const auto answer = simulator.on_fault(fault(1, Broken::FAULT_BEND, "turret", -1, 90));
  EXPECT_TRUE(answer.statuses.empty());
  EXPECT_NE(answer.state->fault_answer.find("collision"), std::string::npos)
      << answer.state->fault_answer;
  EXPECT_EQ(answer.state->faults, bent.faults);
  EXPECT_EQ(answer.state->utime, bent.utime);
}

TEST(RobotSimulator, AStuckSignalNoLongerMovesItsJoints) {
  RobotSimulator simulator(config("arm7"));
  simulator.on_command(move_to(0, kSomewhere));
  const Eigen::VectorXd before = simulator.joint_positions();
  simulator.on_fault(fault(0, Broken::FAULT_STUCK, "q7"));  // both fingers
  simulator.on_fault(fault(1, Broken::FAULT_STUCK, "q3"));
  for (int id = 1; id < 6; ++id) {
    simulator.on_command(move_to(id, id % 2 ? kElsewhere : kSomewhere));
    ASSERT_EQ(simulator.status().action_id, id);
    ASSERT_EQ(simulator.status().state, Status::STATE_SETTLED);
    EXPECT_EQ(simulator.status().commanded, id % 2 ? kElsewhere : kSomewhere);
  }
  const Eigen::VectorXd after = simulator.joint_positions();
  for (int i = 0; i < after.size(); ++i) {
    const bool is_stuck = i == 2 || i >= 6;
    EXPECT_EQ(after[i] == before[i], is_stuck) << "joint " << i;
  }
  simulator.on_fault(fault(2, Broken::FAULT_REPAIR));
  EXPECT_EQ(simulator.state().num_faults, 0);
  simulator.on_command(move_to(6, kElsewhere));
  EXPECT_NE(simulator.joint_positions()[2], before[2]);
}

TEST(RobotSimulator, ABentLinkMovesWhatIsBeyondItsMiddle) {
  RobotSimulator simulator(config("arm7"));
  simulator.on_command(move_to(0, kSomewhere));
  const sim_state_t before = simulator.state();
  // Part 5 sits on the elbow before the middle, part 6 on the forearm beyond the elbow's joint.
  simulator.on_fault(fault(0, Broken::FAULT_BEND, "elbow", -1, 8));
  const sim_state_t after = simulator.state();
  EXPECT_TRUE(relative(after, 1, 5).isApprox(relative(before, 1, 5), 1e-12));
  EXPECT_TRUE(relative(after, 6, 8).isApprox(relative(before, 6, 8), 1e-12));
  const Pose change = relative(before, 5, 6).inverse() * relative(after, 5, 6);
  EXPECT_NEAR(rotation_angle(change), 8 * kDegree, 1e-9);
  // It stays bent wherever the arm moves.
  RobotSimulator whole(config("arm7"));
  simulator.on_command(move_to(1, kElsewhere));
  whole.on_command(move_to(1, kElsewhere));
  const Pose moved = relative(whole.state(), 5, 6).inverse() * relative(simulator.state(), 5, 6);
  EXPECT_NEAR(rotation_angle(moved), 8 * kDegree, 1e-4);
}

TEST(RobotSimulator, ADriftBendsWithEveryActionAndSurvivesARestart) {
  const std::filesystem::path file = scratch_file("drift.yaml");
  RobotSimulator simulator(config("arm7"));
  simulator.on_fault(fault(0, Broken::FAULT_DRIFT, "base", -1, 0.25));
  const auto bent_deg = [&](const RobotSimulator& arm) {
    // Part 2 sits on the base beyond its middle, part 1 before it.
    const Pose straight = relative(RobotSimulator(config("arm7")).state(), 1, 2);
    return rotation_angle(straight.inverse() * relative(arm.state(), 1, 2)) / kDegree;
  };
  EXPECT_NEAR(bent_deg(simulator), 0, 1e-6);
  for (int id = 0; id < 4; ++id) {
    simulator.on_command(move_to(id, id % 2 ? kElsewhere : kSomewhere));
    EXPECT_NEAR(bent_deg(simulator), 0.25 * (id + 1), 1e-6);
  }
  // A refused action advances no drift.
  simulator.on_command(move_to(4, {9, 0, 0, 0, 0, 0, 40}));
  EXPECT_NEAR(bent_deg(simulator), 1, 1e-6);
  EXPECT_EQ(simulator.state().faults.at(0), "drift base 0.25 deg per action, 1 deg so far");
  simulator.save(file);
  RobotSimulator restarted(config("arm7"));
  restarted.restore(file);
  std::filesystem::remove(file);
  EXPECT_EQ(bytes(restarted.state()), bytes(simulator.state()));
  action_command_t next = move_to(5, kElsewhere);
  next.utime = simulator.status().utime;
  restarted.on_command(next);
  simulator.on_command(next);
  EXPECT_EQ(bytes(restarted.state()), bytes(simulator.state()));
  EXPECT_NEAR(bent_deg(restarted), 1.25, 1e-6);
}

TEST(RobotSimulator, AnExchangedToolDisplacesItsPartsAndShowsItsAdapter) {
  RobotSimulator simulator(config("arm7"));
  simulator.on_command(move_to(0, kSomewhere));
  const sim_state_t before = simulator.state();
  simulator.on_fault(fault(0, Broken::FAULT_TOOL, "", 1));
  const sim_state_t after = simulator.state();
  EXPECT_EQ(after.faults.at(0), "tool 1 (gripper on a crooked adapter)");
  ASSERT_EQ(after.num_geoms, before.num_geoms);
  // One rigid displacement of the tool, on the hand's side of the joint: R of the edge to part 8.
  EXPECT_TRUE(relative(after, 1, 7).isApprox(relative(before, 1, 7), 1e-12));
  EXPECT_GT((relative(after, 7, 8).translation() - relative(before, 7, 8).translation()).norm(),
            0.03);
  EXPECT_TRUE(relative(after, 8, 9).isApprox(relative(before, 8, 9), 1e-12));
  const auto num_visible = [](const sim_state_t& state) {
    return std::count(state.geom_alpha.begin(), state.geom_alpha.end(), 1.0F);
  };
  EXPECT_EQ(num_visible(after), num_visible(before) + 1);
  simulator.on_fault(fault(1, Broken::FAULT_TOOL, "", 0));
  EXPECT_EQ(simulator.state().num_faults, 0);
  EXPECT_TRUE(relative(simulator.state(), 7, 8).isApprox(relative(before, 7, 8), 1e-12));
}

TEST(RobotSimulator, MarkersFallAndShiftButPartsStayWhereTheyAre) {
  RobotSimulator simulator(config("arm7"));
  simulator.on_command(move_to(0, kSomewhere));
  const sim_state_t before = simulator.state();
  const int lost = simulator.scene().tag_geom(24), moved = simulator.scene().tag_geom(28);
  simulator.on_fault(fault(0, Broken::FAULT_MARKER_LOST, "", 24));
  simulator.on_fault(fault(1, Broken::FAULT_MARKER_MOVED, "", 28));
  const sim_state_t after = simulator.state();
  for (std::size_t i = 0; i < after.X_WB.size(); ++i) {
    EXPECT_TRUE(from_message(after.X_WB[i]).isApprox(from_message(before.X_WB[i]), 1e-12));
  }
  // Face up on the floor; it stays there when the arm moves.
  const Pose X_WG = from_message(after.X_WG[lost]);
  EXPECT_LT(X_WG.translation().z(), 0.01);
  EXPECT_NEAR(X_WG.linear()(2, 2), -1, 1e-12);
  const Pose X_WM = from_message(before.X_WG[moved]), X_WM2 = from_message(after.X_WG[moved]);
  EXPECT_NEAR((X_WM.inverse() * X_WM2.translation()).norm(), 0.25 * 0.076, 1e-9);
  EXPECT_NEAR(rotation_angle(X_WM.inverse() * X_WM2), 15 * kDegree, 1e-9);
  simulator.on_command(move_to(1, kElsewhere));
  EXPECT_TRUE(from_message(simulator.state().X_WG[lost]).isApprox(X_WG, 1e-12));
  simulator.on_fault(fault(2, Broken::FAULT_MARKER_MOVED, "", 24));
  EXPECT_EQ(simulator.state().fault_answer, "tag 24 has fallen off already");
}

TEST(RobotSimulator, ABumpedCameraIsElsewhereTheSameForASeed) {
  RobotSimulator one(config("arm7", 5)), other(config("arm7", 5)), third(config("arm7", 6));
  const Pose X_WC = from_message(one.state().X_WC);
  for (RobotSimulator* arm : {&one, &other, &third}) {
    arm->on_fault(fault(0, Broken::FAULT_CAMERA_BUMP));
  }
  const Pose bump = X_WC.inverse() * from_message(one.state().X_WC);
  EXPECT_GE(bump.translation().norm(), 0.02);
  EXPECT_LE(bump.translation().norm(), 0.03);
  EXPECT_GE(rotation_angle(bump), 1.5 * kDegree);
  EXPECT_LE(rotation_angle(bump), 2.5 * kDegree);
  EXPECT_EQ(bytes(one.state()), bytes(other.state()));
  EXPECT_FALSE(from_message(third.state().X_WC).isApprox(from_message(one.state().X_WC), 1e-6));
  one.on_fault(fault(1, Broken::FAULT_CAMERA_BUMP));
  EXPECT_FALSE(from_message(one.state().X_WC).isApprox(from_message(other.state().X_WC), 1e-6));
  one.on_fault(fault(2, Broken::FAULT_REPAIR));
  EXPECT_TRUE(from_message(one.state().X_WC).isApprox(X_WC, 1e-12));
}

TEST(RobotSimulator, ATargetTagIsPutElsewhereAndBackByRepair) {
  const TargetRig rig(kConfig / "arm2", "0.4, -0.2, 1.7");
  RobotSimulatorConfig configured =
      RobotSimulatorConfig::load(rig.folder() / "robot_simulator.yaml");
  configured.is_ideal = true;
  RobotSimulator simulator(configured);
  simulator.on_command(move_to(0, {0.3, 10}));
  const auto p_CM = [](const RobotSimulator& of) {
    const int geom = of.scene().tag_geom(40);
    const Pose X_WM =
        from_message(of.state().X_WG[geom]) * Eigen::Translation3d(0, 0, -kSheetThickness_m / 2);
    return Eigen::Vector3d(from_message(of.state().X_WC).inverse() * X_WM.translation());
  };
  EXPECT_LT((p_CM(simulator) - Eigen::Vector3d(0.4, -0.2, 1.7)).norm(), 1e-9);
  fault_command_t put = fault(0, Broken::FAULT_TARGET, "", 40);
  const Eigen::Vector3d there(-0.2, 0.1, 1.5);
  std::copy(there.begin(), there.end(), put.target_m);
  const sim_state_t before = simulator.state();
  const auto answer = simulator.on_fault(put);
  EXPECT_EQ(answer.state->faults.at(0), "target 40 at -0.2 0.1 1.5 m");
  EXPECT_EQ(answer.state->utime, before.utime + 1'000'000);
  EXPECT_EQ(answer.statuses.at(0).rest_since_utime, answer.state->utime);
  EXPECT_LT((p_CM(simulator) - there).norm(), 1e-9);
  EXPECT_EQ(part_in_world(simulator.state(), 5).matrix(), part_in_world(before, 5).matrix());
  // A bump of the camera leaves it where it is in the world.
  simulator.on_fault(fault(1, Broken::FAULT_CAMERA_BUMP));
  EXPECT_GT((p_CM(simulator) - there).norm(), 0.01);
  const std::filesystem::path file = scratch_file("target.yaml");
  simulator.save(file);
  RobotSimulator restarted(configured);
  restarted.restore(file);
  std::filesystem::remove(file);
  EXPECT_EQ(bytes(restarted.state()), bytes(simulator.state()));
  put.number = 41;
  put.fault_id = 2;
  EXPECT_EQ(simulator.on_fault(put).state->fault_answer,
            "no target tag 41; target_tags in robot.yaml: 40");
  simulator.on_fault(fault(3, Broken::FAULT_REPAIR));
  EXPECT_LT((p_CM(simulator) - Eigen::Vector3d(0.4, -0.2, 1.7)).norm(), 1e-9);
}

TEST(RobotSimulator, AllFaultsTogetherSurviveARestartBitByBit) {
  const std::filesystem::path file = scratch_file("faults.yaml");
  RobotSimulator lasting(config("arm7", 3));
  std::int64_t id = 0;
  lasting.on_fault(fault(id++, Broken::FAULT_TOOL, "", 1));
  lasting.on_command(move_to(0, kSomewhere));
  lasting.on_fault(fault(id++, Broken::FAULT_STUCK, "q5"));
  lasting.on_fault(fault(id++, Broken::FAULT_BEND, "upper_arm", -1, -4));
  lasting.on_fault(fault(id++, Broken::FAULT_MARKER_LOST, "", 16));
  lasting.on_fault(fault(id++, Broken::FAULT_MARKER_MOVED, "", 20));
  lasting.on_fault(fault(id++, Broken::FAULT_CAMERA_BUMP));
  lasting.on_fault(fault(id++, Broken::FAULT_DRIFT, "wrist", -1, 0.1));
  lasting.on_fault(fault(id++, Broken::FAULT_STUCK, "nothing"));
  lasting.on_command(move_to(1, kElsewhere));
  ASSERT_EQ(lasting.state().num_faults, 7);
  lasting.save(file);
  RobotSimulator restarted(config("arm7", 1));
  restarted.restore(file);
  std::filesystem::remove(file);
  EXPECT_EQ(bytes(restarted.state()), bytes(lasting.state()));
  EXPECT_EQ(bytes(restarted.status()), bytes(lasting.status()));
  // Known already.
  EXPECT_TRUE(
      restarted.on_fault(fault(2, Broken::FAULT_BEND, "upper_arm", -1, -4)).statuses.empty());
  action_command_t next = move_to(2, kSomewhere);
  next.utime = lasting.status().utime;
  lasting.on_command(next);
  restarted.on_command(next);
  EXPECT_EQ(restarted.state().action_id, 2);
  EXPECT_EQ(bytes(restarted.state()), bytes(lasting.state()));
}

TEST(RobotSimulator, RefusesMotionsThatOnlyTheBentArmCannotMake) {
  RobotSimulator whole(config("arm2")), bent(config("arm2"));
  bent.on_fault(fault(0, Broken::FAULT_BEND, "turret", -1, 90));
  bent.on_fault(fault(1, Broken::FAULT_BEND, "turret", -1, 25));
  ASSERT_EQ(bent.state().fault_answer, "");
  std::mt19937_64 engine(4);
  int only_bent = 0;
  for (int id = 0; id < 30; ++id) {
    std::vector<double> action;
    for (const Signal& signal : whole.scene().signals().signals) {
      action.push_back(std::uniform_real_distribution<double>(signal.lower, signal.upper)(engine));
    }
    const bool whole_can = whole.on_command(move_to(id, action)).state.has_value();
    const bool bent_can = bent.on_command(move_to(id, action)).state.has_value();
    if (!whole_can || bent_can) continue;
    ++only_bent;
    EXPECT_EQ(bent.status().state, Status::STATE_SETTLED);  // it stays where it was
  }
  EXPECT_GT(only_bent, 0);
}

}  // namespace
}  // namespace bodyschema::test
