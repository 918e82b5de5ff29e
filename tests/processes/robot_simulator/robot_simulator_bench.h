#pragma once

#include <gtest/gtest.h>
#include <unistd.h>

#include <limits>

#include "common/bus/convert.h"
#include "processes/robot_simulator/robot_simulator.h"
#include "tests/support/target_rig.h"

// What the simulator's tests have in common: its configurations, its commands and a file of its
// state.

namespace bodyschema::test {

inline const std::filesystem::path kConfig = BODYSCHEMA_CONFIG_FOLDER;
using Status = motion_status_t;

inline RobotSimulatorConfig config(const std::string& rig, std::int64_t seed = 1) {
  RobotSimulatorConfig result = RobotSimulatorConfig::load(kConfig / rig / "robot_simulator.yaml");
  result.seed = seed;
  result.is_ideal = true;
  return result;
}

/// With robot.yaml's calibration errors.
inline RobotSimulatorConfig honest(const std::string& rig, std::int64_t seed = 1) {
  RobotSimulatorConfig result = config(rig, seed);
  result.is_ideal = false;
  return result;
}

inline action_command_t command(std::int8_t kind, std::int64_t id,
                                std::vector<double> action = {}) {
  action_command_t result{};
  result.utime = 1'000'000;
  result.source = "test";
  result.epoch = 1;
  result.action_id = id;
  result.kind = kind;
  result.expiry_utime = std::numeric_limits<std::int64_t>::max();
  result.num_signals = static_cast<std::int32_t>(action.size());
  result.action = std::move(action);
  return result;
}

inline action_command_t move_to(std::int64_t id, std::vector<double> action) {
  return command(action_command_t::KIND_MOVE, id, std::move(action));
}

template <class Message>
std::vector<std::uint8_t> bytes(const Message& message) {
  std::vector<std::uint8_t> result(message.getEncodedSize());
  message.encode(result.data(), 0, static_cast<int>(result.size()));
  return result;
}

inline void expect_rejected(RobotSimulator& simulator, const action_command_t& order,
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

inline std::filesystem::path scratch_file(const std::string& name) {
  return std::filesystem::path(testing::TempDir()) /
         ("bodyschema_" + std::to_string(::getpid()) + "_" + name);
}

}  // namespace bodyschema::test
