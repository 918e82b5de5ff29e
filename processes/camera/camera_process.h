#pragma once

#include <atomic>
#include <cstdint>
#include <optional>
#include <string>

#include "common/bus/rig_door.h"
#include "common/scene/scene_renderer.h"
#include "processes/camera/camera.h"
#include "processes/camera/capture.h"

namespace bodyschema {

/// The camera on a bus: images on a bus of their own, CAMERA_INFO at the start and at 1 Hz. Images
/// of a SIM_STATE that is repeated are repeated with it, kMaxRepeats times.
class CameraProcess {
 public:
  struct Options {
    std::string images_url;
    bool is_ideal = false;
    void add_to(Arguments app);
  };
  CameraProcess(Process& process, const Options& options);
  CameraProcess(const CameraProcess&) = delete;

 private:
  void start_simulation(const SimulationConfig& simulation);
  void start_capture();
  void on_sim_state(const sim_state_t& state);
  cv::Mat render(const sim_state_t& state, int frame);
  void on_frame(const cv::Mat& frame, std::int64_t utime);
  void on_tick(std::int64_t now_us);
  void say_capture();
  void send_info();
  Bus& images() { return images_bus_ ? *images_bus_ : process_.bus(); }

  Process& process_;
  const CameraConfig config_;
  const bool is_ideal_;
  std::optional<Bus> images_bus_;        ///< unless images share the process's bus
  std::atomic<std::int64_t> utime_ = 0;  ///< of the newest frame
  std::int64_t info_sent_us_ = 0;

  // Simulated.
  std::optional<RigDoor> door_;
  ImageEffects effects_;
  std::optional<SceneRenderer> renderer_;
  std::optional<std::int64_t> rendered_seed_;  ///< of the robot that renderer_ shows
  std::optional<SimulatedCamera> simulated_;
  std::int64_t shown_utime_ = -1;
  int num_repeats_ = 0;

  // Captured.
  std::int64_t image_seq_ = 0;
  std::optional<Capture> capture_;  ///< last: its thread uses the above
};

}  // namespace bodyschema
