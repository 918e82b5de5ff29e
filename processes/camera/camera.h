#pragma once

#include <cstdint>
#include <filesystem>
#include <functional>
#include <opencv2/core/mat.hpp>
#include <optional>
#include <string>
#include <vector>

#include "bodyschema/camera_image_t.hpp"
#include "bodyschema/camera_info_t.hpp"
#include "bodyschema/sim_state_t.hpp"
#include "common/config/camera_calibration.h"

namespace bodyschema {

/// Encoding of the frames.
struct ImageEncoding {
  std::int8_t format = camera_image_t::ENCODING_JPEG;  ///< camera_image_t::ENCODING_*
  int jpeg_quality = 0;                                ///< 1 … 100
};

/// Source of the frames if there is a real camera, or a recording of one.
struct CaptureConfig {
  /// "/dev/video0" or "0"; a stream's URL; a video file; an image sequence ("frames/%04d.png").
  std::string device;
  int width_px = 0;  ///< asked of a V4L2 device; the frames must have the calibration's size anyway
  int height_px = 0;
  double max_rate_hz = 0;  ///< frames above it are skipped; a file is played at it at most
};

struct SimulationConfig {
  int frames_per_action = 0;
  double blur_sd_px = 0;
  double noise_sd = 0;    ///< grey levels
  int pixel_samples = 1;  ///< see ImageEffects
};

/// camera.yaml: exactly one of `capture` and `simulation`.
struct CameraConfig {
  CameraCalibration calibration;
  ImageEncoding encoding;
  std::optional<CaptureConfig> capture;
  std::optional<SimulationConfig> simulation;

  /// @throws ConfigError.
  static CameraConfig load(const std::filesystem::path& file);
};

/// Why robot.yaml's lens does not fit the rig's calibration (another size); "" if it does.
std::optional<std::string> lens_problem(const CameraCalibration& lens,
                                        const CameraCalibration& calibration);

/// The message for a frame of any depth and number of channels: 8-bit grey, encoded.
/// @throws std::invalid_argument if the frame is empty, of an unknown format or not of the
/// calibration's size.
camera_image_t make_image(const cv::Mat& frame, const CameraCalibration& calibration,
                          const ImageEncoding& encoding, std::int64_t utime,
                          std::int64_t image_seq);

/// CAMERA_INFO. `utime`: of the newest frame, 0 before the first.
camera_info_t make_info(const CameraCalibration& calibration, std::int64_t utime);

/// Why a camera that was started `is_ideal` must not show a SIM_STATE: the simulator was started
/// otherwise, so tags and lens would not be those of the robot.
std::optional<std::string> ideal_problem(bool is_ideal, const sim_state_t& state);

/// The simulated camera: for every SIM_STATE the frames_per_action images that a camera of 30 Hz
/// would have taken from then on. Frame f of a state has utime = state.utime + f · 33 333 µs and
/// image_seq = (action_id + 1) · frames_per_action + f, so both are the same from run to run.
///
/// Before the first SIM_STATE it shows nothing. A repeated state gives the same images again, byte
/// by byte and without rendering: consumers recognise them by utime, and one that missed an image
/// gets it then.
class SimulatedCamera {
 public:
  using Render = std::function<cv::Mat(const sim_state_t&, int frame)>;

  SimulatedCamera(CameraConfig config, Render render);

  /// @throws what `render` throws, e.g. if the state is of another rig.
  const std::vector<camera_image_t>& on_sim_state(const sim_state_t& state);

  static constexpr std::int64_t kFramePeriod_us = 33'333;

 private:
  const CameraConfig config_;
  const Render render_;
  std::vector<std::uint8_t> state_bytes_;  ///< of the state that images_ show
  std::vector<camera_image_t> images_;
};

}  // namespace bodyschema
