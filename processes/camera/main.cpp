// camera: device or SIM_STATE -> CAMERA_IMAGE, CAMERA_INFO

#include <atomic>
#include <optional>
#include <stdexcept>
#include <utility>

#include "common/bus/images_url.h"
#include "common/bus/process.h"
#include "common/bus/rig_door.h"
#include "common/config/yaml.h"
#include "common/scene/scene_renderer.h"
#include "processes/camera/camera.h"
#include "processes/camera/capture.h"

using namespace bodyschema;

namespace {
constexpr int kMaxRepeats = 30;  // of the images of one SIM_STATE, at 1 Hz
}

int main(int argc, char** argv) {
  std::string images_option;
  bool is_ideal = false;
  std::optional<Arguments> arguments;
  const auto add_options = [&](Arguments app) {
    arguments = app;
    app.add_option("--images", images_option, "URL of the images; default: the next port of --out");
    app.add_flag("--ideal", is_ideal, "Simulated: without robot.yaml's calibration errors");
  };
  const auto body = [&](Process& process) {
    const CameraConfig config = CameraConfig::load(process.config_file());
    const auto url = [&](const char* option) {
      const auto text = arguments->text_of(option);
      return text.empty() ? default_url() : text;
    };
    const bool has_out = arguments->is_given("--out");
    const std::string out = has_out ? url("--out") : process.bus().is_replay() ? "" : url("--in");
    const std::string images_to = images_option.empty() ? images_url(out) : images_option;
    std::optional<Bus> images_bus;
    if (images_to != out) images_bus.emplace("", images_to);
    Bus& images = images_bus ? *images_bus : process.bus();

    std::atomic<std::int64_t> utime = 0;  // of the newest frame
    const auto send_info = [&] {
      process.bus().publish(kCameraInfo, make_info(config.calibration, utime));
    };
    send_info();
    std::int64_t info_sent_us = 0;
    process.on_tick([&](std::int64_t now_us) {
      if (now_us - info_sent_us < 1'000'000) return;
      info_sent_us = now_us;
      send_info();
    });

    std::optional<RigDoor> door;
    std::optional<SceneRenderer> renderer;
    std::optional<SimulatedCamera> simulated;
    std::optional<Capture> capture;
    if (config.simulation) {
      const SimulationConfig& simulation = *config.simulation;
      const ImageEffects effects{.blur_sd_px = simulation.blur_sd_px,
                                 .noise_sd = simulation.noise_sd,
                                 .msaa_samples = simulation.msaa_samples};
      const SceneDescription ideal = SceneDescription::load(process.rig_folder());
      if (const auto problem = lens_problem(ideal.robot.lens, config.calibration))
        throw ConfigError("robot.yaml: lens: " + *problem);
      renderer.emplace(ideal, effects);
      // Which robot it is, the seed says, and that SIM_STATE.
      std::optional<std::int64_t> seed;
      simulated.emplace(config, [&, effects, seed](const sim_state_t& state, int frame) mutable {
        if (!is_ideal && seed != state.seed) {
          renderer.emplace(SceneDescription::load(process.rig_folder(), state.seed), effects);
          seed = state.seed;
        }
        return renderer->render(state, frame);
      });
      door.emplace(process.rig_folder());
      door->subscribe(
          process, kSimState,
          [&, shown_utime = std::int64_t{-1}, num_repeats = 0](const sim_state_t& state) mutable {
            // Repeated for who missed them, but not for ever: an arm that was left alone would fill
            // the disk with the same images.
            if (const auto problem = ideal_problem(is_ideal, state)) {
              process.count("refused SIM_STATE");
              process.set_activity(process_info_t::PHASE_WAITING, *problem);
              return;
            }
            num_repeats = state.utime == shown_utime ? num_repeats + 1 : 0;
            shown_utime = state.utime;
            if (num_repeats > kMaxRepeats) return;
            try {
              for (const camera_image_t& image : simulated->on_sim_state(state)) {
                images.publish(kCameraImage, image);
                utime = image.utime;
              }
            } catch (const std::invalid_argument&) {
              process.count("refused SIM_STATE");  // another rig's
              return;
            }
            process.set_activity(process_info_t::PHASE_WORKING,
                                 "shows action " + std::to_string(state.action_id));
          });
      process.set_activity(process_info_t::PHASE_WAITING, "waits for SIM_STATE");
    } else {
      std::int64_t image_seq = 0;
      capture.emplace(
          *config.capture, [&, image_seq](const cv::Mat& frame, std::int64_t now_us) mutable {
            images.publish(kCameraImage, make_image(frame, config.calibration, config.encoding,
                                                    now_us, image_seq++));
            utime = now_us;
          });
      process.on_idle([&] {
        capture->check();
        const Capture::State state = capture->state();
        process.set_counters({{"camera lost", state.num_losses},
                              {"frame", state.num_frames},
                              {"frame refused", state.num_refused}});
        process.set_activity(state.phase == Capture::Phase::kRunning
                                 ? process_info_t::PHASE_WORKING
                                 : process_info_t::PHASE_WAITING,
                             state.text);
      });
    }
    process.run();
  };
  return run_process("camera", argc, argv, body, add_options);
}
