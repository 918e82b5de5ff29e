// Every file of every rig in config/ is read by the process that it is for. A new rig is covered as
// soon as it is there; a new kind of file wants a line in the table below.

#include <gtest/gtest.h>
#include <unistd.h>

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <functional>
#include <map>
#include <sstream>

#include "common/config/camera_calibration.h"
#include "common/config/rig.h"
#include "common/config/yaml.h"
#include "common/scene/robot.h"
#include "processes/camera/camera.h"
#include "processes/controller/controller.h"
#include "processes/marker_estimator/marker_estimator.h"
#include "processes/model_monitor/model_monitor.h"
#include "processes/motor_babbler/motor_babbler.h"
#include "processes/observer/observer.h"
#include "processes/robot_simulator/robot_simulator.h"
#include "processes/structure_learner/structure_learner.h"

namespace bodyschema {
namespace {

using std::filesystem::path;

const std::map<std::string, std::function<void(const path&)>> kReaders = {
    {"camera.yaml", [](const path& file) { CameraConfig::load(file); }},
    {"camera_info.yaml", [](const path& file) { load_camera_calibration(file); }},
    {"controller.yaml", [](const path& file) { ControllerConfig::load(file); }},
    {"marker_estimator.yaml", [](const path& file) { MarkerEstimatorConfig::load(file); }},
    {"markers.yaml", [](const path& file) { load_markers(file.parent_path()); }},
    {"model_monitor.yaml", [](const path& file) { ModelMonitorConfig::load(file); }},
    {"motor_babbler.yaml", [](const path& file) { MotorBabblerConfig::load(file); }},
    {"network.yaml", [](const path& file) { load_network(file.parent_path()); }},
    {"observer.yaml", [](const path& file) { ObserverConfig::load(file); }},
    {"robot.yaml",
     [](const path& file) {
       const path rig = file.parent_path();
       load_robot(rig, load_signals(rig), load_markers(rig));
     }},
    {"robot_simulator.yaml", [](const path& file) { RobotSimulatorConfig::load(file); }},
    {"signals.yaml", [](const path& file) { load_signals(file.parent_path()); }},
    {"structure_learner.yaml", [](const path& file) { StructureLearnerConfig::load(file); }},
};

/// Files that a rig may lack: a lab's robot is not simulated.
const std::vector<std::string> kSimulatedOnly = {"robot.yaml", "robot_simulator.yaml"};

std::vector<path> rigs() {
  std::vector<path> result;
  for (const auto& entry : std::filesystem::directory_iterator(BODYSCHEMA_CONFIG))
    if (entry.is_directory()) result.push_back(entry.path());
  std::sort(result.begin(), result.end());
  return result;
}

class RigFilesTest : public testing::TestWithParam<path> {};

TEST_P(RigFilesTest, EveryFileIsReadByItsProcess) {
  int num_files = 0;
  for (const auto& entry : std::filesystem::directory_iterator(GetParam())) {
    const std::string name = entry.path().filename();
    ASSERT_TRUE(kReaders.count(name)) << entry.path() << ": no process reads such a file";
    EXPECT_NO_THROW(kReaders.at(name)(entry.path())) << entry.path();
    ++num_files;
  }
  EXPECT_GT(num_files, 0);
}

TEST_P(RigFilesTest, NoFileThatAProcessReadsIsMissing) {
  const bool is_simulated = std::filesystem::exists(GetParam() / "robot.yaml");
  for (const auto& [name, reader] : kReaders) {
    const bool is_simulators =
        std::find(kSimulatedOnly.begin(), kSimulatedOnly.end(), name) != kSimulatedOnly.end();
    if (is_simulators && !is_simulated) continue;
    EXPECT_TRUE(std::filesystem::exists(GetParam() / name)) << name;
  }
}

TEST_P(RigFilesTest, RootAndEndEffectorAreParts) {
  const Signals signals = load_signals(GetParam());
  const std::vector<int> parts = load_markers(GetParam()).parts();
  const auto is_part = [&](int part) {
    return std::binary_search(parts.begin(), parts.end(), part);
  };
  EXPECT_FALSE(signals.signals.empty());
  EXPECT_TRUE(is_part(signals.end_effector_part));
  if (signals.root_part) {
    EXPECT_TRUE(is_part(*signals.root_part));
    EXPECT_NE(*signals.root_part, signals.end_effector_part);
  }
}

// A process that skips what it does not know would run with a misspelt key's default.
TEST_P(RigFilesTest, AnUnknownKeyInAnyFileIsRefused) {
  const path copy = path(testing::TempDir()) /
                    ("rig_files_" + std::to_string(getpid()) + GetParam().filename().string());
  for (const auto& [name, reader] : kReaders) {
    if (!std::filesystem::exists(GetParam() / name)) continue;
    // Its makers' tools put keys of their own into a calibration.
    if (name == "camera_info.yaml") continue;
    std::filesystem::remove_all(copy);
    std::filesystem::copy(GetParam(), copy);
    std::ofstream(copy / name, std::ios::app) << "\nno_such_key: 1\n";
    try {
      reader(copy / name);
      ADD_FAILURE() << name << " was read with a key that nobody knows";
    } catch (const ConfigError& error) {
      EXPECT_NE(std::string(error.what()).find(name), std::string::npos) << error.what();
      EXPECT_NE(std::string(error.what()).find("no_such_key"), std::string::npos) << error.what();
    }
  }
  std::filesystem::remove_all(copy);
}

// The other way round: whatever key is taken away or damaged, the reader throws a ConfigError or
// does without, and nothing else.
TEST_P(RigFilesTest, AFileWithALineLessIsRefusedWithAConfigErrorOrRead) {
  const path copy = path(testing::TempDir()) /
                    ("rig_lines_" + std::to_string(getpid()) + GetParam().filename().string());
  std::filesystem::remove_all(copy);
  std::filesystem::copy(GetParam(), copy);
  int num_refused = 0;
  for (const auto& [name, reader] : kReaders) {
    if (!std::filesystem::exists(GetParam() / name)) continue;
    std::vector<std::string> lines;
    std::ifstream stream(GetParam() / name);
    for (std::string line; std::getline(stream, line);) lines.push_back(line);
    for (std::size_t left_out = 0; left_out < lines.size(); ++left_out) {
      {
        std::ofstream out(copy / name, std::ios::trunc);
        for (std::size_t i = 0; i < lines.size(); ++i)
          if (i != left_out) out << lines[i] << '\n';
      }
      try {
        reader(copy / name);
      } catch (const ConfigError&) {
        ++num_refused;
      } catch (const std::exception& error) {
        ADD_FAILURE() << name << " without line " << left_out + 1 << ": " << error.what();
      }
    }
    std::filesystem::copy_file(GetParam() / name, copy / name,
                               std::filesystem::copy_options::overwrite_existing);
  }
  EXPECT_GT(num_refused, 40);
  std::filesystem::remove_all(copy);
}

INSTANTIATE_TEST_SUITE_P(Shipped, RigFilesTest, testing::ValuesIn(rigs()),
                         [](const auto& info) { return info.param.filename().string(); });

}  // namespace
}  // namespace bodyschema
