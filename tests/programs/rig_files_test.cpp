// Every file of every rig in config/ is read by its process. A new rig is covered as
// soon as it is there; a new kind of file needs a line in the table below.

#include <gtest/gtest.h>

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <functional>
#include <map>
#include <regex>

#include "common/config/camera_calibration.h"
#include "common/config/rig.h"
#include "common/config/yaml.h"
#include "common/scene/robot.h"
#include "processes/camera/camera.h"
#include "processes/console/rig_check.h"
#include "processes/controller/controller.h"
#include "processes/marker_estimator/marker_estimator.h"
#include "processes/model_monitor/model_monitor.h"
#include "processes/motor_babbler/motor_babbler.h"
#include "processes/observer/observer.h"
#include "processes/refiner/refiner_config.h"
#include "processes/robot_simulator/robot_simulator.h"
#include "processes/structure_learner/structure_learner.h"
#include "tests/support/temporary_folder.h"
#include "tests/support/text_of.h"

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
    {"ideal_noise.yaml",
     [](const path& file) { load_noise(file.parent_path(), "ideal_noise.yaml"); }},
    {"noise.yaml", [](const path& file) { load_noise(file.parent_path()); }},
    {"observer.yaml", [](const path& file) { ObserverConfig::load(file); }},
    {"refiner.yaml", [](const path& file) { RefinerConfig::load(file); }},
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

// A process that ignores unknown keys would run with the default of a misspelt key.
TEST_P(RigFilesTest, AnUnknownKeyInAnyFileIsRefused) {
  const test::TemporaryFolder folder;
  const path& copy = folder.path();
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
}

// The other way round: whichever key is removed or damaged, the reader throws a ConfigError or
// does without the key.
TEST_P(RigFilesTest, AFileWithALineLessIsRefusedWithAConfigErrorOrRead) {
  const test::TemporaryFolder copy(GetParam());
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
}

TEST_P(RigFilesTest, TheCheckFindsItGood) {
  const RigCheck check = check_rig(GetParam());
  EXPECT_EQ(check.problems, std::vector<std::string>{});
  EXPECT_EQ(check.remarks, std::vector<std::string>{});
  EXPECT_EQ(check.num_signals, static_cast<int>(load_signals(GetParam()).signals.size()));
  EXPECT_EQ(check.num_parts, static_cast<int>(load_markers(GetParam()).parts().size()));
  EXPECT_EQ(check.num_tags, static_cast<int>(load_markers(GetParam()).tags.size()));
}

/// A rig that is damaged in one place.
class RigCheckTest : public testing::Test {
 protected:
  RigCheckTest() { restore(); }

  void restore() {
    std::filesystem::remove_all(copy_);
    std::filesystem::copy(path(BODYSCHEMA_CONFIG) / "arm2", copy_);
  }
  std::string text(const std::string& name) const { return test::text_of(copy_ / name); }
  void write(const std::string& name, const std::string& text) const {
    std::ofstream(copy_ / name, std::ios::trunc) << text;
  }
  /// The only problem after `from` was replaced by `to` in a file of the good rig.
  std::string problem_with(const std::string& name, const std::string& from,
                           const std::string& to) {
    restore();
    std::string changed = text(name);
    const std::size_t at = changed.find(from);
    EXPECT_NE(at, std::string::npos) << name << " has no " << from;
    write(name, changed.replace(at, from.size(), to));
    const RigCheck check = check_rig(copy_);
    EXPECT_EQ(check.problems.size(), 1U) << from;
    if (check.problems.empty()) return "";
    const std::string& problem = check.problems.front();
    EXPECT_EQ(problem.rfind(copy_.string(), 0), 0U) << problem;
    return problem.substr(copy_.string().size() + 1);
  }

  const test::TemporaryFolder folder_;
  const path copy_ = folder_.path();
};

TEST_F(RigCheckTest, WhatOneFileSaysOfAnotherMustBeThere) {
  EXPECT_EQ(problem_with("signals.yaml", "end_effector_part: 5", "end_effector_part: 9"),
            "signals.yaml:6: end_effector_part: part 9 has no tag in markers.yaml");
  EXPECT_EQ(problem_with("signals.yaml", "root_part: 1", "root_part: 7"),
            "signals.yaml:5: root_part: part 7 has no tag in markers.yaml");
  EXPECT_EQ(problem_with("signals.yaml", "root_part: 1", "root_part: 5"),
            "signals.yaml:6: end_effector_part: is the root part, which never moves");
  EXPECT_EQ(problem_with("robot.yaml", "part: 5, link: arm", "part: 5, link: leg"),
            "robot.yaml:69: parts[4].link: 'leg' is none of: base, turret, arm");
  EXPECT_EQ(problem_with("robot.yaml", "size_px: [1280,", "size_px: [640,"),
            "robot.yaml:10: lens: size_px is 640×960 px, the calibration holds for 1280×960 px");
  EXPECT_EQ(problem_with("robot.yaml", "signal: q2", "signal: q9"),
            "robot.yaml:55: links[2].joint.signal: 'q9' is none of: q1, q2");
  EXPECT_NE(
      problem_with("robot.yaml", "parent: turret", "parent: torso").find("'torso' is none of"),
      std::string::npos);
  EXPECT_NE(problem_with("camera.yaml", "camera_info.yaml", "none.yaml").find("none.yaml"),
            std::string::npos);
}

// The camera would wait for the next action, the babbler for the SAMPLE.
TEST_F(RigCheckTest, AsManyFramesMustBeTakenAsASampleNeeds) {
  EXPECT_EQ(problem_with("camera.yaml", "frames_per_action: 2", "frames_per_action: 1"),
            "camera.yaml:10: simulation.frames_per_action: 1 is below frames_per_sample of "
            "observer.yaml, 2: no sample would be made");
  EXPECT_NE(problem_with("observer.yaml", "frames_per_sample: 2", "frames_per_sample: 3"), "");
}

TEST_F(RigCheckTest, TargetTagsAreCheckedAndNeedTwoFramesOfARest) {
  const std::string target = "target_tags:\n  - {id: 40, size_m: 0.1}\ntags:";
  EXPECT_EQ(problem_with("markers.yaml", "tags:", "target_tags:\n  - {id: 19, size_m: 0.1}\ntags:"),
            "markers.yaml:5: target_tags[0].id: tag 19 is on part 5, so it is no target");
  restore();
  std::string observer = text("observer.yaml");
  const std::string two = "frames_per_sample: 2";
  write("observer.yaml", observer.replace(observer.find(two), two.size(), "frames_per_sample: 1"));
  std::string markers = text("markers.yaml");
  write("markers.yaml", markers.replace(markers.find("tags:"), 5, target));
  EXPECT_EQ(check_rig(copy_).problems, std::vector<std::string>{});
  std::string camera = text("camera.yaml");
  const std::string taken = "frames_per_action: 2";
  write("camera.yaml", camera.replace(camera.find(taken), taken.size(), "frames_per_action: 1"));
  EXPECT_EQ(check_rig(copy_).problems,
            std::vector<std::string>{(copy_ / "camera.yaml:10: ").string() +
                                     "simulation.frames_per_action: target tags need 2, not 1"});
}

TEST_F(RigCheckTest, EveryFileIsReadByItsOwnProcess) {
  EXPECT_EQ(problem_with("motor_babbler.yaml", "choice: random", "choice: smart"),
            "motor_babbler.yaml:1: choice: 'smart' is none of: active, random");
  for (const auto& [name, reader] : kReaders) {
    restore();
    write(name, text(name) + "\n---\nno_such_key: 1\n");
    std::vector<std::string> problems = check_rig(copy_).problems;
    ASSERT_EQ(problems.size(), 1U) << name;
    EXPECT_NE(problems[0].find(name + ":"), std::string::npos) << problems[0];
    EXPECT_NE(problems[0].find("expected one YAML document"), std::string::npos) << problems[0];
    restore();
    std::filesystem::remove(copy_ / name);
    problems = check_rig(copy_).problems;
    const bool is_optional =
        name == "controller.yaml" || name == "ideal_noise.yaml" || name == "refiner.yaml";
    EXPECT_EQ(problems.size(), is_optional ? 0U : 1U) << name;
  }
}

TEST_F(RigCheckTest, FilesThatNobodyReadsAreNamed) {
  std::filesystem::rename(copy_ / "controller.yaml", copy_ / "contoller.yaml");
  write("notes.txt", "");
  const RigCheck check = check_rig(copy_);
  EXPECT_EQ(check.problems, std::vector<std::string>{});
  ASSERT_EQ(check.remarks.size(), 2U);
  EXPECT_TRUE(check.remarks[0].ends_with(
      "contoller.yaml: no process reads this file; did you mean 'controller.yaml'?"))
      << check.remarks[0];
  EXPECT_TRUE(check.remarks[1].ends_with("notes.txt: no process reads this file"));
}

TEST_F(RigCheckTest, ALabsRigIsNotSimulated) {
  std::filesystem::remove(copy_ / "robot.yaml");
  std::filesystem::remove(copy_ / "robot_simulator.yaml");
  EXPECT_EQ(check_rig(copy_).problems.size(), 2U);
  std::string camera = text("camera.yaml");
  camera.erase(camera.find("simulation:"));
  write("camera.yaml", camera +
                           "capture: {device: /dev/video0, width_px: 1280, height_px: 960, "
                           "max_rate_hz: 15}\n");
  EXPECT_EQ(check_rig(copy_).problems, std::vector<std::string>{});
}

// Any number of a rig is damaged so that its square overflows.
TEST_F(RigCheckTest, NoNumberMayBe1e308) {
  const std::regex number(R"([-+]?\b[0-9]+(\.[0-9]+)?(e[-+]?[0-9]+)?\b)");
  int num_numbers = 0;
  for (const auto& [name, reader] : kReaders) {
    const std::string good = text(name);
    std::size_t line_begin = 0;
    for (std::size_t line_end; line_begin < good.size(); line_begin = line_end + 1) {
      line_end = std::min(good.find('\n', line_begin), good.size());
      std::string line = good.substr(line_begin, line_end - line_begin);
      line = line.substr(0, line.find('#'));
      for (std::sregex_iterator match(line.begin(), line.end(), number), end; match != end;
           ++match) {
        // A name or a path; numbers of a calibration that no process reads.
        const std::size_t at = static_cast<std::size_t>(match->position());
        const char before = at > 0 ? line[at - 1] : ' ';
        if (std::string(" [{:,").find(before) == std::string::npos) continue;
        std::string damaged = good;
        damaged.replace(line_begin + at, static_cast<std::size_t>(match->length()), "1e308");
        write(name, damaged);
        const std::vector<std::string> problems = check_rig(copy_).problems;
        const bool is_read =
            name != "camera_info.yaml" || good.find("rectification_matrix") > line_begin;
        ASSERT_EQ(problems.empty(), !is_read) << name << ": " << line;
        ++num_numbers;
      }
    }
    write(name, good);
  }
  EXPECT_GT(num_numbers, 300);
}

INSTANTIATE_TEST_SUITE_P(Shipped, RigFilesTest, testing::ValuesIn(rigs()),
                         [](const auto& info) { return info.param.filename().string(); });

}  // namespace
}  // namespace bodyschema
