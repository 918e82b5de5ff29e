#include "processes/camera/camera_process.h"

#include <stdexcept>

#include "common/bus/images_url.h"
#include "common/config/yaml.h"

namespace bodyschema {
namespace {

constexpr int kMaxRepeats = 30;  // of the images of one SIM_STATE, at 1 Hz

}  // namespace

void CameraProcess::Options::add_to(Arguments app) {
  app.add_option("--images", images_url, "URL of the images; default: the next port of --out");
  app.add_flag("--ideal", is_ideal, "Simulated: without robot.yaml's calibration errors");
}

CameraProcess::CameraProcess(Process& process, const Options& options)
    : process_(process),
      config_(CameraConfig::load(process.config_file())),
      is_ideal_(options.is_ideal) {
  const std::string& out = process.out_url();
  const std::string images = options.images_url.empty() ? images_url(out) : options.images_url;
  if (images != out) images_bus_.emplace("", images);
  send_info();
  process.on_tick([this](std::int64_t now_us) { on_tick(now_us); });
  if (config_.simulation) {
    start_simulation(*config_.simulation);
  } else {
    start_capture();
  }
}

void CameraProcess::start_simulation(const SimulationConfig& simulation) {
  effects_ = {.blur_sd_px = simulation.blur_sd_px,
              .noise_sd = simulation.noise_sd,
              .pixel_samples = simulation.pixel_samples};
  const SceneDescription ideal = SceneDescription::load(process_.rig_folder());
  if (const auto problem = lens_problem(ideal.robot.lens, config_.calibration))
    throw ConfigError("robot.yaml: lens: " + *problem);
  renderer_.emplace(ideal, effects_);
  simulated_.emplace(config_,
                     [this](const sim_state_t& state, int frame) { return render(state, frame); });
  door_.emplace(process_.rig_folder());
  door_->subscribe(process_, kSimState, [this](const sim_state_t& state) { on_sim_state(state); });
  process_.set_activity(process_info_t::PHASE_WAITING, "waits for SIM_STATE");
}

void CameraProcess::on_sim_state(const sim_state_t& state) {
  if (const auto problem = ideal_problem(is_ideal_, state)) {
    process_.count("refused SIM_STATE");
    process_.set_activity(process_info_t::PHASE_WAITING, *problem);
    return;
  }
  // Repeated for consumers that missed them, with a bound: an arm that was left alone would fill
  // the disk with the same images.
  num_repeats_ = state.utime == shown_utime_ ? num_repeats_ + 1 : 0;
  shown_utime_ = state.utime;
  if (num_repeats_ > kMaxRepeats) return;
  try {
    for (const camera_image_t& image : simulated_->on_sim_state(state)) {
      images().publish(kCameraImage, image);
      utime_ = image.utime;
    }
  } catch (const std::invalid_argument&) {
    process_.count("refused SIM_STATE");  // another rig's
    return;
  }
  process_.set_activity(process_info_t::PHASE_WORKING,
                        "shows action " + std::to_string(state.action_id));
}

// SIM_STATE's seed says which robot it is.
cv::Mat CameraProcess::render(const sim_state_t& state, int frame) {
  if (!is_ideal_ && rendered_seed_ != state.seed) {
    renderer_.emplace(SceneDescription::load(process_.rig_folder(), state.seed), effects_);
    rendered_seed_ = state.seed;
  }
  return renderer_->render(state, frame);
}

void CameraProcess::start_capture() {
  capture_.emplace(*config_.capture,
                   [this](const cv::Mat& frame, std::int64_t utime) { on_frame(frame, utime); });
  process_.on_idle([this] { say_capture(); });
}

void CameraProcess::on_frame(const cv::Mat& frame, std::int64_t utime) {
  images().publish(kCameraImage,
                   make_image(frame, config_.calibration, config_.encoding, utime, image_seq_++));
  utime_ = utime;
}

void CameraProcess::say_capture() {
  capture_->check();
  const Capture::State state = capture_->state();
  process_.set_counters({{"camera lost", state.num_losses},
                         {"frame", state.num_frames},
                         {"frame refused", state.num_refused}});
  process_.set_activity(state.phase == Capture::Phase::kRunning ? process_info_t::PHASE_WORKING
                                                                : process_info_t::PHASE_WAITING,
                        state.text);
}

void CameraProcess::on_tick(std::int64_t now_us) {
  if (now_us - info_sent_us_ < 1'000'000) return;
  info_sent_us_ = now_us;
  send_info();
}

void CameraProcess::send_info() {
  process_.bus().publish(kCameraInfo, make_info(config_.calibration, utime_));
}

}  // namespace bodyschema
