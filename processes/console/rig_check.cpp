#include "processes/console/rig_check.h"

#include <fmt/format.h>

#include <algorithm>
#include <exception>
#include <fstream>
#include <functional>
#include <nlohmann/json.hpp>
#include <optional>
#include <set>
#include <stdexcept>
#include <utility>

#include "common/config/camera_calibration.h"
#include "common/config/rig.h"
#include "common/config/yaml.h"
#include "common/scene/scene.h"
#include "common/text/text.h"
#include "processes/camera/camera.h"
#include "processes/console/adoption.h"
#include "processes/controller/controller.h"
#include "processes/marker_estimator/marker_estimator.h"
#include "processes/model_monitor/model_monitor.h"
#include "processes/motor_babbler/motor_babbler.h"
#include "processes/observer/observer.h"
#include "processes/refiner/refiner_config.h"
#include "processes/robot_simulator/robot_simulator.h"
#include "processes/structure_learner/structure_learner.h"

namespace bodyschema {
namespace {

using std::filesystem::path;

/// Settings that several files of the rig share; none where the file could not be read.
struct Rig {
  std::optional<Signals> signals;
  std::optional<Markers> markers;
  std::optional<CameraConfig> camera;
  std::optional<ObserverConfig> observer;
};

class Check {
 public:
  explicit Check(const path& folder) : folder_(folder) {}

  RigCheck run() {
    read_files();
    if (rig_.signals && rig_.markers) check_parts();
    if (is_simulated() && rig_.observer) check_frames(rig_.camera->simulation->frames_per_action);
    if (is_simulated() && rig_.markers)
      check_target_tags(rig_.camera->simulation->frames_per_action);
    remark_unread_files();
    if (rig_.signals) result_.num_signals = static_cast<int>(rig_.signals->signals.size());
    if (rig_.markers) {
      result_.num_parts = static_cast<int>(rig_.markers->parts().size());
      result_.num_tags = static_cast<int>(rig_.markers->tags.size());
    }
    return std::move(result_);
  }

 private:
  bool has(const std::string& name) const { return std::filesystem::exists(folder_ / name); }
  bool is_simulated() const { return rig_.camera && rig_.camera->simulation.has_value(); }

  /// Every problem once: signals.yaml is read by several processes.
  void add_problem(const std::string& problem) {
    if (std::ranges::find(result_.problems, problem) == result_.problems.end())
      result_.problems.push_back(problem);
  }

  /// `problem` at a key of a file that can be read.
  void add_problem(const std::string& name, const std::string& key, const std::string& problem) {
    add_problem(Yaml::load(folder_ / name).error(key, problem).what());
  }

  bool guarded(const std::function<void()>& read) {
    try {
      read();
      return true;
    } catch (const std::exception& error) {
      add_problem(error.what());
      return false;
    }
  }

  void read_files() {
    guarded([&] { rig_.signals = load_signals(folder_); });
    guarded([&] { rig_.markers = load_markers(folder_); });
    guarded([&] { load_noise(folder_); });
    if (has("ideal_noise.yaml")) guarded([&] { load_noise(folder_, "ideal_noise.yaml"); });
    guarded([&] { load_network(folder_); });
    read_.insert(
        {"signals.yaml", "markers.yaml", "noise.yaml", "ideal_noise.yaml", "network.yaml"});
    const auto of_process = [&](const std::string& name, auto load, bool is_needed = true) {
      read_.insert(name);
      if (is_needed || has(name)) guarded([&] { load(folder_ / name); });
    };
    of_process("camera.yaml", [&](const path& file) {
      read_.insert("camera_info.yaml");  // unless another name is told
      rig_.camera = CameraConfig::load(file);
    });
    of_process("observer.yaml",
               [&](const path& file) { rig_.observer = ObserverConfig::load(file); });
    of_process("marker_estimator.yaml", MarkerEstimatorConfig::load);
    of_process("structure_learner.yaml", StructureLearnerConfig::load);
    of_process("model_monitor.yaml", ModelMonitorConfig::load);
    of_process("motor_babbler.yaml", MotorBabblerConfig::load);
    of_process("controller.yaml", ControllerConfig::load, false);
    of_process("refiner.yaml", RefinerConfig::load, false);
    of_process("robot_simulator.yaml", RobotSimulatorConfig::load, is_simulated());
    read_.insert("robot.yaml");
    if ((is_simulated() || has("robot_simulator.yaml") || has("robot.yaml")) && rig_.signals &&
        rig_.markers)
      guarded([&] {
        const Scene scene(folder_);
        if (!rig_.camera) return;
        if (const auto problem = lens_problem(scene.robot().lens, rig_.camera->calibration))
          add_problem("robot.yaml", "lens", *problem);
      });
    if (rig_.camera) {
      // By whatever name camera.yaml tells.
      const path calibration = Yaml::load(folder_ / "camera.yaml").text("calibration");
      if (calibration.is_relative()) read_.insert(calibration.lexically_normal().string());
    }
  }

  void check_parts() {
    const std::vector<int> parts = rig_.markers->parts();
    const auto has_tag = [&](int part) { return std::ranges::binary_search(parts, part); };
    if (rig_.signals->signals.empty())
      add_problem("signals.yaml", "signals", "expected one action signal or more");
    if (parts.size() < 2) add_problem("markers.yaml", "tags", "expected tags on two parts or more");
    const int end_effector = rig_.signals->end_effector_part;
    if (!has_tag(end_effector))
      add_problem("signals.yaml", "end_effector_part",
                  fmt::format("part {} has no tag in markers.yaml", end_effector));
    if (!rig_.signals->root_part) return;
    const int root = *rig_.signals->root_part;
    if (!has_tag(root))
      add_problem("signals.yaml", "root_part",
                  fmt::format("part {} has no tag in markers.yaml", root));
    if (root == end_effector)
      add_problem("signals.yaml", "end_effector_part", "is the root part, which never moves");
  }

  /// The simulated camera takes frames_per_action images of a rest and then waits for the next
  /// action, which the babbler does not send before the SAMPLE: both would wait for ever.
  void check_frames(int taken) {
    const int needed = rig_.observer->frames_per_sample;
    if (taken < needed)
      add_frames_problem(
          fmt::format("{} is below frames_per_sample of observer.yaml, {}: no sample would be made",
                      taken, needed));
  }

  /// The controller waits for these frames of a rest.
  void check_target_tags(int taken) {
    if (!rig_.markers->target_tags.empty() && taken < TagTrack::kFrames)
      add_frames_problem(fmt::format("target tags need {}, not {}", TagTrack::kFrames, taken));
  }

  void add_frames_problem(const std::string& problem) {
    const Yaml yaml = Yaml::load(folder_ / "camera.yaml");
    add_problem(yaml.section("simulation").error("frames_per_action", problem).what());
  }

  void remark_unread_files() {
    std::vector<std::string> names;
    std::error_code problem;
    for (const auto& entry : std::filesystem::directory_iterator(folder_, problem)) {
      const std::string name = entry.path().filename();
      const bool is_replaced = name.ends_with(kReplacedSuffix) &&
                               read_.contains(name.substr(0, name.rfind(kReplacedSuffix)));
      if (!read_.contains(name) && !is_replaced) names.push_back(name);
    }
    std::ranges::sort(names);
    for (const std::string& name : names) {
      const bool may_be_misspelt = path(name).extension() == ".yaml";
      result_.remarks.push_back((folder_ / name).string() + ": no process reads this file" +
                                (may_be_misspelt ? did_you_mean(name, missing_files()) : ""));
    }
  }

  std::set<std::string> missing_files() const {
    std::set<std::string> missing;
    for (const std::string& name : read_)
      if (!has(name)) missing.insert(name);
    return missing;
  }

  const path folder_;
  Rig rig_;
  std::set<std::string> read_;  ///< names of files that a process reads
  RigCheck result_;
};

}  // namespace

RigCheck check_rig(const path& folder) { return Check(folder).run(); }

path rigs_folder() {
  std::error_code none;
  // The program is in build/bin of its checkout.
  const path program = std::filesystem::read_symlink("/proc/self/exe", none);
  for (const path& folder :
       {path("config"), program.parent_path().parent_path().parent_path() / "config"})
    if (std::filesystem::is_directory(folder, none)) return folder;
  return {};
}

std::string rig_name_of(const path& run) {
  std::ifstream stream(run / "result.json");
  const auto result = nlohmann::json::parse(stream, nullptr, false);
  if (!result.is_object() || !result.contains("rig") || !result["rig"].is_string()) return "";
  return as_text(result["rig"].get<std::string>());
}

path find_rig(const std::string& rig) {
  std::error_code none;
  const path folder(rig);
  if (std::filesystem::exists(folder / "signals.yaml", none)) return folder;
  const path rigs = rigs_folder();
  const bool is_bare = folder.filename() == folder && rig != "." && rig != "..";
  if (is_bare && !rigs.empty()) {
    if (std::filesystem::is_directory(rigs / folder, none)) return rigs / folder;
    if (!std::filesystem::is_directory(folder, none)) {
      std::set<std::string> names;
      for (const auto& entry : std::filesystem::directory_iterator(rigs, none))
        if (entry.is_directory()) names.insert(entry.path().filename());
      throw std::runtime_error(fmt::format("there is no rig '{}'; there are: {}{}", rig,
                                           fmt::join(names, ", "), did_you_mean(rig, names)));
    }
  }
  if (!std::filesystem::is_directory(folder, none))
    throw std::runtime_error(rig + ": expected the folder of a rig, e.g. config/arm7");
  return folder;
}

}  // namespace bodyschema
