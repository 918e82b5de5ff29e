// observer: MARKER_POSES, MOTION_STATUS, CAMERA_INFO -> SAMPLE

#include <spdlog/spdlog.h>

#include <CLI/CLI.hpp>
#include <utility>

#include "common/bus/event_log.h"
#include "common/bus/process.h"
#include "processes/observer/observer.h"

using namespace bodyschema;

int main(int argc, char** argv) {
  std::string samples_file;
  const auto add_options = [&](CLI::App& app) {
    app.add_option("--samples", samples_file,
                   "Log that every SAMPLE is appended to; the next run continues it");
  };
  const auto body = [&](Process& process) {
    Observer observer(ObserverConfig::load(process.config_file()),
                      load_markers(process.rig_folder()));
    std::optional<LogAppender> samples;
    std::optional<sample_t> last_recorded;
    if (!samples_file.empty()) {
      samples.emplace(samples_file);
      const std::vector<sample_t> recorded = read_log(samples_file, kSample);
      observer.restore(recorded);
      if (!recorded.empty()) last_recorded = recorded.back();
    }
    const auto send = [&](const std::optional<sample_t>& sample) {
      if (!sample) return;
      // On disk before it is told: who acts on a sample finds it in the log after a crash.
      if (samples) samples->append(kSample, *sample);
      process.bus().publish(kSample, *sample);
    };
    Bus& bus = process.bus();
    // A kill between append and publish leaves a sample that nobody heard of.
    if (last_recorded) bus.publish(kSample, *last_recorded);
    bus.subscribe(kMarkerPoses,
                  [&](const marker_poses_t& poses) { send(observer.on_marker_poses(poses)); });
    bus.subscribe(kMotionStatus,
                  [&](const motion_status_t& status) { send(observer.on_motion_status(status)); });
    bus.subscribe(kCameraInfo,
                  [&](const camera_info_t& info) { send(observer.on_camera_info(info)); });
    process.on_tick([&](std::int64_t now_us) {
      if (const auto warning = observer.on_tick(now_us)) spdlog::warn("{}", *warning);
    });
    std::map<std::string, std::int64_t> reported;
    process.on_idle([&] {
      for (const auto& [name, count] : observer.counters()) {
        process.count(name, count - std::exchange(reported[name], count));
      }
      process.set_activity(
          observer.is_waiting() ? process_info_t::PHASE_WAITING : process_info_t::PHASE_WORKING,
          observer.activity());
    });
    process.run();
  };
  return run_process("observer", argc, argv, body, add_options);
}
