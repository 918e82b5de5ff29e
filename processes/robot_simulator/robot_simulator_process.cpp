#include "processes/robot_simulator/robot_simulator_process.h"

#include <spdlog/spdlog.h>

#include <stdexcept>
#include <string>

namespace bodyschema {
namespace {

RobotSimulatorConfig load_config(const std::filesystem::path& file,
                                 const RobotSimulatorProcess::Options& options) {
  RobotSimulatorConfig config = RobotSimulatorConfig::load(file);
  config.seed = options.seed;
  config.is_ideal = options.is_ideal;
  config.hidden_parts = {options.hidden_parts.begin(), options.hidden_parts.end()};
  return config;
}

}  // namespace

void RobotSimulatorProcess::Options::add_to(Arguments app) {
  app.add_option("--seed", seed, "Seed of the image noise and the calibration errors");
  app.add_flag("--ideal", is_ideal, "Without robot.yaml's calibration errors");
  app.add_option("--hide", hidden_parts, "Body part whose markers are invisible; may be repeated");
  app.add_option("--state", state_file, "Saved at every rest, restored at the start");
}

RobotSimulatorProcess::RobotSimulatorProcess(Process& process, const Options& options)
    : process_(process),
      state_file_(options.state_file),
      simulator_(load_config(process.config_file(), options)) {
  if (!state_file_.empty() && std::filesystem::exists(state_file_)) simulator_.restore(state_file_);
  process.set_seed(simulator_.state().seed);
  process.bus().subscribe(kActionCommand,
                          [this](const action_command_t& command) { on_command(command); });
  process.bus().subscribe(kFaultCommand, [this](const fault_command_t& command) {
    const RobotSimulator::Answer answer = simulator_.on_fault(command);
    save();
    send(answer);
  });
  process.on_tick([this](std::int64_t now_us) { send(simulator_.on_tick(now_us)); });
  process.set_activity(process_info_t::PHASE_WAITING, "waits for the first action");
}

void RobotSimulatorProcess::on_command(const action_command_t& command) {
  const RobotSimulator::Answer answer = simulator_.on_command(command);
  save();
  send(answer);
  process_.set_activity(process_info_t::PHASE_WORKING,
                        "action " + std::to_string(command.action_id) + " of " + command.source);
}

void RobotSimulatorProcess::save() {
  if (state_file_.empty()) return;
  try {
    simulator_.save(state_file_);
  } catch (const std::runtime_error& error) {
    process_.count("state not saved");
    if (!has_warned_) spdlog::warn("a restart would not know this pose: {}", error.what());
    has_warned_ = true;
  }
}

void RobotSimulatorProcess::send(const RobotSimulator::Answer& answer) {
  for (const motion_status_t& status : answer.statuses) {
    process_.bus().publish(kMotionStatus, status);
  }
  if (answer.state) process_.bus().publish(kSimState, *answer.state);
}

}  // namespace bodyschema
