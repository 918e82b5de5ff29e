#include "processes/controller/controller_process.h"

#include <spdlog/fmt/fmt.h>

#include <string>

namespace bodyschema {
namespace {

Controller restored_controller(const Process& process, const std::filesystem::path& state_file) {
  Controller controller(ControllerConfig::load(process.config_file()));
  if (!state_file.empty() && std::filesystem::exists(state_file))
    controller.restore(state_file, process.wall_clock_us());
  return controller;
}

}  // namespace

void ControllerProcess::Options::add_to(Arguments app) {
  app.add_option("--state", state_file, "Saved before each MOVE, restored at the start");
}

ControllerProcess::ControllerProcess(Process& process, const Options& options)
    : process_(process),
      door_(process.rig_folder()),
      controller_(restored_controller(process, options.state_file)),
      state_(options.state_file, controller_.state_text()) {
  const auto subscribe = [&](const auto& channel, auto handler) {
    door_.subscribe(process, channel, [this, handler](const auto& message) {
      send((controller_.*handler)(message));
    });
  };
  subscribe(kMotionStatus, &Controller::on_motion_status);
  subscribe(kMarkerPoses, &Controller::on_marker_poses);
  subscribe(kBodySchema, &Controller::on_body_schema);
  subscribe(kModelHealth, &Controller::on_model_health);
  process.bus().subscribe(kPoseTarget,
                          [this](const pose_target_t& target) { on_pose_target(target); });
  process.bus().subscribe(kSample, [this](const sample_t& sample) {
    if (door_.takes(process_, sample)) send(controller_.on_sample(sample));
  });
  process.on_tick([this](std::int64_t now_us) { on_tick(now_us); });
  process.on_idle([this] {
    process_.set_counters(controller_.counters());
    if (const auto n = state_.num_failed(); n > 0) process_.set_counters({{"state not saved", n}});
  });
  say();
}

void ControllerProcess::on_pose_target(const pose_target_t& target) {
  const std::int64_t wall_clock_us = process_.wall_clock_us();
  const std::int64_t ahead_us = target.epoch - wall_clock_us;
  if (wall_clock_us >= 0 && ahead_us > kClockTolerance_us)
    process_.set_notice(kPoseTarget.name,
                        fmt::format("POSE_TARGET of {} refused: it began {:.0f} s ahead of this "
                                    "machine's clock",
                                    target.sender, static_cast<double>(ahead_us) / 1e6));
  send(controller_.on_pose_target(target, wall_clock_us));
}

void ControllerProcess::on_tick(std::int64_t now_us) {
  if (!state_.problem().empty() && state_.retry()) say();
  send(controller_.on_tick(now_us));
}

void ControllerProcess::send(const Controller::Answer& answer) {
  // The babbler is told that the arm is taken before anything moves.
  if (answer.status) process_.bus().publish(kControlStatus, *answer.status);
  const bool is_move = answer.command && answer.command->kind == action_command_t::KIND_MOVE;
  if (answer.command && !is_move) process_.bus().publish(kActionCommand, *answer.command);
  // A MOVE that is not sent now is given again after resend_s.
  const bool is_saved = state_.save(controller_.state_text());
  if (is_move && is_saved) process_.bus().publish(kActionCommand, *answer.command);
  if (answer.status || !is_saved) say();
}

void ControllerProcess::say() {
  const control_status_t status = controller_.status();
  const bool is_moving = status.control_state == control_status_t::CONTROL_MOVING;
  const std::string& problem = state_.problem();
  process_.set_activity(
      is_moving && problem.empty() ? process_info_t::PHASE_WORKING : process_info_t::PHASE_WAITING,
      problem.empty() ? status.why
                      : "no MOVE is sent: its state is not saved: " + problem + "; " + status.why);
}

}  // namespace bodyschema
