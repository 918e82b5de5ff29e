#include "processes/robot_simulator/robot_simulator.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <random>

#include "common/config/yaml.h"

namespace bodyschema {
namespace {

const std::filesystem::path kConfig = BODYSCHEMA_CONFIG_FOLDER;
using Status = motion_status_t;

RobotSimulatorConfig config(const std::string& rig, std::int64_t seed = 1) {
  RobotSimulatorConfig result = RobotSimulatorConfig::load(kConfig / rig / "robot_simulator.yaml");
  result.seed = seed;
  return result;
}

action_command_t command(std::int8_t kind, std::int64_t id, std::vector<double> action = {}) {
  action_command_t result{};
  result.source = "test";
  result.epoch = 1;
  result.action_id = id;
  result.kind = kind;
  result.expiry_utime = std::numeric_limits<std::int64_t>::max();
  result.num_signals = static_cast<std::int32_t>(action.size());
  result.action = std::move(action);
  return result;
}

action_command_t move_to(std::int64_t id, std::vector<double> action) {
  return command(action_command_t::KIND_MOVE, id, std::move(action));
}

template <class Message>
std::vector<std::uint8_t> bytes(const Message& message) {
  std::vector<std::uint8_t> result(message.getEncodedSize());
  message.encode(result.data(), 0, static_cast<int>(result.size()));
  return result;
}

void expect_rejected(RobotSimulator& simulator, const action_command_t& order,
                     const std::string& reason) {
  const std::vector<std::uint8_t> before = bytes(simulator.state());
  const auto answer = simulator.on_command(order);
  ASSERT_EQ(answer.statuses.size(), 1U);
  EXPECT_EQ(answer.statuses[0].state, Status::STATE_REJECTED);
  EXPECT_NE(answer.statuses[0].reason.find(reason), std::string::npos) << answer.statuses[0].reason;
  EXPECT_EQ(answer.statuses[0].action_id, order.action_id);
  EXPECT_FALSE(answer.state.has_value());
  EXPECT_EQ(bytes(simulator.state()), before);
}

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

INSTANTIATE_TEST_SUITE_P(RobotSimulator, EveryRig, testing::Values("arm2", "arm4", "arm7"),
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
  // It still does what it can.
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
  expect_rejected(simulator, move_to(1, {0.5, 0}), "RESUME");
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
  simulator.on_command(move_to(1, {-0.5, 20}));
  const Eigen::VectorXd positions = simulator.joint_positions();
  const auto again = simulator.on_command(move_to(0, {0.5, 20}));
  ASSERT_EQ(again.statuses.size(), 1U);
  EXPECT_EQ(bytes(again.statuses[0]), bytes(first.statuses.back()));
  EXPECT_FALSE(again.state.has_value());
  EXPECT_EQ(simulator.joint_positions(), positions);
  EXPECT_EQ(simulator.status().action_id, 1);
  // Another epoch of the same source counts anew.
  action_command_t restarted = move_to(0, {0.2, 10});
  restarted.epoch = 2;
  EXPECT_TRUE(simulator.on_command(restarted).state.has_value());
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
  const std::filesystem::path file =
      std::filesystem::path(testing::TempDir()) / "bodyschema_simulator_state.yaml";
  RobotSimulator lasting(config("arm7", 42));
  lasting.on_command(move_to(0, {0.3, -10, 0.4, -0.2, 15, 0.5, 60}));
  lasting.save(file);

  RobotSimulator restarted(config("arm7", 1));
  restarted.restore(file);
  EXPECT_EQ(bytes(restarted.state()), bytes(lasting.state()));
  EXPECT_EQ(bytes(restarted.status()), bytes(lasting.status()));
  const action_command_t next = move_to(1, {-0.3, 10, 0.1, 0.2, -15, 0.1, 30});
  lasting.on_command(next);
  restarted.on_command(next);
  EXPECT_EQ(bytes(restarted.state()), bytes(lasting.state()));
  EXPECT_FALSE(restarted.on_command(move_to(0, {0, 0, 0, 0, 0, 0, 40})).state.has_value());

  RobotSimulator other(config("arm2"));
  EXPECT_THROW(other.restore(file), ConfigError);
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
  // The truth knows it all the same.
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
}  // namespace bodyschema
