// controller: POSE_TARGET, MOTION_STATUS, MARKER_POSES, SAMPLE, BODY_SCHEMA, MODEL_HEALTH
//             -> ACTION_COMMAND, CONTROL_STATUS

#include <spdlog/fmt/fmt.h>

#include <filesystem>
#include <utility>

#include "common/bus/process.h"
#include "common/bus/rig_door.h"
#include "common/bus/state_file.h"
#include "processes/controller/controller.h"

using namespace bodyschema;

int main(int argc, char** argv) {
  std::filesystem::path state_file;
  const auto add_options = [&](Arguments app) {
    app.add_option("--state", state_file, "Saved before each MOVE, restored at the start");
  };
  const auto body = [&](Process& process) {
    Controller controller(ControllerConfig::load(process.config_file()));
    if (!state_file.empty() && std::filesystem::exists(state_file))
      controller.restore(state_file, process.wall_clock_us());

    StateFile state(state_file, controller.state_text());
    const auto say = [&] {
      const control_status_t status = controller.status();
      const bool is_open = status.control_state == control_status_t::CONTROL_MOVING;
      process.set_activity(
          is_open && state.problem().empty() ? process_info_t::PHASE_WORKING
                                             : process_info_t::PHASE_WAITING,
          state.problem().empty()
              ? status.why
              : "no MOVE is sent: its state is not saved: " + state.problem() + "; " + status.why);
    };
    const auto send = [&](const Controller::Answer& answer) {
      // The babbler is told that the arm is taken before anything moves. Neither this nor a HOLD
      // waits for a disk that is slow or full.
      if (answer.status) process.bus().publish(kControlStatus, *answer.status);
      const bool is_move = answer.command && answer.command->kind == action_command_t::KIND_MOVE;
      if (answer.command && !is_move) process.bus().publish(kActionCommand, *answer.command);
      // A MOVE that is not sent now is given again after resend_s.
      const bool is_saved = state.save(controller.state_text());
      if (is_move && is_saved) process.bus().publish(kActionCommand, *answer.command);
      if (answer.status || !is_saved) say();
    };
    const RigDoor door(process.rig_folder());
    const auto subscribe = [&](const auto& channel, auto handler) {
      door.subscribe(process, channel,
                     [&, handler](const auto& message) { send((controller.*handler)(message)); });
    };
    process.bus().subscribe<pose_target_t>(kPoseTarget, [&](const pose_target_t& target) {
      const std::int64_t wall_clock_us = process.wall_clock_us();
      const std::int64_t ahead_us = target.epoch - wall_clock_us;
      if (wall_clock_us >= 0 && ahead_us > kClockTolerance_us)
        process.set_notice(kPoseTarget.name,
                           fmt::format("POSE_TARGET of {} refused: it began {:.0f} s ahead of this "
                                       "machine's clock",
                                       target.sender, static_cast<double>(ahead_us) / 1e6));
      send(controller.on_pose_target(target, wall_clock_us));
    });
    subscribe(kMotionStatus, &Controller::on_motion_status);
    subscribe(kMarkerPoses, &Controller::on_marker_poses);
    process.bus().subscribe(kSample, [&](const sample_t& sample) {
      if (door.takes(process, sample)) send(controller.on_sample(sample));
    });
    subscribe(kBodySchema, &Controller::on_body_schema);
    subscribe(kModelHealth, &Controller::on_model_health);
    process.on_tick([&](std::int64_t now_us) {
      if (!state.problem().empty() && state.retry()) say();
      send(controller.on_tick(now_us));
    });
    std::map<std::string, std::int64_t> reported;
    const auto count = [&](const std::string& name, std::int64_t total) {
      process.count(name, total - std::exchange(reported[name], total));
    };
    process.on_idle([&] {
      for (const auto& [name, total] : controller.counters()) count(name, total);
      if (state.num_failed() > 0) count("state not saved", state.num_failed());
    });
    say();
    process.run();
  };
  return run_process("controller", argc, argv, body, add_options);
}
