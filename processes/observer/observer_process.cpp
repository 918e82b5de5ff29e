#include "processes/observer/observer_process.h"

#include <spdlog/spdlog.h>

#include <stdexcept>
#include <string>

namespace bodyschema {

void ObserverProcess::Options::add_to(Arguments app) {
  app.add_option("--samples", samples_file,
                 "Log that every SAMPLE is appended to; the next run continues it");
}

ObserverProcess::ObserverProcess(Process& process, const Options& options)
    : process_(process),
      door_(process.rig_folder()),
      observer_(ObserverConfig::load(process.config_file()), load_markers(process.rig_folder()),
                door_.calibration_id()),
      outbox_(options.samples_file,
              [this](const sample_t& sample) { process_.bus().publish(kSample, sample); }) {
  restore();
  door_.subscribe(process, kMarkerPoses,
                  [this](const marker_poses_t& poses) { send(observer_.on_marker_poses(poses)); });
  door_.subscribe(process, kMotionStatus, [this](const motion_status_t& status) {
    send(observer_.on_motion_status(status));
  });
  door_.subscribe(process, kCameraInfo,
                  [this](const camera_info_t& info) { send(observer_.on_camera_info(info)); });
  process.bus().subscribe(kSampleRequest,
                          [this](const sample_request_t& request) { outbox_.on_request(request); });
  process.on_tick([this](std::int64_t now_us) { on_tick(now_us); });
  process.on_idle([this] { on_idle(); });
  process.on_end([this] { on_end(); });
}

void ObserverProcess::restore() {
  outbox_.for_each_recorded([this](const sample_t& sample) {
    door_.lets_in(process_, kSample, sample);  // else it stays in the file, and others refuse it
    observer_.restore(sample);
  });
}

void ObserverProcess::send(const std::optional<sample_t>& sample) {
  if (sample) outbox_.send(*sample);
}

void ObserverProcess::on_tick(std::int64_t now_us) {
  if (!process_.bus().is_replay()) outbox_.on_tick(now_us);
  if (const auto warning = observer_.on_tick(now_us)) spdlog::warn("{}", *warning);
}

void ObserverProcess::on_idle() {
  process_.set_counters(observer_.counters());
  process_.set_counters(outbox_.counters());
  const std::string problem = outbox_.problem();
  process_.set_activity(observer_.is_waiting() || !problem.empty() ? process_info_t::PHASE_WAITING
                                                                   : process_info_t::PHASE_WORKING,
                        problem.empty() ? observer_.activity() : problem);
}

void ObserverProcess::on_end() const {
  if (!outbox_.problem().empty()) throw std::runtime_error("at the end " + outbox_.problem());
}

}  // namespace bodyschema
