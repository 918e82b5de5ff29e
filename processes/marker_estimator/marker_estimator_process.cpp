#include "processes/marker_estimator/marker_estimator_process.h"

#include <chrono>

#include "common/bus/images_url.h"

namespace bodyschema {

void MarkerEstimatorProcess::Options::add_to(Arguments app) {
  app.add_option("--images", images_url, "URL of the images; default: the next port of --in");
}

MarkerEstimatorProcess::MarkerEstimatorProcess(Process& process, const Options& options)
    : process_(process),
      config_(MarkerEstimatorConfig::load(process.config_file())),
      door_(process.rig_folder()),
      estimator_(config_, load_markers(process.rig_folder()), door_.calibration_id()) {
  door_.subscribe(process, kCameraInfo,
                  [this](const camera_info_t& info) { on_camera_info(info); });
  const std::string& in = process.in_url();
  const std::string images = options.images_url.empty() ? images_url(in) : options.images_url;
  if (images == in) {
    subscribe_images(process.bus());
  } else {
    subscribe_images(images_.emplace(images, ""));
    if (images_->is_replay()) {
      process.on_end([this] {
        while (images_->handle(std::chrono::milliseconds(0))) {
        }
      });
    } else {
      listener_ = std::jthread([this](const std::stop_token& stop) { listen(stop); });
    }
  }
  process.on_idle([this] { on_idle(); });
}

void MarkerEstimatorProcess::subscribe_images(Bus& bus) {
  const auto handler = [this](const camera_image_t& image) { on_image(image); };
  if (config_.every_image) {
    bus.subscribe(kCameraImage, handler);
  } else {
    bus.subscribe_latest(kCameraImage, handler);
  }
}

void MarkerEstimatorProcess::listen(const std::stop_token& stop) {
  try {
    while (!stop.stop_requested()) images_->handle(std::chrono::milliseconds(100));
  } catch (...) {
    const std::lock_guard lock(mutex_);
    failure_ = std::current_exception();
  }
}

void MarkerEstimatorProcess::on_image(const camera_image_t& image) {
  const std::lock_guard lock(mutex_);
  if (const auto poses = estimator_.on_camera_image(image)) {
    process_.bus().publish(kMarkerPoses, *poses);
  }
}

void MarkerEstimatorProcess::on_camera_info(const camera_info_t& info) {
  const std::lock_guard lock(mutex_);
  estimator_.on_camera_info(info);
}

void MarkerEstimatorProcess::on_idle() {
  const std::lock_guard lock(mutex_);
  if (failure_) std::rethrow_exception(failure_);
  process_.set_counters(estimator_.counters());
  process_.set_activity(
      estimator_.is_working() ? process_info_t::PHASE_WORKING : process_info_t::PHASE_WAITING,
      estimator_.activity());
}

}  // namespace bodyschema
