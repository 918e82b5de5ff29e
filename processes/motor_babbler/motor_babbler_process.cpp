#include "processes/motor_babbler/motor_babbler_process.h"

#include <spdlog/spdlog.h>

#include <stdexcept>
#include <utility>

namespace bodyschema {
namespace {

MotorBabblerConfig load_config(const std::filesystem::path& file, std::int64_t num_samples) {
  MotorBabblerConfig config = MotorBabblerConfig::load(file);
  if (num_samples > 0) config.stop.min_samples = config.stop.max_samples = num_samples;
  return config;
}

MotorBabbler restored_babbler(const MotorBabblerConfig& config, std::int64_t seed,
                              const std::filesystem::path& state_file) {
  MotorBabbler babbler(config, seed);
  if (!state_file.empty() && std::filesystem::exists(state_file)) babbler.restore(state_file);
  return babbler;
}

}  // namespace

void MotorBabblerProcess::Options::add_to(Arguments app) {
  app.add_option("--seed", seed, "Seed of the random actions");
  app.add_option("--samples", num_samples, "Stop after exactly this many samples").positive();
  app.add_option("--samples-file", samples_file,
                 "The observer's samples.lcmlog, read at start: what an action is chosen by");
  app.add_option("--state", state_file, "Saved before each command, restored at the start");
}

MotorBabblerProcess::MotorBabblerProcess(Process& process, const Options& options)
    : process_(process),
      config_(load_config(process.config_file(), options.num_samples)),
      door_(process.rig_folder()),
      babbler_(restored_babbler(config_, options.seed, options.state_file)),
      state_(options.state_file, babbler_.state_text()),
      intake_(
          options.samples_file, [this](const sample_t& sample) { remember(sample); },
          SampleIntake::asking(process)) {
  process.set_seed(options.seed);
  subscribe();
  process.on_idle([this] { on_idle(); });
  process.on_tick([this](std::int64_t now_us) { on_tick(now_us); });
}

void MotorBabblerProcess::subscribe() {
  door_.subscribe(process_, kMotionStatus, [this](const motion_status_t& status) {
    send(babbler_.on_motion_status(status));
  });
  if (config_.choice == Choice::kActive) {
    door_.subscribe(process_, kBodySchema,
                    [this](const body_schema_t& schema) { send(babbler_.on_body_schema(schema)); });
  }
  door_.subscribe(process_, kSample, [this](const sample_t& sample) {
    if (intake_.on_sample(sample)) send(babbler_.on_sample(sample));
  });
  door_.subscribe(process_, kMarkerPoses,
                  [this](const marker_poses_t& poses) { babbler_.on_marker_poses(poses); });
  door_.subscribe(process_, kModelHealth,
                  [this](const model_health_t& health) { send(babbler_.on_model_health(health)); });
  process_.bus().subscribe(kControlStatus, [this](const control_status_t& status) {
    send(babbler_.on_control_status(status));
  });
}

void MotorBabblerProcess::remember(const sample_t& sample) {
  if (!door_.takes(process_, sample)) return;
  try {
    send(babbler_.remember(sample));
  } catch (const std::invalid_argument&) {
    process_.count("refused SAMPLE");  // a samples file of another rig
  }
}

void MotorBabblerProcess::on_tick(std::int64_t now_us) {
  if (!state_.problem().empty()) state_.retry();
  intake_.on_tick(now_us);
  process_.set_counters(intake_.counters());
  send(babbler_.on_tick(now_us));
}

void MotorBabblerProcess::on_idle() {
  const std::int64_t num_late = babbler_.num_without_schema();
  if (num_late > std::exchange(num_late_schemas_, num_late))
    spdlog::warn(
        "no BODY_SCHEMA to choose by: drawn at random up to the next TEST; "
        "are structure_learner and model_monitor running?");
  process_.set_counters({{"action rejected", babbler_.num_rejected()},
                         {"sample never seen", babbler_.num_unseen()},
                         {"BODY_SCHEMA not in time", num_late},
                         {"wanted action", babbler_.num_wanted_taken()}});
  if (const auto n = state_.num_failed(); n > 0) process_.set_counters({{"state not saved", n}});
}

void MotorBabblerProcess::send(const std::optional<action_command_t>& command) {
  // A command that is not sent now is given again after resend_s.
  const bool is_saved = state_.save(babbler_.state_text());
  if (command && is_saved) process_.bus().publish(kActionCommand, *command);
  const std::int8_t phase = babbler_.is_done() ? process_info_t::PHASE_DONE
                            : is_saved         ? process_info_t::PHASE_WORKING
                                               : process_info_t::PHASE_WAITING;
  process_.set_activity(phase,
                        is_saved ? babbler_.activity()
                                 : "no MOVE is sent: its state is not saved: " + state_.problem());
}

}  // namespace bodyschema
