// A run of the simulated arm2 with a hostile sender on its bus.

#include <gtest/gtest.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <map>
#include <regex>
#include <string>
#include <thread>
#include <vector>

#include "tests/pipeline/group_run.h"

namespace bodyschema::test {
namespace {

class HostileBus : public testing::Test {
 protected:
  HostileBus()
      : folder_(fs::temp_directory_path() / ("bodyschema hostile " + std::to_string(getpid()))) {
    fs::create_directories(folder_);
    fs::copy(kSource / "config" / "arm2", folder_ / "rig");
    std::string refiner = text_of(folder_ / "rig" / "refiner.yaml");
    refiner = std::regex_replace(refiner, std::regex("enabled: false"), "enabled: true");
    refiner = std::regex_replace(refiner, std::regex("refine_every: 50"), "refine_every: 10");
    std::ofstream(folder_ / "rig" / "refiner.yaml") << refiner;
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
    return shell(command(name, arguments) + quiet);
  }
  fs::path current(const std::string& name) const { return folder_ / name / "current"; }

  const fs::path folder_;
};

/// What each process must have counted of the messages that it refused.
const std::map<std::string, std::vector<std::string>> kRefusals = {
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
    {"refiner",
     {"malformed LEARNED_SCHEMA", "senseless LEARNED_SCHEMA", "refused LEARNED_SCHEMA",
      "malformed SAMPLE", "refused SAMPLE"}},
    {"motor_babbler", {"malformed SAMPLE", "refused SAMPLE", "refused MODEL_HEALTH"}},
    {"controller",
     {"malformed POSE_TARGET", "senseless POSE_TARGET", "malformed MOTION_STATUS",
      "refused MOTION_STATUS", "refused BODY_SCHEMA"}},
    {"robot_simulator",
     {"malformed ACTION_COMMAND", "senseless ACTION_COMMAND", "malformed FAULT_COMMAND",
      "senseless FAULT_COMMAND"}}};

using Counters = std::map<std::string, std::map<std::string, std::int64_t>>;

/// The largest count of each counter of each process.
Counters largest_counters(const fs::path& log) {
  Counters counters;
  for_each_event(log, [&](const LogEvent& event) {
    if (event.channel != kProcessInfo.name) return;
    const auto info = decode<process_info_t>(event.data.data(), event.data.size()).message;
    if (!info || info->host.empty()) return;
    for (const counter_t& counter : info->counters) {
      std::int64_t& count = counters[info->process_name][counter.counter_name];
      count = std::max(count, counter.count);
    }
  });
  return counters;
}

TEST_F(HostileBus, NothingThatIsNotTheRigsOwnChangesAByteOfWhatIsLearned) {
  const std::string arguments =
      "--rig '" + (folder_ / "rig").string() + "' --ideal --seed 3 --samples 20";
  ASSERT_EQ(run("foreign", "--rig arm7 --ideal --seed 5 --samples 10"), 0)
      << text_of(folder_ / "foreign.err");
  ASSERT_EQ(run("peace", arguments), 0) << text_of(folder_ / "peace.err");

  const fs::path over = folder_ / "over";
  int sender_status = -1;
  std::string num_sent;
  std::thread sender([&] {
    // As soon as the group's bus exists.
    becomes_true(std::chrono::seconds(30), [&] {
      std::string socket = text_of(current("war") / "socket");
      return !socket.empty() && fs::exists(socket.erase(socket.find('\n')));
    });
    const fs::path out = folder_ / "sender.out";
    sender_status = std::system(
        (command("war", "exec hostile_sender '" + fs::canonical(current("foreign")).string() +
                            "' --until '" + over.string() + "'") +
         " >'" + out.string() + "'")
            .c_str());
    num_sent = text_of(out);
  });
  const int status = run("war", arguments);
  std::ofstream(over).close();
  sender.join();
  ASSERT_EQ(status, 0) << text_of(folder_ / "war.err");
  ASSERT_EQ(sender_status, 0);
  ASSERT_GT(std::atoi(num_sent.c_str()), 300);

  EXPECT_EQ(payloads(current("war") / "samples.lcmlog", "SAMPLE"),
            payloads(current("peace") / "samples.lcmlog", "SAMPLE"));
  EXPECT_EQ(payloads(current("war") / "schema.lcmlog", "BODY_SCHEMA"),
            payloads(current("peace") / "schema.lcmlog", "BODY_SCHEMA"));

  auto counters = largest_counters(current("war") / "run.lcmlog.00");
  for (const auto& [process, names] : kRefusals) {
    if (!fs::exists(kBin / process)) continue;  // built without Ceres
    for (const std::string& name : names)
      EXPECT_GT(counters[process][name], 0) << process << ": " << name;
  }
  if (!fs::exists(kBin / "refiner")) return;
  for (const std::string kind : {"malformed", "senseless", "refused"})
    EXPECT_GT(counters["model_monitor"][kind + " REFINED_SCHEMA"], 0) << kind;
}

}  // namespace
}  // namespace bodyschema::test
