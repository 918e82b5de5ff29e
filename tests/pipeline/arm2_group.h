#pragma once

#include <gtest/gtest.h>
#include <unistd.h>

#include <algorithm>
#include <filesystem>
#include <nlohmann/json.hpp>
#include <string>
#include <vector>

#include "common/bus/convert.h"
#include "tests/pipeline/group_run.h"
#include "tests/support/rig_truth.h"

// The whole group on the simulated arm2: real processes, real bus, rendered images, launched as a
// user would by ./run. One program, one run shared by all tests.

namespace bodyschema::test {

/// "pid command line" of every process that has the run folder in its environment, which all
/// processes of ./run inherit.
inline std::vector<std::string> processes_of(const fs::path& run_folder) {
  const std::string mark = "BODYSCHEMA_RUN=" + run_folder.string() + '\0';
  std::vector<std::string> found;
  for (const auto& entry : fs::directory_iterator("/proc")) {
    const std::string pid = entry.path().filename();
    if (pid.find_first_not_of("0123456789") != std::string::npos) continue;
    if (('\0' + text_of(entry.path() / "environ")).find('\0' + mark) == std::string::npos) continue;
    std::string command = text_of(entry.path() / "cmdline");
    std::replace(command.begin(), command.end(), '\0', ' ');
    found.push_back(pid + " " + command);
  }
  return found;
}

class Arm2 : public testing::Test {
 protected:
  static void SetUpTestSuite() {
    // A path with a space, as users have them.
    folder_ = fs::temp_directory_path() / ("bodyschema pipeline " + std::to_string(getpid()));
    fs::create_directories(folder_);
    exit_code_ = launch("first");
    if (exit_code_ == 0) second_exit_code_ = launch("second");
  }
  static void TearDownTestSuite() {
    if (!testing::UnitTest::GetInstance()->Failed()) fs::remove_all(folder_);
  }
  void SetUp() override { ASSERT_EQ(exit_code_, 0) << text_of(folder_ / "first.err"); }

  static int launch(const std::string& name) { return shell(command(name, 30)); }
  static std::string command(const std::string& name, int samples) {
    return run_command(name, "--rig arm2 --ideal --seed 3 --samples " + std::to_string(samples));
  }
  /// `./run ARGUMENTS`, with logs, stdout and stderr of that name in the test's folder.
  static std::string run_command(const std::string& name, const std::string& arguments) {
    const fs::path logs = folder_ / name;
    return "BODYSCHEMA_BUILD=" + in_quotes(kBin.parent_path()) +
           " BODYSCHEMA_LOGS=" + in_quotes(logs) + " exec " + in_quotes(kSource / "run") + " " +
           arguments + " >" + in_quotes(logs.string() + ".out") + " 2>" +
           in_quotes(logs.string() + ".err") + " </dev/null";
  }
  /// Exit code of `./run --replay LOG FLAGS`.
  static int replay_group(const std::string& name, const fs::path& log,
                          const std::string& flags = "") {
    return shell(run_command(name, "--replay " + in_quotes(log) + " " + flags));
  }
  static nlohmann::json result(const std::string& name) {
    return nlohmann::json::parse(text_of(run(name) / "result.json"));
  }
  /// Runs a process from a log of the first run to a log, whose path is returned.
  static fs::path replay(const std::string& process, const std::string& flags = "") {
    const fs::path out = folder_ / ("replayed_" + process + ".lcmlog");
    const fs::path err = out.string() + ".err";
    EXPECT_EQ(shell(in_quotes(kBin / process) + " --config " +
                    in_quotes(run("first") / "config" / (process + ".yaml")) + " --in " +
                    in_quotes(log_url(run("first") / "run.lcmlog.00")) + " --out " +
                    in_quotes("file://" + out.string() + "?mode=w") + " " + flags + " 2>" +
                    in_quotes(err)),
              0)
        << text_of(err);
    return out;
  }
  static std::string log_url(const fs::path& log) { return "file://" + log.string() + "?speed=0"; }
  static fs::path run(const std::string& name) { return folder_ / name / "current"; }

  static inline fs::path folder_;
  static inline int exit_code_ = -1;
  static inline int second_exit_code_ = -1;
};

}  // namespace bodyschema::test
