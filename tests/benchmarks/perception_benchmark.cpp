// From an image to a SAMPLE, beside AprilTag's detector alone on the same images: the rendered
// views of 20 random actions of a rig, two frames each. One iteration is one action.

#include <apriltag/apriltag.h>
#include <apriltag/tag36h11.h>
#include <benchmark/benchmark.h>

#include <iostream>
#include <opencv2/imgcodecs.hpp>
#include <stdexcept>

#include "common/bus/convert.h"
#include "common/scene/scene.h"
#include "common/scene/scene_renderer.h"
#include "processes/camera/camera.h"
#include "processes/marker_estimator/marker_estimator.h"
#include "processes/motor_babbler/motor_babbler.h"
#include "processes/observer/observer.h"
#include "tests/benchmarks/ratio_reporter.h"

namespace bodyschema::test {
namespace {

const std::filesystem::path kRig = "config/arm7";
constexpr int kActions = 20;

/// Images of one action at rest: encoded, and decoded.
struct View {
  std::vector<camera_image_t> jpeg;
  std::vector<camera_image_t> grey;
  motion_status_t settled;
};

const std::vector<View>& views() {
  static const std::vector<View> all = [] {
    const Scene scene(kRig);
    const CameraConfig config = CameraConfig::load(kRig / "camera.yaml");
    SceneRenderer renderer(kRig, config.calibration,
                           {.blur_sd_px = config.simulation->blur_sd_px,
                            .noise_sd = config.simulation->noise_sd,
                            .pixel_samples = config.simulation->pixel_samples});
    SimulatedCamera camera(
        config, [&](const sim_state_t& state, int frame) { return renderer.render(state, frame); });
    const MotorBabblerConfig babbler = MotorBabblerConfig::load(kRig / "motor_babbler.yaml");
    std::vector<View> views;
    for (int id = 0; id < kActions; ++id) {
      const Eigen::VectorXd action = random_action(babbler, 1, id);
      sim_state_t state = scene.state_at(action, 1, id);
      state.utime = (id + 1) * std::int64_t{1'000'000};
      View& view = views.emplace_back();
      for (const camera_image_t& jpeg : camera.on_sim_state(state)) {
        view.jpeg.push_back(jpeg);
        camera_image_t& grey = view.grey.emplace_back(jpeg);
        const cv::Mat pixels = cv::imdecode(jpeg.data, cv::IMREAD_GRAYSCALE);
        grey.encoding = camera_image_t::ENCODING_GREY;
        set_array(grey.num_bytes, grey.data,
                  std::vector<std::uint8_t>(pixels.datastart, pixels.dataend));
      }
      motion_status_t& settled = view.settled;
      settled.utime = settled.rest_since_utime = state.utime;
      settled.source = "motor_babbler";
      settled.epoch = 1;
      settled.action_id = id;
      settled.state = motion_status_t::STATE_SETTLED;
      set_array(settled.num_signals, settled.commanded,
                std::vector<double>(action.data(), action.data() + action.size()));
    }
    return views;
  }();
  return all;
}

/// The peer: AprilTag's detector, set up as ours, with nothing around it.
void AprilTagAlone(benchmark::State& state) {
  const auto config = MarkerEstimatorConfig::load(kRig / "marker_estimator.yaml");
  apriltag_family_t* family = tag36h11_create();
  apriltag_detector_t* detector = apriltag_detector_create();
  apriltag_detector_add_family_bits(detector, family, config.max_hamming);
  detector->nthreads = 1;
  detector->quad_decimate = 1;
  detector->refine_edges = true;
  detector->qtp.min_white_black_diff = config.min_white_black_difference;
  std::int64_t tags = 0;
  for (std::size_t i = 0; auto _ : state) {
    for (const camera_image_t& image : views()[i++ % kActions].grey) {
      image_u8_t pixels{image.width, image.height, image.width,
                        const_cast<std::uint8_t*>(image.data.data())};
      zarray_t* found = apriltag_detector_detect(detector, &pixels);
      tags += zarray_size(found);
      apriltag_detections_destroy(found);
    }
  }
  state.counters["tags"] =
      benchmark::Counter(static_cast<double>(tags), benchmark::Counter::kAvgIterations);
  apriltag_detector_destroy(detector);
  tag36h11_destroy(family);
}

/// Marker estimator and observer: every image becomes marker poses, every action a sample.
void image_to_sample(benchmark::State& state, std::vector<camera_image_t> View::*images) {
  MarkerEstimator estimator(MarkerEstimatorConfig::load(kRig / "marker_estimator.yaml"),
                            load_markers(kRig));
  Observer observer(ObserverConfig::load(kRig / "observer.yaml"), load_markers(kRig));
  const CameraConfig camera = CameraConfig::load(kRig / "camera.yaml");
  estimator.on_camera_info(make_info(camera.calibration, 0));
  observer.on_camera_info(make_info(camera.calibration, 0));
  std::int64_t parts = 0, tags = 0;
  for (std::size_t i = 0; auto _ : state) {
    const View& view = views()[i % kActions];
    // Each round of the actions is later than the one before: samples are made once.
    const std::int64_t later_us = static_cast<std::int64_t>(i++ / kActions) * kActions * 1'000'000;
    motion_status_t settled = view.settled;
    settled.utime = settled.rest_since_utime += later_us;
    settled.action_id += later_us;
    std::optional<sample_t> sample = observer.on_motion_status(settled);
    for (const camera_image_t& image : view.*images) {
      auto poses = estimator.on_camera_image(image);
      poses->utime += later_us;
      tags += poses->num_markers;
      if (auto made = observer.on_marker_poses(*poses)) sample = std::move(made);
    }
    if (!sample) throw std::logic_error("an action gave no sample");
    parts += sample->num_parts;
  }
  state.counters["tags"] =
      benchmark::Counter(static_cast<double>(tags), benchmark::Counter::kAvgIterations);
  state.counters["parts"] =
      benchmark::Counter(static_cast<double>(parts), benchmark::Counter::kAvgIterations);
}

void ImageToSample(benchmark::State& state) { image_to_sample(state, &View::grey); }
void JpegToSample(benchmark::State& state) { image_to_sample(state, &View::jpeg); }

/// The share of OpenCV's decoder in JpegToSample.
void DecodeJpeg(benchmark::State& state) {
  for (std::size_t i = 0; auto _ : state) {
    for (const camera_image_t& image : views()[i++ % kActions].jpeg) {
      benchmark::DoNotOptimize(cv::imdecode(image.data, cv::IMREAD_GRAYSCALE));
    }
  }
}

BENCHMARK(AprilTagAlone)->Unit(benchmark::kMillisecond);
BENCHMARK(ImageToSample)->Unit(benchmark::kMillisecond);
BENCHMARK(JpegToSample)->Unit(benchmark::kMillisecond);
BENCHMARK(DecodeJpeg)->Unit(benchmark::kMillisecond);

}  // namespace
}  // namespace bodyschema::test

int main(int argc, char** argv) {
  benchmark::Initialize(&argc, argv);
  bodyschema::test::views();
  bodyschema::test::RatioReporter reporter(
      {{"ImageToSample", "AprilTagAlone"}, {"JpegToSample", "AprilTagAlone"}});
  benchmark::RunSpecifiedBenchmarks(&reporter);
}
