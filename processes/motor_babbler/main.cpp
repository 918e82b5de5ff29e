// motor_babbler: MOTION_STATUS, SAMPLE, MARKER_POSES, MODEL_HEALTH, BODY_SCHEMA, CONTROL_STATUS
//                -> ACTION_COMMAND, SAMPLE_REQUEST

#include <spdlog/spdlog.h>

#include <filesystem>
#include <utility>

#include "common/bus/process.h"
#include "common/bus/rig_door.h"
#include "common/bus/sample_intake.h"
#include "common/bus/state_file.h"
#include "processes/motor_babbler/motor_babbler.h"

using namespace bodyschema;

int main(int argc, char** argv) {
  std::int64_t seed = 1;
  std::int64_t samples = 0;
  std::filesystem::path state_file;
  std::string samples_file;
  const auto add_options = [&](Arguments app) {
    app.add_option("--seed", seed, "Seed of the random actions");
    app.add_option("--samples", samples, "Stop after exactly this many samples").positive();
    app.add_option("--samples-file", samples_file,
                   "The observer's samples.lcmlog, read at start: what an action is chosen by");
    app.add_option("--state", state_file, "Saved before each command, restored at the start");
  };
  const auto body = [&](Process& process) {
    MotorBabblerConfig config = MotorBabblerConfig::load(process.config_file());
    if (samples > 0) config.stop.min_samples = config.stop.max_samples = samples;
    MotorBabbler babbler(config, seed);
    if (!state_file.empty() && std::filesystem::exists(state_file)) babbler.restore(state_file);
    process.set_seed(seed);

    StateFile state(state_file, babbler.state_text());
    const auto send = [&](const std::optional<action_command_t>& command) {
      // A command that is not sent now is given again after resend_s.
      const bool is_saved = state.save(babbler.state_text());
      if (command && is_saved) process.bus().publish(kActionCommand, *command);
      const std::int8_t phase = babbler.is_done() ? process_info_t::PHASE_DONE
                                : is_saved        ? process_info_t::PHASE_WORKING
                                                  : process_info_t::PHASE_WAITING;
      process.set_activity(
          phase, is_saved ? babbler.activity()
                          : "no MOVE is sent: its state is not saved: " + state.problem());
    };
    const RigDoor door(process.rig_folder());
    door.subscribe(process, kMotionStatus,
                   [&](const motion_status_t& status) { send(babbler.on_motion_status(status)); });
    SampleIntake intake(
        samples_file,
        [&](const sample_t& sample) {
          if (!door.takes(process, sample)) return;
          try {
            send(babbler.remember(sample));
          } catch (const std::invalid_argument&) {
            process.count("refused SAMPLE");  // a samples file of another rig
          }
        },
        SampleIntake::asking(process));
    if (config.choice == Choice::kActive) {
      door.subscribe(process, kBodySchema,
                     [&](const body_schema_t& schema) { send(babbler.on_body_schema(schema)); });
    }
    door.subscribe(process, kSample, [&](const sample_t& sample) {
      if (intake.on_sample(sample)) send(babbler.on_sample(sample));
    });
    door.subscribe(process, kMarkerPoses,
                   [&](const marker_poses_t& poses) { babbler.on_marker_poses(poses); });
    door.subscribe(process, kModelHealth,
                   [&](const model_health_t& health) { send(babbler.on_model_health(health)); });
    process.bus().subscribe<control_status_t>(kControlStatus, [&](const control_status_t& status) {
      send(babbler.on_control_status(status));
    });
    std::map<std::string, std::int64_t> reported;
    const auto count = [&](const std::string& name, std::int64_t total) {
      process.count(name, total - std::exchange(reported[name], total));
    };
    process.on_idle([&] {
      count("action rejected", babbler.num_rejected());
      count("sample never seen", babbler.num_unseen());
      const std::string late = "BODY_SCHEMA not in time";
      if (babbler.num_without_schema() > reported[late])
        spdlog::warn(
            "no BODY_SCHEMA to choose by: drawn at random up to the next TEST; "
            "are structure_learner and model_monitor running?");
      count(late, babbler.num_without_schema());
      if (state.num_failed() > 0) count("state not saved", state.num_failed());
    });
    process.on_tick([&](std::int64_t now_us) {
      if (!state.problem().empty()) state.retry();
      intake.on_tick(now_us);
      process.set_counters(intake.counters());
      send(babbler.on_tick(now_us));
    });
    process.run();
  };
  return run_process("motor_babbler", argc, argv, body, add_options);
}
