#include "tests/support/rendered_run.h"

#include <stdexcept>

#include "common/bus/convert.h"
#include "common/scene/scene_renderer.h"
#include "processes/camera/camera.h"
#include "processes/marker_estimator/marker_estimator.h"
#include "processes/model_monitor/model_monitor.h"
#include "processes/observer/observer.h"
#include "processes/robot_simulator/robot_simulator.h"
#include "processes/structure_learner/structure_learner.h"

namespace bodyschema::test {
namespace {

RobotSimulatorConfig simulator_config(const std::filesystem::path& rig_folder, std::int64_t seed,
                                      const std::set<int>& hidden_parts, bool is_ideal) {
  RobotSimulatorConfig config = RobotSimulatorConfig::load(rig_folder / "robot_simulator.yaml");
  config.seed = seed;
  config.hidden_parts = hidden_parts;
  config.is_ideal = is_ideal;
  return config;
}

ImageEffects effects(const SimulationConfig& simulation) {
  return {.blur_sd_px = simulation.blur_sd_px,
          .noise_sd = simulation.noise_sd,
          .pixel_samples = simulation.pixel_samples};
}

RigNoise noise_of(const std::filesystem::path& rig, bool is_ideal) {
  return load_noise(rig, is_ideal ? "ideal_noise.yaml" : "noise.yaml");
}

ObserverConfig observer_config(const std::filesystem::path& rig, bool is_ideal) {
  ObserverConfig config = ObserverConfig::load(rig / "observer.yaml");
  config.part_pose.calibration = noise_of(rig, is_ideal).measurement.tags;
  return config;
}

StructureLearnerConfig learner_config(const std::filesystem::path& rig, bool is_ideal) {
  StructureLearnerConfig config = StructureLearnerConfig::load(rig / "structure_learner.yaml");
  config.options.measurement = noise_of(rig, is_ideal).measurement;
  return config;
}

ModelMonitorConfig monitor_config(const std::filesystem::path& rig, bool is_ideal) {
  ModelMonitorConfig config = ModelMonitorConfig::load(rig / "model_monitor.yaml");
  config.measurement = noise_of(rig, is_ideal).measurement;
  return config;
}

}  // namespace

struct RenderedRun::Implementation {
  Implementation(const std::filesystem::path& rig, std::int64_t seed,
                 const std::set<int>& hidden_parts, std::optional<Choice> choice, bool is_ideal)
      : camera_config(CameraConfig::load(rig / "camera.yaml")),
        simulator(simulator_config(rig, seed, hidden_parts, is_ideal)),
        renderer(SceneDescription::load(rig, is_ideal ? std::nullopt : std::optional(seed)),
                 effects(camera_config.simulation.value())),
        camera(camera_config, [this](const sim_state_t& state,
                                     int frame) { return renderer.render(state, frame); }),
        estimator(MarkerEstimatorConfig::load(rig / "marker_estimator.yaml"), load_markers(rig)),
        observer(observer_config(rig, is_ideal), load_markers(rig)),
        babbler_config(endless(MotorBabblerConfig::load(rig / "motor_babbler.yaml"), choice)),
        babbler(babbler_config, seed),
        learner(learner_config(rig, is_ideal)),
        monitor(monitor_config(rig, is_ideal)) {
    const camera_info_t info = make_info(camera_config.calibration, 0);
    estimator.on_camera_info(info);
    observer.on_camera_info(info);
    babbler.on_control_status(control_status_t{});  // nobody else wants the arm
  }

  static MotorBabblerConfig endless(MotorBabblerConfig config, std::optional<Choice> choice) {
    config.stop.min_samples = config.stop.max_samples = 1'000'000'000;
    config.choice = choice.value_or(config.choice);
    return config;
  }

  /// The messages to the babbler after a sample, up to its next command.
  std::optional<action_command_t> answer_to(const sample_t& sample) {
    babbler.remember(sample);
    auto next = babbler.on_sample(sample);
    const bool is_active = babbler_config.choice == Choice::kActive;
    if (is_active) {
      learner.on_sample(sample);
      monitor.on_sample(sample);
      if (monitor.schema()) learner.on_body_schema(*monitor.schema());
    }
    if (next) return next;
    // It waits for the verdict on a TEST sample.
    if (!is_active) {
      model_health_t verdict{};
      verdict.judged_sample = sample.sample_index;
      verdict.worst_position_m = verdict.worst_rotation_rad = -1;
      return babbler.on_model_health(verdict);
    }
    while (learner.has_test_job()) monitor.on_learned_schema(learner.take_job()());
    if (monitor.schema()) babbler.on_body_schema(*monitor.schema());
    return babbler.on_model_health(monitor.health());
  }

  const CameraConfig camera_config;
  RobotSimulator simulator;
  SceneRenderer renderer;
  SimulatedCamera camera;
  MarkerEstimator estimator;
  Observer observer;
  const MotorBabblerConfig babbler_config;
  MotorBabbler babbler;
  StructureLearner learner;
  ModelMonitor monitor;
  std::optional<action_command_t> command;
  std::int64_t num_faults = 0;
};

RenderedRun::RenderedRun(const std::filesystem::path& rig_folder, std::int64_t seed,
                         const std::set<int>& hidden_parts, std::optional<Choice> choice,
                         bool is_ideal)
    : implementation_(
          std::make_unique<Implementation>(rig_folder, seed, hidden_parts, choice, is_ideal)) {}

RenderedRun::~RenderedRun() = default;

int RenderedRun::num_rejected() const {
  return static_cast<int>(implementation_->babbler.num_rejected());
}

const ModelMonitor& RenderedRun::monitor() const { return implementation_->monitor; }

void RenderedRun::break_body(std::int8_t fault, const std::string& place, int number,
                             double amount_deg) {
  Implementation& run = *implementation_;
  fault_command_t command{};
  command.sender = "test";
  command.epoch = 1;
  command.fault_id = run.num_faults++;
  command.fault = fault;
  command.place = place;
  command.number = number;
  command.amount_deg = amount_deg;
  const RobotSimulator::Answer answer = run.simulator.on_fault(command);
  if (answer.state && !answer.state->fault_answer.empty())
    throw std::runtime_error(answer.state->fault_answer);
  for (const motion_status_t& status : answer.statuses) run.observer.on_motion_status(status);
}

RenderedRun::Step RenderedRun::next() {
  Implementation& run = *implementation_;
  if (!run.command) run.command = run.babbler.on_motion_status(run.simulator.status());
  for (;;) {
    if (!run.command) throw std::logic_error("the babbler gave no action");
    const RobotSimulator::Answer answer = run.simulator.on_command(*run.command);
    std::optional<sample_t> sample;
    std::optional<action_command_t> next_command;
    for (const motion_status_t& status : answer.statuses) {
      if (auto command = run.babbler.on_motion_status(status)) next_command = command;
      if (auto seen = run.observer.on_motion_status(status)) sample = seen;
    }
    if (!answer.state) {
      run.command = next_command;
      continue;
    }
    for (const camera_image_t& image : run.camera.on_sim_state(*answer.state)) {
      const auto markers = run.estimator.on_camera_image(image);
      if (!markers) throw std::logic_error("the marker estimator refused an image");
      if (auto seen = run.observer.on_marker_poses(*markers)) sample = seen;
    }
    if (!sample) throw std::logic_error("a settled action gave no sample");

    Step step{*sample, from_message(*sample), {}};
    const Pose X_CW = from_message(answer.state->X_WC).inverse();
    for (std::size_t i = 0; i < answer.state->true_part.size(); ++i) {
      step.truth[answer.state->true_part[i]] = X_CW * from_message(answer.state->X_WB[i]);
    }
    run.command = run.answer_to(*sample);
    return step;
  }
}

}  // namespace bodyschema::test
