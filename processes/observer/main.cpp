// observer: MARKER_POSES, MOTION_STATUS, CAMERA_INFO, SAMPLE_REQUEST -> SAMPLE

#include <spdlog/spdlog.h>

#include <stdexcept>

#include "common/bus/process.h"
#include "common/bus/rig_door.h"
#include "processes/observer/observer.h"
#include "processes/observer/sample_outbox.h"

using namespace bodyschema;

int main(int argc, char** argv) {
  std::string samples_file;
  const auto add_options = [&](Arguments app) {
    app.add_option("--samples", samples_file,
                   "Log that every SAMPLE is appended to; the next run continues it");
  };
  const auto body = [&](Process& process) {
    const RigDoor door(process.rig_folder());
    Observer observer(ObserverConfig::load(process.config_file()),
                      load_markers(process.rig_folder()), door.calibration_id());
    Bus& bus = process.bus();
    SampleOutbox outbox(samples_file,
                        [&](const sample_t& sample) { bus.publish(kSample, sample); });
    outbox.for_each_recorded([&](const sample_t& sample) {
      door.lets_in(process, kSample, sample);  // else it stays in the file, and others refuse it
      observer.restore(sample);
    });
    const auto send = [&](const std::optional<sample_t>& sample) {
      if (sample) outbox.send(*sample);
    };
    door.subscribe(process, kMarkerPoses,
                   [&](const marker_poses_t& poses) { send(observer.on_marker_poses(poses)); });
    door.subscribe(process, kMotionStatus,
                   [&](const motion_status_t& status) { send(observer.on_motion_status(status)); });
    door.subscribe(process, kCameraInfo,
                   [&](const camera_info_t& info) { send(observer.on_camera_info(info)); });
    bus.subscribe(kSampleRequest,
                  [&](const sample_request_t& request) { outbox.on_request(request); });
    process.on_tick([&](std::int64_t now_us) {
      if (!bus.is_replay()) outbox.on_tick(now_us);
      if (const auto warning = observer.on_tick(now_us)) spdlog::warn("{}", *warning);
    });
    process.on_idle([&] {
      process.set_counters(observer.counters());
      process.set_counters(outbox.counters());
      const std::string problem = outbox.problem();
      process.set_activity(observer.is_waiting() || !problem.empty()
                               ? process_info_t::PHASE_WAITING
                               : process_info_t::PHASE_WORKING,
                           problem.empty() ? observer.activity() : problem);
    });
    process.on_end([&] {
      if (!outbox.problem().empty()) throw std::runtime_error("at the end " + outbox.problem());
    });
    process.run();
  };
  return run_process("observer", argc, argv, body, add_options);
}
