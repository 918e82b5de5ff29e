// Two processes of one name on a bus. Runs in tests/private_bus.sh.

#include <gtest/gtest.h>
#include <signal.h>

#include <algorithm>
#include <chrono>
#include <fstream>
#include <memory>
#include <string>
#include <vector>

#include "common/text/clock.h"
#include "tests/common/bus/bus_test_support.h"
#include "tests/lcmtypes/example_messages.h"

namespace bodyschema::test {
namespace {

const char* const kUrl = "udpm://239.255.76.67:7667?ttl=0";

class Twins : public testing::Test {
 protected:
  Twins() : bus_(kUrl, kUrl) {
    std::ofstream(folder_ / "relay.yaml") << "a: 1\n";
    bus_.subscribe(kProcessInfo, [this](const process_info_t& info) { infos_.push_back(info); });
    bus_.subscribe(kMotionStatus, [this](const motion_status_t& s) { answers_.push_back(s); });
  }
  std::vector<std::string> relay() const {
    return {RELAY, "--config", (folder_ / "relay.yaml").string(), "--in", kUrl, "--only-answer"};
  }
  /// Number of processes that answer a SAMPLE.
  std::size_t num_answering() {
    answers_.clear();
    if (!ask_until(
            [&] {
              bus_.publish(kSample, example_sample());
              bus_.handle(std::chrono::milliseconds(50));
            },
            [&] { return !answers_.empty(); })) {
      return 0;
    }
    std::vector<std::int64_t> epochs;
    for (const auto& answer : answers_) epochs.push_back(answer.epoch);
    std::sort(epochs.begin(), epochs.end());
    return static_cast<std::size_t>(std::unique(epochs.begin(), epochs.end()) - epochs.begin());
  }
  process_info_t heard_of(pid_t pid) {
    handle_until(bus_, [&] {
      return std::any_of(infos_.begin(), infos_.end(), [&](const auto& i) { return i.pid == pid; });
    });
    const auto info =
        std::find_if(infos_.rbegin(), infos_.rend(), [&](const auto& i) { return i.pid == pid; });
    return info == infos_.rend() ? process_info_t{} : *info;
  }

  TemporaryFolder folder_;
  Bus bus_;
  std::vector<process_info_t> infos_;
  std::vector<motion_status_t> answers_;
};

TEST_F(Twins, TheYoungerEndsBeforeItDidAnythingAndSaysWhoIsThere) {
  Program elder(relay());
  ASSERT_TRUE(elder.wait_for_output("ready"));
  Program younger(relay());
  EXPECT_EQ(younger.wait(), 1);
  EXPECT_EQ(younger.out(), "") << "it came as far as its loop";
  EXPECT_NE(
      younger.err().find("another relay is on this bus: process " + std::to_string(elder.pid())),
      std::string::npos)
      << younger.err();
  EXPECT_EQ(std::count(younger.err().begin(), younger.err().end(), '\n'), 1);
  EXPECT_EQ(num_answering(), 1U);
  elder.send_signal(SIGTERM);
  EXPECT_EQ(elder.wait(), 0);
}

TEST_F(Twins, OfSeveralThatStartTogetherOneRemains) {
  std::vector<std::unique_ptr<Program>> twins;
  for (int n = 0; n < 4; ++n) twins.push_back(std::make_unique<Program>(relay()));
  int num_left = 0;
  for (const auto& twin : twins) {
    if (twin->wait_for_output("ready", 3'000)) {
      ++num_left;
      continue;
    }
    EXPECT_EQ(twin->wait(), 1);
  }
  EXPECT_EQ(num_left, 1);
  EXPECT_EQ(num_answering(), 1U);
}

TEST_F(Twins, AfterAKillTheNextOneStarts) {
  for (int n = 0; n < 5; ++n) {
    Program program(relay());
    ASSERT_TRUE(program.wait_for_output("ready")) << program.err();
    program.send_signal(SIGKILL);
    EXPECT_EQ(program.wait(), 128 + SIGKILL);
  }
}

TEST_F(Twins, OneOnAnotherNameOrARecordingOfItselfDoesNotDisturb) {
  Program program(relay());
  ASSERT_TRUE(program.wait_for_output("ready"));
  process_info_t info = heard_of(program.pid());
  ASSERT_EQ(info.process_name, "relay");
  // An elder in an old recording.
  process_info_t recorded = info;
  recorded.start_utime -= 86'400'000'000;
  recorded.utime -= 86'400'000'000;
  bus_.publish(kProcessInfo, recorded);
  info.utime = wall_clock_us();
  info.phase = process_info_t::PHASE_WORKING;
  process_info_t other = info;
  other.process_name = "observer";
  --other.start_utime;
  bus_.publish(kProcessInfo, other);
  process_info_t ended = info;
  ended.phase = process_info_t::PHASE_ENDED;
  --ended.start_utime;
  bus_.publish(kProcessInfo, ended);
  EXPECT_EQ(num_answering(), 1U);
}

// Regression: one forged message per process ended eight of them.
TEST_F(Twins, OneThatWorksNeverEndsBecauseOfWhatOthersSayButTellsIt) {
  Program program(relay());
  ASSERT_TRUE(program.wait_for_output("ready"));
  process_info_t elder = heard_of(program.pid());
  const std::int64_t start_utime = elder.start_utime;
  elder.pid = 77;
  elder.start_utime = 0;
  elder.phase = process_info_t::PHASE_WORKING;
  const auto forge = [&] {
    elder.utime = wall_clock_us();
    bus_.publish(kProcessInfo, elder);
    bus_.handle(std::chrono::milliseconds(20));
  };
  const auto tells = [&] {
    const process_info_t info = heard_of(program.pid());
    return info.activity.find("another relay is on this bus: process 77") != std::string::npos;
  };
  // A busy elder may be heard late, but not so late.
  constexpr std::int64_t kLate_us = 5'000'000;
  ASSERT_TRUE(handle_until(bus_, [&] { return wall_clock_us() - start_utime > kLate_us; }));
  ASSERT_TRUE(ask_until(forge, tells));
  for (int n = 0; n < 30; ++n) forge();
  EXPECT_EQ(num_answering(), 1U);
  const auto counters = heard_of(program.pid()).counters;
  EXPECT_TRUE(std::any_of(counters.begin(), counters.end(), [](const counter_t& counter) {
    return counter.counter_name == "twin PROCESS_INFO" && counter.count > 0;
  }));
  // A silent twin is forgotten.
  EXPECT_TRUE(handle_until(bus_, [&] { return !tells(); }));
  program.send_signal(SIGTERM);
  EXPECT_EQ(program.wait(), 0);
}

TEST_F(Twins, AStartIsNotPreventedByOneMessageButByOneThatGoesOn) {
  process_info_t elder = example_process_info();
  elder.process_name = "relay";
  elder.start_utime = 0;
  elder.phase = process_info_t::PHASE_WORKING;
  {
    Program program(relay());
    // Repetitions of one message count as one.
    elder.utime = wall_clock_us();
    ASSERT_TRUE(ask_until(
        [&] {
          bus_.publish(kProcessInfo, elder);
          bus_.handle(std::chrono::milliseconds(20));
        },
        [&] { return program.wait_for_output("ready", 1); }));
  }
  Program program(relay());
  ask_until(
      [&] {
        elder.utime = wall_clock_us();
        bus_.publish(kProcessInfo, elder);
        bus_.handle(std::chrono::milliseconds(20));
      },
      [&] { return program.wait_for_output("ready", 1) || !program.err().empty(); });
  EXPECT_EQ(program.wait(), 1);
  EXPECT_NE(program.err().find("another relay is on this bus"), std::string::npos) << program.err();
}

}  // namespace
}  // namespace bodyschema::test
