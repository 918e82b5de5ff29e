// motor_babbler: MOTION_STATUS, SAMPLE, MODEL_HEALTH -> ACTION_COMMAND

#include <CLI/CLI.hpp>

#include "common/bus/process.h"
#include "common/bus/rig_door.h"
#include "processes/motor_babbler/motor_babbler.h"

using namespace bodyschema;

int main(int argc, char** argv) {
  std::int64_t seed = 1;
  std::int64_t samples = 0;
  const auto add_options = [&](CLI::App& app) {
    app.add_option("--seed", seed, "Seed of the random actions");
    app.add_option("--samples", samples, "Stop after exactly this many samples")
        ->check(CLI::PositiveNumber);
  };
  const auto body = [&](Process& process) {
    MotorBabblerConfig config = MotorBabblerConfig::load(process.config_file());
    if (samples > 0) config.stop.min_samples = config.stop.max_samples = samples;
    MotorBabbler babbler(config, seed);
    process.set_seed(seed);

    const auto send = [&](const std::optional<action_command_t>& command) {
      if (command) process.bus().publish(kActionCommand, *command);
      const std::int8_t phase =
          babbler.is_done() ? process_info_t::PHASE_DONE : process_info_t::PHASE_WORKING;
      process.set_activity(phase, babbler.activity());
    };
    const RigDoor door(process.rig_folder());
    door.subscribe(process, kMotionStatus,
                   [&](const motion_status_t& status) { send(babbler.on_motion_status(status)); });
    door.subscribe(process, kSample,
                   [&](const sample_t& sample) { send(babbler.on_sample(sample)); });
    door.subscribe(process, kModelHealth,
                   [&](const model_health_t& health) { send(babbler.on_model_health(health)); });
    process.on_tick([&](std::int64_t now_us) { send(babbler.on_tick(now_us)); });
    process.run();
  };
  return run_process("motor_babbler", argc, argv, body, add_options);
}
