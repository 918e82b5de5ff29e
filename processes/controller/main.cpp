// controller: POSE_TARGET, MOTION_STATUS, MARKER_POSES, SAMPLE, BODY_SCHEMA, MODEL_HEALTH
//             -> ACTION_COMMAND, CONTROL_STATUS

#include <CLI/CLI.hpp>
#include <filesystem>
#include <utility>

#include "common/bus/event_log.h"
#include "common/bus/process.h"
#include "common/bus/rig_door.h"
#include "processes/controller/controller.h"

using namespace bodyschema;

int main(int argc, char** argv) {
  std::filesystem::path state_file;
  const auto add_options = [&](CLI::App& app) {
    app.add_option("--state", state_file, "Saved before each command, restored at the start");
  };
  const auto body = [&](Process& process) {
    Controller controller(ControllerConfig::load(process.config_file()));
    if (!state_file.empty() && std::filesystem::exists(state_file)) controller.restore(state_file);

    std::string saved = controller.state_text();
    const auto send = [&](const Controller::Answer& answer) {
      if (const std::string text = controller.state_text(); text != saved && !state_file.empty()) {
        write_file_atomically(state_file, text);
        saved = text;
      }
      // The babbler is told that the arm is taken before anything moves.
      if (answer.status) {
        process.bus().publish(kControlStatus, *answer.status);
        const bool is_open = answer.status->control_state == control_status_t::CONTROL_MOVING;
        process.set_activity(
            is_open ? process_info_t::PHASE_WORKING : process_info_t::PHASE_WAITING,
            answer.status->why);
      }
      if (answer.command) process.bus().publish(kActionCommand, *answer.command);
    };
    const RigDoor door(process.rig_folder());
    const auto subscribe = [&](const auto& channel, auto handler) {
      door.subscribe(process, channel,
                     [&, handler](const auto& message) { send((controller.*handler)(message)); });
    };
    process.bus().subscribe<pose_target_t>(
        kPoseTarget, [&](const pose_target_t& target) { send(controller.on_pose_target(target)); });
    subscribe(kMotionStatus, &Controller::on_motion_status);
    subscribe(kMarkerPoses, &Controller::on_marker_poses);
    subscribe(kSample, &Controller::on_sample);
    subscribe(kBodySchema, &Controller::on_body_schema);
    subscribe(kModelHealth, &Controller::on_model_health);
    process.on_tick([&](std::int64_t now_us) { send(controller.on_tick(now_us)); });
    std::map<std::string, std::int64_t> reported;
    process.on_idle([&] {
      for (const auto& [name, count] : controller.counters()) {
        process.count(name, count - std::exchange(reported[name], count));
      }
    });
    process.set_activity(process_info_t::PHASE_WAITING, controller.status().why);
    process.run();
  };
  return run_process("controller", argc, argv, body, add_options);
}
