#include "processes/camera/capture.h"

#include <fcntl.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <condition_variable>
#include <cstring>
#include <filesystem>
#include <opencv2/videoio.hpp>
#include <opencv2/videoio/registry.hpp>
#include <stdexcept>
#include <vector>

#include "common/text/clock.h"
#include "common/text/text.h"

namespace bodyschema {
namespace {

constexpr int kStreamTimeout_ms = 5'000;

bool is_number(const std::string& text) {
  return !text.empty() && text.find_first_not_of("0123456789") == std::string::npos;
}

std::string device_path(const std::string& device) {
  return is_number(device) ? "/dev/video" + device : device;
}

std::string devices_there_are() {
  std::vector<std::string> names;
  std::error_code ignored;
  for (const auto& entry : std::filesystem::directory_iterator("/dev", ignored)) {
    const std::string name = entry.path().filename();
    if (name.starts_with("video")) names.push_back(entry.path());
  }
  std::sort(names.begin(), names.end());
  return names.empty() ? "there is no /dev/video* at all: is the camera plugged in?"
                       : "there are: " + listed(names);
}

bool has_backend(cv::VideoCaptureAPIs backend) {
  const auto all = cv::videoio_registry::getBackends();
  return std::find(all.begin(), all.end(), backend) != all.end();
}

}  // namespace

SourceKind kind_of(const std::string& device) {
  if (is_number(device) || device.starts_with("/dev/")) return SourceKind::kDevice;
  if (device.find("://") != std::string::npos) return SourceKind::kStream;
  if (device.find('%') != std::string::npos) return SourceKind::kSequence;
  return SourceKind::kFile;
}

std::string why_not_open(const std::string& device) {
  const std::string problem = "camera '" + device + "' cannot be opened: ";
  const std::string path = device_path(device);
  switch (kind_of(device)) {
    case SourceKind::kDevice: {
      const int file = open(path.c_str(), O_RDWR | O_NONBLOCK | O_CLOEXEC);
      if (file >= 0) {
        close(file);
        return problem +
               "it is busy with another program, or no capture device (some cameras have a second, "
               "metadata-only device). See: fuser -v " +
               path + "; v4l2-ctl --list-devices";
      }
      if (errno == ENOENT || errno == ENODEV || errno == ENXIO) {
        return problem + "no such device; " + devices_there_are();
      }
      if (errno == EACCES || errno == EPERM) {
        return problem + "no permission. Type: sudo usermod -aG video $USER, then log in again";
      }
      if (errno == EBUSY) return problem + "busy with another program. See: fuser -v " + path;
      return problem + std::strerror(errno);
    }
    case SourceKind::kStream: {
      std::string hint = "is it reachable, and the URL right? Try: ffplay '" + device + "'";
      if (!has_backend(cv::CAP_FFMPEG) && !has_backend(cv::CAP_GSTREAMER)) {
        hint = "this OpenCV has neither FFmpeg nor GStreamer";
      }
      return problem + hint;
    }
    case SourceKind::kSequence:
      return problem +
             "no first image of that pattern. It must be like frames/%04d.png and numbers must "
             "start near 0";
    case SourceKind::kFile: {
      std::error_code ignored;
      if (!std::filesystem::exists(path, ignored)) return problem + "no such file";
      if (!std::filesystem::is_regular_file(path, ignored)) return problem + "it is no file";
      if (access(path.c_str(), R_OK) != 0) return problem + "no permission to read it";
      return problem +
             "its format or codec is unknown to OpenCV. For GStreamer's decoders: sudo apt install "
             "gstreamer1.0-plugins-base gstreamer1.0-plugins-good gstreamer1.0-libav";
    }
  }
  return problem;
}

struct Capture::Source {
  cv::VideoCapture video;
  std::condition_variable_any wake;
  std::mutex wake_mutex;

  bool open(const CaptureConfig& config) {
    const SourceKind kind = kind_of(config.device);
    try {
      video.release();
      if (kind == SourceKind::kDevice) {
        // Its path, not its number: another backend might count differently.
        if (!video.open(device_path(config.device), cv::CAP_V4L2)) return false;
        video.set(cv::CAP_PROP_FRAME_WIDTH, config.width_px);
        video.set(cv::CAP_PROP_FRAME_HEIGHT, config.height_px);
        video.set(cv::CAP_PROP_FPS, config.max_rate_hz);
        // Old frames are worth nothing to a robot.
        video.set(cv::CAP_PROP_BUFFERSIZE, 1);
        return true;
      }
      if (kind == SourceKind::kSequence) return video.open(config.device, cv::CAP_IMAGES);
      // FFmpeg would wait half a minute for a stream whose cable was pulled.
      if (kind == SourceKind::kStream && has_backend(cv::CAP_FFMPEG) &&
          video.open(config.device, cv::CAP_FFMPEG,
                     {cv::CAP_PROP_OPEN_TIMEOUT_MSEC, kStreamTimeout_ms,
                      cv::CAP_PROP_READ_TIMEOUT_MSEC, kStreamTimeout_ms})) {
        return true;
      }
      return video.open(config.device);
    } catch (const cv::Exception&) {
      return false;
    }
  }
};

Capture::Capture(const CaptureConfig& config, OnFrame on_frame)
    : config_(config), on_frame_(std::move(on_frame)), source_(std::make_unique<Source>()) {
  if (!source_->open(config_)) throw std::runtime_error(why_not_open(config_.device));
  set_phase(Phase::kRunning, "captures " + config_.device);
  thread_ = std::jthread([this](const std::stop_token& stop) {
    try {
      run(stop);
    } catch (...) {
      const std::lock_guard lock(mutex_);
      failure_ = std::current_exception();
    }
  });
}

Capture::~Capture() = default;

Capture::State Capture::state() const {
  const std::lock_guard lock(mutex_);
  return state_;
}

void Capture::check() const {
  const std::lock_guard lock(mutex_);
  if (failure_) std::rethrow_exception(failure_);
}

void Capture::set_phase(Phase phase, const std::string& text) {
  const std::lock_guard lock(mutex_);
  state_.phase = phase;
  state_.text = text;
}

bool Capture::sleep(const std::stop_token& stop, std::int64_t duration_us) {
  std::unique_lock lock(source_->wake_mutex);
  source_->wake.wait_for(lock, stop, std::chrono::microseconds(duration_us), [] { return false; });
  return !stop.stop_requested();
}

void Capture::hand_on(const cv::Mat& frame, std::int64_t utime) {
  try {
    on_frame_(frame, utime);
  } catch (const std::invalid_argument& refusal) {
    // A camera that came back with another mode may change it again.
    const std::lock_guard lock(mutex_);
    ++state_.num_refused;
    state_.phase = Phase::kLost;
    state_.text = "refuses the frames of " + config_.device + ": " + refusal.what();
    return;
  }
  const std::lock_guard lock(mutex_);
  ++state_.num_frames;
  if (state_.phase != Phase::kRunning) state_.text = "captures " + config_.device;
  state_.phase = Phase::kRunning;
}

void Capture::run(const std::stop_token& stop) {
  const SourceKind kind = kind_of(config_.device);
  const bool is_recording = kind == SourceKind::kFile || kind == SourceKind::kSequence;
  const auto period_us = static_cast<std::int64_t>(1e6 / config_.max_rate_hz);
  constexpr std::int64_t kFirstRetry_us = 500'000, kLongestRetry_us = 10'000'000;
  std::int64_t retry_us = kFirstRetry_us;
  std::int64_t due_us = clock_us();
  cv::Mat frame;
  while (!stop.stop_requested()) {
    bool has_frame = false;
    std::int64_t utime = 0;
    try {
      has_frame = source_->video.grab();
      utime = wall_clock_us();
      // A live frame that comes too early is grabbed, so that the next is fresh, but not decoded.
      // Half a period of tolerance: a 30 Hz camera must pass a limit of 30 Hz.
      if (has_frame && !is_recording && clock_us() < due_us - period_us / 2) continue;
      has_frame = has_frame && source_->video.retrieve(frame) && !frame.empty();
    } catch (const cv::Exception&) {
      has_frame = false;
    }
    if (has_frame) {
      if (is_recording) {
        if (!sleep(stop, std::max<std::int64_t>(0, due_us - clock_us()))) return;
        utime = wall_clock_us();
      }
      due_us = std::max(due_us + period_us, clock_us());
      retry_us = kFirstRetry_us;
      hand_on(frame, utime);
      continue;
    }
    if (is_recording) {
      set_phase(Phase::kEnded, "video ended: " + config_.device);
      return;
    }
    {
      const std::lock_guard lock(mutex_);
      if (state_.phase == Phase::kRunning) ++state_.num_losses;
    }
    set_phase(Phase::kLost, "camera " + config_.device + " lost: tries again every " +
                                std::to_string(retry_us / 1'000'000) + "." +
                                std::to_string(retry_us / 100'000 % 10) + " s");
    source_->video.release();
    if (!sleep(stop, retry_us)) return;
    retry_us = std::min(2 * retry_us, kLongestRetry_us);
    source_->open(config_);
  }
}

}  // namespace bodyschema
