#include "common/bus/process.h"

#include <gtest/gtest.h>
#include <signal.h>

#include <algorithm>
#include <cstdlib>
#include <fstream>
#include <map>
#include <sstream>
#include <string>
#include <vector>

#include "common/bus/event_log.h"
#include "tests/common/bus/bus_test_support.h"
#include "tests/lcmtypes/example_messages.h"

namespace bodyschema::test {
namespace {

class ProcessTest : public testing::Test {
 protected:
  ProcessTest() { std::ofstream(config_) << "period_ms: 3  # \xB5s would be too short\n"; }

  std::vector<std::string> relay(const std::vector<std::string>& more) const {
    std::vector<std::string> arguments = {RELAY, "--config", config_.string()};
    arguments.insert(arguments.end(), more.begin(), more.end());
    return arguments;
  }
  std::string url(const std::string& name, const std::string& options) const {
    return "file://" + (folder_ / name).string() + options;
  }
  void write_statuses(const std::string& name, int count) const {
    LogAppender log(folder_ / name);
    for (int n = 0; n < count; ++n) {
      motion_status_t status = example_motion_status();
      status.utime = 1'000 * (n + 1);
      log.append(kMotionStatus, status);
    }
    log.append(kSample, example_sample());
  }

  TemporaryFolder folder_;
  std::filesystem::path config_ = folder_ / "relay.yaml";
};

TEST_F(ProcessTest, WithoutAConfigurationItSaysWhatToType) {
  Program program({RELAY});
  EXPECT_EQ(program.wait(), 1);
  EXPECT_EQ(program.err(),
            "relay: --config is missing. Type: relay --config config/<rig>/relay.yaml\n");
  EXPECT_EQ(program.out(), "");
}

TEST_F(ProcessTest, AMissingConfigurationFileIsNamed) {
  Program program({RELAY, "--config", (folder_ / "no.yaml").string(), "--in", "memq://"});
  EXPECT_EQ(program.wait(), 1);
  EXPECT_EQ(program.err(),
            "relay: " + (folder_ / "no.yaml").string() + ": cannot read the configuration file\n");
}

TEST_F(ProcessTest, AnUnknownFlagIsOneLineAndExitCodeOne) {
  Program program(relay({"--confog", "x"}));
  EXPECT_EQ(program.wait(), 1);
  EXPECT_EQ(program.err().find("relay: "), 0U);
  EXPECT_NE(program.err().find("--confog"), std::string::npos);
  EXPECT_EQ(std::count(program.err().begin(), program.err().end(), '\n'), 1);
}

TEST_F(ProcessTest, ADeadUrlIsOneLineAndExitCodeOne) {
  Program program(relay({"--in", "file:///no/such.lcmlog"}));
  EXPECT_EQ(program.wait(), 1);
  EXPECT_EQ(std::count(program.err().begin(), program.err().end(), '\n'), 1) << program.err();
}

TEST_F(ProcessTest, HelpAndVersionGoToStdout) {
  Program help({RELAY, "--help"});
  EXPECT_EQ(help.wait(), 0);
  for (const char* flag : {"--config", "--in", "--out", "--log-level", "--fail"}) {
    EXPECT_NE(help.out().find(flag), std::string::npos) << flag;
  }
  Program version({RELAY, "--version"});
  EXPECT_EQ(version.wait(), 0);
  EXPECT_NE(version.out().find('.'), std::string::npos);
}

TEST_F(ProcessTest, SigtermAndSigintEndTheLoopInOrderWithExitCodeZero) {
  for (const int number : {SIGTERM, SIGINT}) {
    Program program(relay({"--in", "memq://", "--out", url("out", "?mode=w")}));
    ASSERT_TRUE(program.wait_for_output("ready"));
    program.send_signal(number);
    EXPECT_EQ(program.wait(), 0);
    EXPECT_EQ(program.out(), "ready\nfirst end\nsecond end\nended\n");
    const std::vector<process_info_t> infos = read_log(folder_ / "out", kProcessInfo);
    ASSERT_GE(infos.size(), 2U);
    EXPECT_EQ(infos.back().phase, process_info_t::PHASE_ENDED);
    EXPECT_EQ(infos.back().process_name, "relay");
    EXPECT_EQ(infos.back().configuration, "period_ms: 3  # ?s would be too short\n");
    EXPECT_GT(infos.back().pid, 0);
    EXPECT_LE(infos.front().start_utime, infos.front().utime);
  }
}

TEST_F(ProcessTest, TicksGoOnSteadilyWhenTheClockIsSet) {
  const auto set_clock_by = [&](int seconds) {
    std::ofstream(folder_ / "next") << seconds << "\n";
    std::filesystem::rename(folder_ / "next", folder_ / "offset");
  };
  set_clock_by(0);
  ::setenv("CLOCK_OFFSET_FILE", (folder_ / "offset").c_str(), 1);
  ::setenv("ASAN_OPTIONS", "verify_asan_link_order=0", 1);  // where that is built in
  ::setenv("LD_PRELOAD", SET_CLOCK, 1);
  Program program(relay({"--ticks", "--in", "memq://", "--out", url("out", "?mode=w")}));
  ::unsetenv("LD_PRELOAD");
  ::unsetenv("ASAN_OPTIONS");
  const auto ticks = [&] {
    std::vector<std::int64_t> times;
    std::istringstream lines(program.out());
    for (std::string line; std::getline(lines, line);) {
      if (line.rfind("tick ", 0) == 0) times.push_back(std::stoll(line.substr(5)));
    }
    return times;
  };
  const auto wait_for_ticks = [&](std::size_t more) {
    const std::size_t enough = ticks().size() + more;
    return ask_until([&] { program.wait_for_output("\x01", 20); },
                     [&] { return ticks().size() >= enough; });
  };
  ASSERT_TRUE(wait_for_ticks(3));
  for (const int seconds : {7200, -86400, 0}) {
    set_clock_by(seconds);
    ASSERT_TRUE(wait_for_ticks(12))
        << "ticks stopped when the clock was set by " << seconds << " s";
  }
  program.send_signal(SIGTERM);
  EXPECT_EQ(program.wait(), 0);
  const auto times = ticks();
  for (std::size_t i = 1; i < times.size(); ++i) {
    EXPECT_GT(times[i], times[i - 1]);
    EXPECT_LT(times[i], times[i - 1] + 2'000'000);
  }
  // PROCESS_INFO has the wall clock's time, and never paused either.
  const std::vector<process_info_t> infos = read_log(folder_ / "out", kProcessInfo);
  ASSERT_GE(infos.size(), 4U);
  const auto [least, most] = std::minmax_element(
      infos.begin(), infos.end(), [](const auto& a, const auto& b) { return a.utime < b.utime; });
  EXPECT_GT(most->utime - least->utime, std::int64_t{86400 + 7200 - 60} * 1'000'000);
}

TEST_F(ProcessTest, AHandlersExceptionIsOneLineAndExitCodeOne) {
  write_statuses("in", 1);
  Program program(relay({"--fail", "--in", url("in", "?speed=0")}));
  EXPECT_EQ(program.wait(), 1);
  EXPECT_EQ(program.err(), "relay: the handler failed\n");
}

TEST_F(ProcessTest, TheEndHandlersAreCalledAlsoWhenAHandlerThrew) {
  write_statuses("in", 1);
  Program program(relay(
      {"--fail", "--fail-at-end", "--in", url("in", "?speed=0"), "--out", url("out", "?mode=w")}));
  EXPECT_EQ(program.wait(), 1);
  EXPECT_EQ(program.err(), "relay: the handler failed\n") << "the first exception is the cause";
  EXPECT_EQ(program.out(), "first end\nsecond end\n");
  const std::vector<process_info_t> infos = read_log(folder_ / "out", kProcessInfo);
  ASSERT_EQ(infos.size(), 1U);
  EXPECT_EQ(infos.back().phase, process_info_t::PHASE_ENDED);
}

TEST_F(ProcessTest, AReplayEndsByItselfAndWritesProcessInfoOnceAtTheEnd) {
  write_statuses("in", 30);
  Program program(relay({"--in", url("in", "?speed=0"), "--out", url("out", "?mode=w")}));
  EXPECT_EQ(program.wait(), 0) << program.err();
  EXPECT_EQ(read_log(folder_ / "out", kMotionStatus).size(), 31U);
  const std::vector<process_info_t> infos = read_log(folder_ / "out", kProcessInfo);
  ASSERT_EQ(infos.size(), 1U);
  std::map<std::string, std::int64_t> counters;
  for (const counter_t& counter : infos[0].counters) counters[counter.counter_name] = counter.count;
  EXPECT_EQ(counters.at("relayed"), 30);
  EXPECT_EQ(counters.at("received MOTION_STATUS"), 30);
  EXPECT_EQ(counters.at("malformed SAMPLE"), 0);
  EXPECT_EQ(counters.at("published MOTION_STATUS"), 31);
  EXPECT_EQ(infos[0].utime, example_sample().utime);
  EXPECT_EQ(infos[0].activity, "relays");
}

TEST_F(ProcessTest, TwoReplaysDifferInTheProcessIdOnly) {
  write_statuses("in", 30);
  for (const char* name : {"one", "two"}) {
    Program program(relay({"--in", url("in", "?speed=0"), "--out", url(name, "?mode=w")}));
    ASSERT_EQ(program.wait(), 0);
  }
  const auto events = [&](const std::string& name) {
    std::vector<std::pair<std::int64_t, std::vector<std::uint8_t>>> result;
    for_each_event(folder_ / name, [&](const LogEvent& event) {
      std::vector<std::uint8_t> data = event.data;
      if (event.channel == kProcessInfo.name) {
        process_info_t info = *decode<process_info_t>(data.data(), data.size()).message;
        info.pid = 1;
        data = encode(kProcessInfo, info);
      }
      result.emplace_back(event.event_utime, data);
    });
    return result;
  };
  EXPECT_EQ(events("one"), events("two"));
}

TEST_F(ProcessTest, AReplayWithoutOutPublishesNowhere) {
  write_statuses("in", 3);
  ::setenv("LCM_DEFAULT_URL", url("never", "?mode=w").c_str(), 1);
  Program program(relay({"--in", url("in", "?speed=0")}));
  ::unsetenv("LCM_DEFAULT_URL");
  EXPECT_EQ(program.wait(), 0) << program.err();
  EXPECT_FALSE(std::filesystem::exists(folder_ / "never"));
}

}  // namespace
}  // namespace bodyschema::test
