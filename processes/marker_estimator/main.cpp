// marker_estimator: CAMERA_IMAGE, CAMERA_INFO -> MARKER_POSES

#include <exception>
#include <mutex>
#include <optional>
#include <thread>

#include "common/bus/images_url.h"
#include "common/bus/process.h"
#include "common/bus/rig_door.h"
#include "processes/marker_estimator/marker_estimator.h"

using namespace bodyschema;

int main(int argc, char** argv) {
  std::string images_option;
  std::optional<Arguments> arguments;
  const auto add_options = [&](Arguments app) {
    arguments = app;
    app.add_option("--images", images_option, "URL of the images; default: the next port of --in");
  };
  const auto body = [&](Process& process) {
    const auto config = MarkerEstimatorConfig::load(process.config_file());
    const RigDoor door(process.rig_folder());
    MarkerEstimator estimator(config, load_markers(process.rig_folder()), door.calibration_id());
    std::mutex mutex;  // guards estimator and failure

    const auto on_image = [&](const camera_image_t& image) {
      const std::lock_guard lock(mutex);
      if (const auto poses = estimator.on_camera_image(image)) {
        process.bus().publish(kMarkerPoses, *poses);
      }
    };
    door.subscribe(process, kCameraInfo, [&](const camera_info_t& info) {
      const std::lock_guard lock(mutex);
      estimator.on_camera_info(info);
    });
    std::string in = arguments->text_of("--in");
    if (in.empty()) in = default_url();
    const std::string images_from = images_option.empty() ? images_url(in) : images_option;
    const auto subscribe_images = [&](Bus& bus) {
      if (config.every_image) {
        bus.subscribe(kCameraImage, on_image);
      } else {
        bus.subscribe_latest(kCameraImage, on_image);
      }
    };
    // The images' bus is waited for by a thread of its own, so that a frame need not wait for the
    // loop's next round. Logs are read in the loop: first the calibration, then its images.
    std::exception_ptr failure;
    std::optional<Bus> images;
    std::jthread listener;
    if (images_from == in) {
      subscribe_images(process.bus());
    } else {
      subscribe_images(images.emplace(images_from, ""));
      if (images->is_replay()) {
        process.on_end([&] {
          while (images->handle(std::chrono::milliseconds(0))) {
          }
        });
      } else {
        listener = std::jthread([&](const std::stop_token& stop) {
          try {
            while (!stop.stop_requested()) images->handle(std::chrono::milliseconds(100));
          } catch (...) {
            const std::lock_guard lock(mutex);
            failure = std::current_exception();
          }
        });
      }
    }
    process.on_idle([&] {
      const std::lock_guard lock(mutex);
      if (failure) std::rethrow_exception(failure);
      process.set_counters(estimator.counters());
      process.set_activity(
          estimator.is_working() ? process_info_t::PHASE_WORKING : process_info_t::PHASE_WAITING,
          estimator.activity());
    });
    process.run();
  };
  return run_process("marker_estimator", argc, argv, body, add_options);
}
