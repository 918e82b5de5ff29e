// Class RobotSimulator: what it does with a command, and with its state after a restart.

#include <gtest/gtest.h>

#include <cmath>
#include <fstream>
#include <limits>
#include <random>

#include "common/config/yaml.h"
#include "common/geometry/angle.h"
#include "tests/processes/robot_simulator/robot_simulator_bench.h"
#include "tests/support/text_of.h"

namespace bodyschema::test {
namespace {

TEST(RobotSimulator, IsIdleAtTheStartPoseBeforeTheFirstCommand) {
  const RobotSimulator simulator(config("arm2"));
  EXPECT_EQ(simulator.status().state, Status::STATE_IDLE);
  EXPECT_EQ(simulator.status().utime, 1'000'000);
  EXPECT_EQ(simulator.status().action_id, -1);
  EXPECT_EQ(simulator.status().source, "");
  EXPECT_EQ(simulator.status().rest_since_utime, 1'000'000);
  EXPECT_EQ(simulator.state().utime, 1'000'000);
  EXPECT_EQ(simulator.state().action_id, -1);
}

TEST(RobotSimulator, AnswersAMoveWithItsWholeLife) {
  RobotSimulator simulator(config("arm2"));
  action_command_t order = move_to(3, {0.5, -30});
  order.purpose = action_command_t::PURPOSE_TEST;
  const auto answer = simulator.on_command(order);
  ASSERT_EQ(answer.statuses.size(), 3U);
  EXPECT_EQ(answer.statuses[0].state, Status::STATE_ACCEPTED);
  EXPECT_EQ(answer.statuses[1].state, Status::STATE_MOVING);
  EXPECT_EQ(answer.statuses[1].rest_since_utime, -1);
  const Status& settled = answer.statuses[2];
  EXPECT_EQ(settled.state, Status::STATE_SETTLED);
  EXPECT_EQ(settled.commanded, order.action);
  EXPECT_EQ(settled.purpose, order.purpose);
  EXPECT_EQ(settled.source, "test");
  EXPECT_GT(settled.utime, answer.statuses[0].utime);
  EXPECT_LE(settled.rest_since_utime, settled.utime);
  EXPECT_GT(settled.rest_since_utime, answer.statuses[0].utime);
  ASSERT_TRUE(answer.state.has_value());
  EXPECT_EQ(answer.state->action_id, 3);
  EXPECT_EQ(answer.state->utime, settled.utime);
}

class EveryRig : public testing::TestWithParam<const char*> {};

INSTANTIATE_TEST_SUITE_P(RobotSimulator, EveryRig,
                         testing::Values("arm2", "arm4", "arm6_ends", "arm7"),
                         [](const auto& info) { return std::string(info.param); });

TEST_P(EveryRig, SettlesAtGainTimesCommandPlusOffsetAndDoesNotSag) {
  RobotSimulator simulator(config(GetParam()));
  const auto& signals = simulator.scene().signals().signals;
  std::mt19937_64 engine(3);
  int accepted = 0;
  for (int id = 0; id < 20; ++id) {
    std::vector<double> action;
    for (const Signal& signal : signals) {
      action.push_back(std::uniform_real_distribution<double>(signal.lower, signal.upper)(engine));
    }
    const auto answer = simulator.on_command(move_to(id, action));
    if (!answer.state) continue;
    ++accepted;
    const Eigen::VectorXd target = simulator.scene().robot().joint_positions(
        Eigen::Map<const Eigen::VectorXd>(action.data(), action.size()));
    EXPECT_LT((simulator.joint_positions() - target).cwiseAbs().maxCoeff(), 1e-3);
    // It takes as long as a robot would.
    EXPECT_LT(answer.statuses[2].utime - answer.statuses[0].utime, 4'000'000);
  }
  EXPECT_GE(accepted, 10);
}

TEST(RobotSimulator, RefusesAMotionThatWouldTouchItself) {
  RobotSimulator simulator(config("arm7"));
  simulator.on_command(move_to(0, {0.1, 5, 0, 0.1, 3, 0, 50}));
  // The fingers press against each other.
  expect_rejected(simulator, move_to(1, {0.1, 5, 0, 0.1, 3, 0, 0}),
                  "self-collision between link finger_left and link finger_right");
  // It still carries out other actions.
  EXPECT_TRUE(simulator.on_command(move_to(2, {0, 0, 0, 0, 0, 0, 40})).state.has_value());
}

TEST(RobotSimulator, RefusesWhatIsNoAction) {
  RobotSimulator simulator(config("arm2"));
  expect_rejected(simulator, move_to(0, {0.5}), "2 signals");
  expect_rejected(simulator, move_to(1, {0.5, 1, 2}), "2 signals");
  expect_rejected(simulator, move_to(2, {0.5, 61}), "outside its limits");
  expect_rejected(simulator, move_to(3, {-1.001, 0}), "outside its limits");
  expect_rejected(simulator, move_to(4, {std::nan(""), 0}), "finite");
  expect_rejected(simulator, move_to(5, {0, std::numeric_limits<double>::infinity()}), "finite");
}

TEST(RobotSimulator, LetsACommandExpire) {
  RobotSimulator simulator(config("arm2"));
  simulator.on_command(move_to(0, {0.5, 20}));
  action_command_t late = move_to(1, {0, 0});
  late.expiry_utime = simulator.status().utime - 1;
  const auto answer = simulator.on_command(late);
  ASSERT_EQ(answer.statuses.size(), 1U);
  EXPECT_EQ(answer.statuses[0].state, Status::STATE_EXPIRED);
  EXPECT_FALSE(answer.state.has_value());
  action_command_t in_time = move_to(2, {0, 0});
  in_time.expiry_utime = simulator.status().utime;
  EXPECT_TRUE(simulator.on_command(in_time).state.has_value());
}

TEST(RobotSimulator, StaysStoppedUntilResume) {
  RobotSimulator simulator(config("arm2"));
  const auto stopped = simulator.on_command(command(action_command_t::KIND_STOP, 0));
  ASSERT_EQ(stopped.statuses.size(), 1U);
  EXPECT_EQ(stopped.statuses[0].state, Status::STATE_STOPPED);
  EXPECT_EQ(stopped.statuses[0].stop_latched, 1);
  expect_rejected(simulator, move_to(1, {0.5, 0}), "resume");
  EXPECT_EQ(simulator.status().stop_latched, 1);
  const auto held = simulator.on_command(command(action_command_t::KIND_HOLD, 2));
  EXPECT_EQ(held.statuses.at(0).state, Status::STATE_HOLDING);
  EXPECT_EQ(held.statuses.at(0).stop_latched, 1);
  const auto resumed = simulator.on_command(command(action_command_t::KIND_RESUME, 3));
  EXPECT_EQ(resumed.statuses.at(0).stop_latched, 0);
  EXPECT_TRUE(simulator.on_command(move_to(4, {0.5, 0})).state.has_value());
}

TEST(RobotSimulator, AnswersACommandThatIsSentAgainWithoutMoving) {
  RobotSimulator simulator(config("arm2"));
  const auto first = simulator.on_command(move_to(0, {0.5, 20}));
  const auto refused = simulator.on_command(move_to(1, {99, 20}));
  const auto again = simulator.on_command(move_to(0, {0.5, 20}));
  ASSERT_EQ(again.statuses.size(), 1U);
  EXPECT_EQ(bytes(again.statuses[0]), bytes(first.statuses.back()));
  EXPECT_FALSE(again.state.has_value());
  EXPECT_EQ(bytes(simulator.on_command(move_to(1, {99, 20})).statuses.at(0)),
            bytes(refused.statuses.at(0)));

  // SETTLED would say that the arm is where it no longer is; time does not run backwards.
  simulator.on_command(move_to(2, {-0.5, 20}));
  const Eigen::VectorXd positions = simulator.joint_positions();
  const auto later = simulator.on_command(move_to(0, {0.5, 20}));
  ASSERT_EQ(later.statuses.size(), 1U);
  EXPECT_EQ(later.statuses[0].state, Status::STATE_STOPPED);
  EXPECT_NE(later.statuses[0].reason, "");
  EXPECT_EQ(later.statuses[0].utime, simulator.status().utime);
  EXPECT_EQ(later.statuses[0].rest_since_utime, simulator.status().rest_since_utime);
  EXPECT_FALSE(later.state.has_value());
  EXPECT_EQ(simulator.joint_positions(), positions);
  EXPECT_EQ(simulator.status().action_id, 2);
  // Another epoch of the same source counts anew.
  action_command_t restarted = move_to(0, {0.2, 10});
  restarted.epoch = 2;
  EXPECT_TRUE(simulator.on_command(restarted).state.has_value());
}

TEST(RobotSimulator, RepeatsWhatTheArmDoesNotWhatItRefused) {
  RobotSimulator simulator(config("arm2"));
  simulator.on_command(move_to(0, {0.5, 20}));
  simulator.on_command(move_to(1, {99, 20}));
  EXPECT_EQ(simulator.status().action_id, 0);
  EXPECT_EQ(simulator.status().state, Status::STATE_SETTLED);
}

TEST(RobotSimulator, ServesTwoSourcesWithTheSameIds) {
  RobotSimulator simulator(config("arm2"));
  action_command_t other = move_to(0, {-0.5, -20});
  other.source = "other";
  EXPECT_TRUE(simulator.on_command(move_to(0, {0.5, 20})).state.has_value());
  EXPECT_TRUE(simulator.on_command(other).state.has_value());
  EXPECT_TRUE(simulator.on_command(move_to(1, {0.2, 20})).state.has_value());
  EXPECT_FALSE(simulator.on_command(other).state.has_value());
}

TEST(RobotSimulator, HoldsWhereItIsAndSaysWhere) {
  RobotSimulator simulator(config("arm2"));
  simulator.on_command(move_to(0, {0.5, 20}));
  const Status settled = simulator.status();
  const auto held = simulator.on_command(command(action_command_t::KIND_HOLD, 1));
  ASSERT_EQ(held.statuses.size(), 1U);
  EXPECT_EQ(held.statuses[0].state, Status::STATE_HOLDING);
  EXPECT_EQ(held.statuses[0].commanded, settled.commanded);
  EXPECT_EQ(held.statuses[0].rest_since_utime, settled.rest_since_utime);
}

TEST(RobotSimulator, DoesTheSameBitByBitForTheSameCommands) {
  RobotSimulator one(config("arm7", 42));
  RobotSimulator other(config("arm7", 42));
  std::mt19937_64 engine(9);
  for (int id = 0; id < 5; ++id) {
    std::vector<double> action;
    for (const Signal& signal : one.scene().signals().signals) {
      action.push_back(std::uniform_real_distribution<double>(signal.lower, signal.upper)(engine));
    }
    one.on_command(move_to(id, action));
    other.on_command(move_to(id, action));
    EXPECT_EQ(bytes(one.state()), bytes(other.state()));
    EXPECT_EQ(bytes(one.status()), bytes(other.status()));
  }
  EXPECT_EQ(one.state().seed, 42);
}

TEST(RobotSimulator, ContinuesFromItsSavedStateAsIfNothingHadHappened) {
  const std::filesystem::path file = scratch_file("state.yaml");
  RobotSimulator lasting(config("arm7", 42));
  lasting.on_command(move_to(0, {0.3, -10, 0.4, -0.2, 15, 0.5, 60}));
  lasting.on_command(move_to(1, {9, 0, 0, 0, 0, 0, 40}));
  lasting.on_command(command(action_command_t::KIND_STOP, 2));
  lasting.save(file);

  RobotSimulator restarted(config("arm7", 1));
  restarted.restore(file);
  std::filesystem::remove(file);
  EXPECT_EQ(bytes(restarted.state()), bytes(lasting.state()));
  EXPECT_EQ(bytes(restarted.status()), bytes(lasting.status()));
  action_command_t next = move_to(4, {-0.3, 10, 0.1, 0.2, -15, 0.1, 30});
  next.utime = lasting.status().utime;
  for (const action_command_t& order :
       {move_to(0, {0.3, -10, 0.4, -0.2, 15, 0.5, 60}), move_to(1, {9, 0, 0, 0, 0, 0, 40}),
        move_to(3, {0, 0, 0, 0, 0, 0, 40}), command(action_command_t::KIND_STOP, 2),
        command(action_command_t::KIND_RESUME, 5), next}) {
    const auto expected = lasting.on_command(order);
    const auto answer = restarted.on_command(order);
    ASSERT_EQ(answer.statuses.size(), expected.statuses.size());
    if (order.action_id != 3) {
      EXPECT_EQ(bytes(answer.statuses.back()), bytes(expected.statuses.back())) << order.action_id;
    }
    EXPECT_EQ(bytes(restarted.state()), bytes(lasting.state()));
  }
  EXPECT_EQ(restarted.state().action_id, 4);
}

TEST(RobotSimulator, ContinuesWithItsCalibrationErrorsAndItsPlay) {
  const std::filesystem::path file = scratch_file("honest_state.yaml");
  RobotSimulator lasting(honest("arm7", 42));
  lasting.on_command(move_to(0, {0.3, -10, 0.4, -0.2, 15, 0.5, 60}));
  lasting.save(file);
  RobotSimulator restarted(config("arm7", 1));
  restarted.restore(file);
  std::filesystem::remove(file);
  EXPECT_EQ(bytes(restarted.state()), bytes(lasting.state()));
  // Within the play of the first joint: its position in the play depends on the previous motion.
  action_command_t next = move_to(1, {0.3001, -10, 0.1, 0.2, -15, 0.1, 30});
  next.utime = lasting.status().utime;
  lasting.on_command(next);
  restarted.on_command(next);
  EXPECT_EQ(bytes(restarted.state()), bytes(lasting.state()));
}

/// Angle between the visible and the true pose of the last part [deg].
double seen_beside_truth_deg(const RobotSimulator& simulator) {
  const sim_state_t& state = simulator.state();
  const TagPlacement& tag = simulator.scene().markers().tags.back();
  const Pose X_WM = from_message(state.X_WG[simulator.scene().tag_geom(tag.id)]);
  const Pose X_WB = X_WM * Eigen::Translation3d(0, 0, -kSheetThickness_m / 2) * tag.X_BM->inverse();
  return rotation_angle(X_WB.inverse() * from_message(state.X_WB.back())) / kDegree;
}

TEST(RobotSimulator, AJointStandsInItsBacklashWhereItCameFromAndTheTruthIsItsMiddle) {
  RobotSimulator simulator(honest("arm2"));
  EXPECT_LT(seen_beside_truth_deg(simulator), 1e-6);
  const auto turret = [&](double command) {
    static int id = 0;
    EXPECT_TRUE(simulator.on_command(move_to(id++, {command, 0})).state.has_value());
    const int plate = simulator.scene().tag_geom(simulator.scene().markers().tags[7].id);
    return from_message(simulator.state().X_WG[plate]);
  };
  ASSERT_EQ(simulator.scene().markers().find(simulator.scene().markers().tags[7].id)->part, 3);
  turret(-0.5);
  const Pose from_below = turret(0);
  const auto middle = from_message(simulator.state().X_WB[2]);
  turret(0.5);
  const Pose from_above = turret(0);
  // The servo is at rest within 0.01°.
  EXPECT_NEAR(rotation_angle(from_below.inverse() * from_above) / kDegree, 0.2, 0.01);
  EXPECT_LT(rotation_angle(middle.inverse() * from_message(simulator.state().X_WB[2])) / kDegree,
            0.01);
  // Once more the same: nothing moves.
  const Pose again = turret(0);
  EXPECT_LT(rotation_angle(again.inverse() * from_above) / kDegree, 0.01);
}

TEST(RobotSimulator, DroopsWhereGravityPulls) {
  RobotSimulator simulator(honest("arm2"));
  RobotSimulator ideal(config("arm2"));
  for (RobotSimulator* one : {&simulator, &ideal}) one->on_command(move_to(0, {0.5, 50}));
  const Eigen::VectorXd droop = simulator.joint_positions() - ideal.joint_positions();
  // j1 is upright, j2 level.
  EXPECT_LT(std::abs(droop[0]), 1e-6);
  EXPECT_GT(std::abs(droop[1]), 0.005 * kDegree);
  EXPECT_LT(std::abs(droop[1]), 0.5 * kDegree);
  EXPECT_LT(simulator.state().X_WB[4].position_m[2], ideal.state().X_WB[4].position_m[2]);
}

TEST(RobotSimulator, DoesNotCarryOutWhatWasSentBeforeItsRestart) {
  const std::filesystem::path file = scratch_file("guard.yaml");
  RobotSimulator first(config("arm2"));
  first.on_command(move_to(0, {0.5, 20}));
  first.save(file);
  RobotSimulator restarted(config("arm2"));
  restarted.restore(file);
  std::filesystem::remove(file);
  const auto answer = restarted.on_command(move_to(1, {0.1, 1}));
  ASSERT_EQ(answer.statuses.size(), 1U);
  EXPECT_EQ(answer.statuses[0].state, Status::STATE_EXPIRED);
  EXPECT_NE(answer.statuses[0].reason.find("before this start"), std::string::npos);
  action_command_t after = move_to(2, {0.1, 1});
  after.utime = restarted.status().utime;
  EXPECT_TRUE(restarted.on_command(after).state.has_value());
}

TEST(RobotSimulator, SaysWhatToDoWithAStateThatItCannotContinue) {
  const std::filesystem::path file = scratch_file("damaged.yaml");
  RobotSimulator simulator(config("arm2"));
  simulator.on_command(move_to(0, {0.5, 20}));
  simulator.save(file);
  const std::string whole = text_of(file);
  const std::vector<std::uint8_t> before = bytes(simulator.state());
  const auto expect_refused = [&](RobotSimulator& restarted) {
    try {
      restarted.restore(file);
      ADD_FAILURE() << "was restored";
    } catch (const ConfigError& error) {
      EXPECT_NE(std::string(error.what()).find("delete it"), std::string::npos) << error.what();
      EXPECT_EQ(std::string(error.what()).find(file.string()), 0U) << error.what();
    }
  };
  for (std::size_t size = 0; size + 2 < whole.size(); size += 37) {
    std::ofstream(file) << whole.substr(0, size);
    expect_refused(simulator);
    EXPECT_EQ(bytes(simulator.state()), before);
  }
  std::ofstream(file) << whole;
  RobotSimulator other(config("arm4"));
  expect_refused(other);
  std::filesystem::remove(file);
}

TEST(RobotSimulator, HidesThePlatesOfAPart) {
  RobotSimulatorConfig hiding = config("arm7");
  hiding.hidden_parts = {4};
  RobotSimulator simulator(hiding);
  const auto answer = simulator.on_command(move_to(0, {0.1, 5, 0, 0.1, 3, 0, 50}));
  ASSERT_TRUE(answer.state.has_value());
  for (const int part : simulator.scene().markers().parts()) {
    for (const int geom : simulator.scene().plate_geoms(part)) {
      EXPECT_EQ(answer.state->geom_alpha[geom], part == 4 ? 0.0F : 1.0F);
    }
  }
  // SIM_STATE still has the true poses of hidden parts.
  EXPECT_EQ(answer.state->num_parts, 10);
  hiding.hidden_parts = {44};
  EXPECT_THROW(RobotSimulator{hiding}, std::invalid_argument);
}

TEST(RobotSimulator, RepeatsStatusAndStateOnceASecond) {
  RobotSimulator simulator(config("arm2"));
  const std::int64_t now = 1'700'000'000'000'000;
  EXPECT_EQ(simulator.on_tick(now).statuses.size(), 1U);
  EXPECT_TRUE(simulator.on_tick(now + 900'000).statuses.empty());
  const auto answer = simulator.on_tick(now + 1'000'000);
  ASSERT_EQ(answer.statuses.size(), 1U);
  EXPECT_EQ(bytes(answer.statuses[0]), bytes(simulator.status()));
  ASSERT_TRUE(answer.state.has_value());
}

}  // namespace
}  // namespace bodyschema::test
