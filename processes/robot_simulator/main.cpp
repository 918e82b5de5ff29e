// robot_simulator: ACTION_COMMAND, FAULT_COMMAND -> MOTION_STATUS, SIM_STATE

#include <spdlog/spdlog.h>

#include "common/bus/process.h"
#include "processes/robot_simulator/robot_simulator.h"

using namespace bodyschema;

int main(int argc, char** argv) {
  std::int64_t seed = 1;
  bool is_ideal = false;
  std::vector<int> hidden;
  std::filesystem::path state_file;
  const auto add_options = [&](Arguments app) {
    app.add_option("--seed", seed, "Seed of the image noise and the calibration errors");
    app.add_flag("--ideal", is_ideal, "Without robot.yaml's calibration errors");
    app.add_option("--hide", hidden, "Body part whose markers are invisible; may be repeated");
    app.add_option("--state", state_file, "Saved at every rest, restored at the start");
  };
  const auto body = [&](Process& process) {
    RobotSimulatorConfig config = RobotSimulatorConfig::load(process.config_file());
    config.seed = seed;
    config.is_ideal = is_ideal;
    config.hidden_parts = {hidden.begin(), hidden.end()};
    RobotSimulator simulator(config);
    if (!state_file.empty() && std::filesystem::exists(state_file)) simulator.restore(state_file);
    process.set_seed(simulator.state().seed);

    const auto send = [&](const RobotSimulator::Answer& answer) {
      for (const motion_status_t& status : answer.statuses) {
        process.bus().publish(kMotionStatus, status);
      }
      if (answer.state) process.bus().publish(kSimState, *answer.state);
    };
    // A full disk must not end a run: what a restart would lose is said once.
    bool has_warned = false;
    const auto save = [&] {
      if (state_file.empty()) return;
      try {
        simulator.save(state_file);
      } catch (const std::runtime_error& error) {
        process.count("state not saved");
        if (!has_warned) spdlog::warn("a restart would not know this pose: {}", error.what());
        has_warned = true;
      }
    };
    process.bus().subscribe<action_command_t>(kActionCommand, [&](const action_command_t& command) {
      const RobotSimulator::Answer answer = simulator.on_command(command);
      // Saved before it is told: who hears of a pose can rely on it after a crash.
      save();
      send(answer);
      process.set_activity(process_info_t::PHASE_WORKING,
                           "action " + std::to_string(command.action_id) + " of " + command.source);
    });
    process.bus().subscribe<fault_command_t>(kFaultCommand, [&](const fault_command_t& command) {
      const RobotSimulator::Answer answer = simulator.on_fault(command);
      save();
      send(answer);
    });
    process.on_tick([&](std::int64_t now_us) { send(simulator.on_tick(now_us)); });
    process.set_activity(process_info_t::PHASE_WAITING, "waits for the first action");
    process.run();
  };
  return run_process("robot_simulator", argc, argv, body, add_options);
}
