#pragma once

#include <cstdint>
#include <filesystem>
#include <vector>

#include "common/bus/process.h"
#include "processes/robot_simulator/robot_simulator.h"

namespace bodyschema {

/// The simulator on a bus. Its state is saved before it is told: a pose that somebody heard of is
/// still the pose after a crash. A full disk does not end a run: what a restart would lose is
/// warned of once.
class RobotSimulatorProcess {
 public:
  struct Options {
    std::int64_t seed = 1;
    bool is_ideal = false;
    std::vector<int> hidden_parts;
    std::filesystem::path state_file;
    void add_to(Arguments app);
  };
  RobotSimulatorProcess(Process& process, const Options& options);
  RobotSimulatorProcess(const RobotSimulatorProcess&) = delete;

 private:
  void on_command(const action_command_t& command);
  void save();
  void send(const RobotSimulator::Answer& answer);

  Process& process_;
  const std::filesystem::path state_file_;
  RobotSimulator simulator_;
  bool has_warned_ = false;
};

}  // namespace bodyschema
