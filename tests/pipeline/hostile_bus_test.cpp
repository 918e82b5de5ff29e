// A run of the simulated arm2 with a hostile sender on its bus.

#include <gtest/gtest.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <functional>
#include <map>
#include <sstream>
#include <string>
#include <thread>
#include <vector>

#include "common/bus/event_log.h"

namespace bodyschema {
namespace {

namespace fs = std::filesystem;

const fs::path kSource = BODYSCHEMA_SOURCE_FOLDER;
const fs::path kBin = BODYSCHEMA_BIN_FOLDER;

std::string contents(const fs::path& file) {
  std::ifstream stream(file, std::ios::binary);
  std::stringstream text;
  text << stream.rdbuf();
  return text.str();
}

std::string payloads(const fs::path& log, const std::string& channel) {
  std::string bytes;
  for_each_event(log, [&](const LogEvent& event) {
    if (event.channel == channel) bytes.append(event.data.begin(), event.data.end());
  });
  return bytes;
}

bool becomes_true(std::chrono::seconds limit, const std::function<bool()>& condition) {
  const auto end = std::chrono::steady_clock::now() + limit;
  while (!condition()) {
    if (std::chrono::steady_clock::now() > end) return false;
    std::this_thread::sleep_for(std::chrono::milliseconds(20));
  }
  return true;
}

class HostileBus : public testing::Test {
 protected:
  HostileBus()
      : folder_(fs::temp_directory_path() / ("bodyschema hostile " + std::to_string(getpid()))) {
    fs::create_directories(folder_);
  }
  ~HostileBus() override {
    if (!HasFailure()) fs::remove_all(folder_);
  }

  /// "env ./run ARGUMENTS" with logs in a folder called `name`.
  std::string command(const std::string& name, const std::string& arguments) const {
    const std::string logs = (folder_ / name).string();
    return "BODYSCHEMA_BUILD='" + kBin.parent_path().string() + "' BODYSCHEMA_LOGS='" + logs +
           "' '" + (kSource / "run").string() + "' " + arguments + " </dev/null";
  }
  int run(const std::string& name, const std::string& arguments) const {
    const std::string quiet = " >'" + (folder_ / (name + ".out")).string() + "' 2>'" +
                              (folder_ / (name + ".err")).string() + "'";
    const int status = std::system((command(name, arguments) + quiet).c_str());
    return WIFEXITED(status) ? WEXITSTATUS(status) : 128;
  }
  fs::path current(const std::string& name) const { return folder_ / name / "current"; }

  const fs::path folder_;
};

TEST_F(HostileBus, NothingThatIsNotTheRigsOwnChangesAByteOfWhatIsLearned) {
  const std::string arguments = "--rig arm2 --ideal --seed 3 --samples 20";
  ASSERT_EQ(run("foreign", "--rig arm7 --ideal --seed 5 --samples 10"), 0)
      << contents(folder_ / "foreign.err");
  ASSERT_EQ(run("peace", arguments), 0) << contents(folder_ / "peace.err");

  const fs::path over = folder_ / "over";
  int sender_status = -1;
  std::string num_sent;
  std::thread sender([&] {
    // As soon as the group's bus exists.
    becomes_true(std::chrono::seconds(30), [&] {
      std::string socket = contents(current("war") / "socket");
      return !socket.empty() && fs::exists(socket.erase(socket.find('\n')));
    });
    const fs::path out = folder_ / "sender.out";
    sender_status = std::system(
        (command("war", "exec hostile_sender '" + fs::canonical(current("foreign")).string() +
                            "' --until '" + over.string() + "'") +
         " >'" + out.string() + "'")
            .c_str());
    num_sent = contents(out);
  });
  const int status = run("war", arguments);
  std::ofstream(over).close();
  sender.join();
  ASSERT_EQ(status, 0) << contents(folder_ / "war.err");
  ASSERT_EQ(sender_status, 0);
  ASSERT_GT(std::atoi(num_sent.c_str()), 300);

  EXPECT_EQ(payloads(current("war") / "samples.lcmlog", "SAMPLE"),
            payloads(current("peace") / "samples.lcmlog", "SAMPLE"));
  EXPECT_EQ(payloads(current("war") / "schema.lcmlog", "BODY_SCHEMA"),
            payloads(current("peace") / "schema.lcmlog", "BODY_SCHEMA"));

  // Each process counted the messages that it refused.
  std::map<std::string, std::map<std::string, std::int64_t>> counters;
  for_each_event(current("war") / "run.lcmlog.00", [&](const LogEvent& event) {
    if (event.channel != kProcessInfo.name) return;
    const auto info = decode<process_info_t>(event.data.data(), event.data.size()).message;
    if (!info || info->host.empty()) return;
    for (const counter_t& counter : info->counters) {
      std::int64_t& count = counters[info->process_name][counter.counter_name];
      count = std::max(count, counter.count);
    }
  });
  const std::map<std::string, std::vector<std::string>> expected = {
      {"camera", {"malformed SIM_STATE", "senseless SIM_STATE", "refused SIM_STATE"}},
      {"marker_estimator",
       {"malformed CAMERA_INFO", "refused CAMERA_INFO", "image of another camera"}},
      {"observer",
       {"malformed MARKER_POSES", "senseless MARKER_POSES", "refused MARKER_POSES",
        "malformed MOTION_STATUS", "senseless MOTION_STATUS", "refused MOTION_STATUS",
        "malformed SAMPLE_REQUEST", "senseless SAMPLE_REQUEST"}},
      {"structure_learner", {"malformed SAMPLE", "senseless SAMPLE", "refused SAMPLE"}},
      {"model_monitor",
       {"malformed LEARNED_SCHEMA", "senseless LEARNED_SCHEMA", "refused LEARNED_SCHEMA"}},
      {"motor_babbler", {"malformed SAMPLE", "refused SAMPLE", "refused MODEL_HEALTH"}},
      {"controller",
       {"malformed POSE_TARGET", "senseless POSE_TARGET", "malformed MOTION_STATUS",
        "refused MOTION_STATUS", "refused BODY_SCHEMA"}},
      {"robot_simulator",
       {"malformed ACTION_COMMAND", "senseless ACTION_COMMAND", "malformed FAULT_COMMAND",
        "senseless FAULT_COMMAND"}}};
  for (const auto& [process, names] : expected) {
    for (const std::string& name : names) {
      EXPECT_GT(counters[process][name], 0) << process << ": " << name;
    }
  }
}

}  // namespace
}  // namespace bodyschema
