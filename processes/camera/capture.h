#pragma once

#include <cstdint>
#include <exception>
#include <functional>
#include <memory>
#include <mutex>
#include <opencv2/core/mat.hpp>
#include <string>
#include <thread>

#include "processes/camera/camera.h"

namespace bodyschema {

/// Kind of source that CaptureConfig::device names.
enum class SourceKind { kDevice, kStream, kSequence, kFile };
SourceKind kind_of(const std::string& device);

/// Reason why OpenCV cannot open it and a remedy, for people: no such device (with those there
/// are), no permission, busy, no such file, no decoder.
std::string why_not_open(const std::string& device);

/// Reads a camera, stream, video or image sequence in a thread of its own, so that no caller waits
/// for a slow device, and delivers each frame with the clock's time at which it was grabbed.
///
/// A device or stream that vanishes is opened again after 0.5, 1, 2 … 10 s, for ever; a stream that
/// delivers nothing for 5 s (a V4L2 device: 10 s, OpenCV's own limit) has vanished. A file or
/// sequence that is at its end stays there.
/// state() says which.
class Capture {
 public:
  /// Called from the capture's thread. A frame for which it throws std::invalid_argument is refused
  /// and counted; any other exception ends the capture and is rethrown by check().
  using OnFrame = std::function<void(const cv::Mat& frame, std::int64_t utime)>;
  enum class Phase { kRunning, kLost, kEnded };
  struct State {
    Phase phase = Phase::kRunning;
    std::string text;  ///< for people
    std::int64_t num_frames = 0;
    std::int64_t num_losses = 0;
    std::int64_t num_refused = 0;
  };

  /// @throws std::runtime_error with why_not_open() if the source cannot be opened now.
  Capture(const CaptureConfig& config, OnFrame on_frame);
  ~Capture();

  State state() const;
  /// Rethrows the exception that ended the capture, if there was one.
  void check() const;

 private:
  void run(const std::stop_token& stop);
  void hand_on(const cv::Mat& frame, std::int64_t utime);
  bool sleep(const std::stop_token& stop, std::int64_t duration_us);
  void set_phase(Phase phase, const std::string& text);

  struct Source;
  const CaptureConfig config_;
  const OnFrame on_frame_;
  std::unique_ptr<Source> source_;
  mutable std::mutex mutex_;  // guards state_ and failure_
  State state_;
  std::exception_ptr failure_;
  std::jthread thread_;  // last: it uses all of the above
};

}  // namespace bodyschema
