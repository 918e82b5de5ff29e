#pragma once

#include <exception>
#include <mutex>
#include <optional>
#include <string>
#include <thread>

#include "common/bus/rig_door.h"
#include "processes/marker_estimator/marker_estimator.h"

namespace bodyschema {

/// The marker estimator on a bus, and on that of the images. A live bus of images is waited for by
/// a thread of its own, so that a frame need not wait for the loop's next round. Logs are read in
/// the loop: first the calibration, then its images.
class MarkerEstimatorProcess {
 public:
  struct Options {
    std::string images_url;
    void add_to(Arguments app);
  };
  MarkerEstimatorProcess(Process& process, const Options& options);
  MarkerEstimatorProcess(const MarkerEstimatorProcess&) = delete;

 private:
  void subscribe_images(Bus& bus);
  void listen(const std::stop_token& stop);
  void on_image(const camera_image_t& image);
  void on_camera_info(const camera_info_t& info);
  void on_idle();

  Process& process_;
  const MarkerEstimatorConfig config_;
  const RigDoor door_;
  std::mutex mutex_;  ///< guards estimator_ and failure_
  MarkerEstimator estimator_;
  std::exception_ptr failure_;  ///< of the listener
  std::optional<Bus> images_;   ///< unless images share the process's bus
  std::jthread listener_;       ///< last: it uses the above
};

}  // namespace bodyschema
