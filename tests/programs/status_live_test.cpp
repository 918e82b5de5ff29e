// `bodyschema status` beside real processes and garbage; on a bus of its own (private_bus.sh).

#include <gtest/gtest.h>
#include <lcm/lcm.h>

#include <chrono>
#include <csignal>
#include <nlohmann/json.hpp>
#include <random>
#include <set>
#include <string>
#include <vector>

#include "common/bus/all_channels.h"
#include "tests/common/bus/bus_test_support.h"

namespace bodyschema {
namespace {

using Json = nlohmann::json;
const std::string kBin = BODYSCHEMA_BIN "/";
const std::string kRig = BODYSCHEMA_CONFIG "/arm2/";

struct Outcome {
  int exit_code = 0;
  std::string out, err;
};

Outcome status(const std::vector<std::string>& arguments) {
  std::vector<std::string> command = {kBin + "bodyschema", "status"};
  command.insert(command.end(), arguments.begin(), arguments.end());
  test::Program program(command);
  const int exit_code = program.wait();
  return {exit_code, program.out(), program.err()};
}

TEST(StatusLive, ASilentBusSaysWhatToDo) {
  const Outcome outcome = status({"--seconds", "0.3"});
  EXPECT_EQ(outcome.exit_code, 1);
  EXPECT_EQ(outcome.out, "");
  EXPECT_NE(outcome.err.find("nothing on udpm://"), std::string::npos) << outcome.err;
  EXPECT_NE(outcome.err.find("./run --keep"), std::string::npos) << outcome.err;
}

TEST(StatusLive, ProcessesAreSeenThroughGarbageOnEveryChannel) {
  test::Program simulator({kBin + "robot_simulator", "--config", kRig + "robot_simulator.yaml"});
  test::Program observer({kBin + "observer", "--config", kRig + "observer.yaml"});
  // Until both were heard.
  bool has_simulator = false, has_observer = false;
  Bus bus(default_url(), "");
  bus.subscribe<process_info_t>(kProcessInfo, [&](const process_info_t& info) {
    has_simulator |= info.process_name == "robot_simulator";
    has_observer |= info.process_name == "observer";
  });
  ASSERT_TRUE(test::handle_until(bus, [&] { return has_simulator && has_observer; }));

  test::Program listener({kBin + "bodyschema", "status", "--json", "--seconds", "3", "--processes",
                          "camera", "observer"});
  std::mt19937 random(1);
  lcm_t* lcm = lcm_create(default_url().c_str());
  ASSERT_NE(lcm, nullptr);
  const auto end = std::chrono::steady_clock::now() + std::chrono::seconds(3);
  while (std::chrono::steady_clock::now() < end) {
    for_each_channel([&](const auto& channel) {
      std::vector<std::uint8_t> garbage(random() % 300);
      for (auto& byte : garbage) byte = static_cast<std::uint8_t>(random());
      lcm_publish(lcm, channel.name, garbage.data(), static_cast<unsigned>(garbage.size()));
    });
    bus.handle(std::chrono::milliseconds(50));
  }
  lcm_destroy(lcm);
  ASSERT_EQ(listener.wait(), 0) << listener.err();
  const Json json = Json::parse(listener.out(), nullptr, false);
  ASSERT_FALSE(json.is_discarded()) << listener.out();
  std::set<std::string> names;
  for (const Json& process : json["processes"]) {
    names.insert(process["name"]);
    EXPECT_EQ(process["pid"], process["name"] == "observer" ? observer.pid() : simulator.pid());
    EXPECT_GT(process["resident_bytes"].get<std::int64_t>(), 1'000'000);
    EXPECT_GE(process["cpu_percent"].get<double>(), 0);
  }
  EXPECT_EQ(names, (std::set<std::string>{"observer", "robot_simulator"}));
  const auto missing = json["missing"].get<std::set<std::string>>();
  EXPECT_TRUE(missing.contains("camera"));
  EXPECT_FALSE(missing.contains("observer"));
  EXPECT_GT(json["channels"]["MOTION_STATUS"]["count"].get<int>(), 0);
  EXPECT_GT(json["channels"]["MOTION_STATUS"]["dropped"]["malformed"].get<int>(), 0);
  EXPECT_EQ(json["channels"]["SAMPLE"]["count"], 0);
  EXPECT_EQ(json["arm"]["at_rest"], true);

  // For people, the same.
  const Outcome outcome = status({"--processes", "camera", "observer"});
  EXPECT_EQ(outcome.exit_code, 0) << outcome.err;
  EXPECT_NE(outcome.out.find("Not heard: camera."), std::string::npos) << outcome.out;
  EXPECT_EQ(outcome.out.find("\x1b"), std::string::npos);
  // Without --processes no process is expected.
  EXPECT_EQ(status({}).out.find("Not heard"), std::string::npos);
}

}  // namespace
}  // namespace bodyschema
