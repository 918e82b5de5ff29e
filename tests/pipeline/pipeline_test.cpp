// The whole group on the simulated arm2: real processes, real bus, rendered images, launched as a
// user would by ./run. One program, one run shared by all tests.

#include <gtest/gtest.h>
#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <functional>
#include <map>
#include <nlohmann/json.hpp>
#include <opencv2/imgcodecs.hpp>
#include <set>
#include <sstream>
#include <string>
#include <vector>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "tests/support/rig_truth.h"

namespace bodyschema {
namespace {

namespace fs = std::filesystem;

const fs::path kSource = BODYSCHEMA_SOURCE_FOLDER;
const fs::path kBin = BODYSCHEMA_BIN_FOLDER;

int shell(const std::string& command) {
  const int status = std::system(command.c_str());
  return WIFEXITED(status) ? WEXITSTATUS(status) : 128;
}

std::string in_quotes(const fs::path& path) { return "'" + path.string() + "'"; }

std::string contents(const fs::path& file) {
  std::ifstream stream(file, std::ios::binary);
  std::stringstream text;
  text << stream.rdbuf();
  return text.str();
}

/// Raw payloads of one channel, one after the other.
std::string payloads(const fs::path& log, const std::string& channel, bool only_last = false) {
  std::string bytes;
  for_each_event(log, [&](const LogEvent& event) {
    if (event.channel != channel) return;
    if (only_last) bytes.clear();
    bytes.append(event.data.begin(), event.data.end());
  });
  return bytes;
}

/// The payloads of one channel that `is_wanted`, each once, in the order in which they first came:
/// the number of 1 Hz repetitions depends on the clock, and differs between a replay and the live
/// run. (The camera repeats all frames of an action in turn, so neighbours are not enough.)
template <class Message>
std::vector<std::string> distinct_payloads(
    const fs::path& log, const Channel<Message>& channel,
    const std::function<bool(const Message&)>& is_wanted = [](const Message&) { return true; }) {
  std::vector<std::string> distinct;
  std::set<std::string> seen;
  for_each_event(log, [&](const LogEvent& event) {
    if (event.channel != channel.name) return;
    const auto decoded = decode<Message>(event.data.data(), event.data.size());
    if (!decoded.message) throw std::runtime_error(decoded.problem);
    const std::string payload(event.data.begin(), event.data.end());
    if (is_wanted(*decoded.message) && seen.insert(payload).second) distinct.push_back(payload);
  });
  return distinct;
}

/// Not EXPECT_EQ, which would print megabytes.
testing::AssertionResult are_equal(const std::vector<std::string>& replayed,
                                   const std::vector<std::string>& live) {
  if (live.empty()) return testing::AssertionFailure() << "nothing was recorded live";
  const std::size_t n = std::min(replayed.size(), live.size());
  for (std::size_t i = 0; i < n; ++i) {
    if (replayed[i] != live[i]) return testing::AssertionFailure() << "payload " << i << " differs";
  }
  if (replayed.size() == live.size()) return testing::AssertionSuccess();
  return testing::AssertionFailure()
         << replayed.size() << " payloads replayed, " << live.size() << " live";
}

/// The same of bytes.
testing::AssertionResult are_equal(const std::string& one, const std::string& other) {
  if (one.empty() && other.empty()) return testing::AssertionFailure() << "nothing was recorded";
  if (one == other) return testing::AssertionSuccess();
  const auto end =
      std::mismatch(one.begin(), one.begin() + std::min(one.size(), other.size()), other.begin());
  return testing::AssertionFailure() << one.size() << " and " << other.size()
                                     << " bytes differ from byte " << end.first - one.begin();
}

/// "pid command line" of every process that has the run folder in its environment, which all
/// processes of ./run inherit.
std::vector<std::string> processes_of(const fs::path& run_folder) {
  const std::string mark = "BODYSCHEMA_RUN=" + run_folder.string() + '\0';
  std::vector<std::string> found;
  for (const auto& entry : fs::directory_iterator("/proc")) {
    const std::string pid = entry.path().filename();
    if (pid.find_first_not_of("0123456789") != std::string::npos) continue;
    if (('\0' + contents(entry.path() / "environ")).find('\0' + mark) == std::string::npos)
      continue;
    std::string command = contents(entry.path() / "cmdline");
    std::replace(command.begin(), command.end(), '\0', ' ');
    found.push_back(pid + " " + command);
  }
  return found;
}

/// How often each process of the run went to sleep so far, by process id: every time but the first
/// it had been woken. Unlike its processor time this does not depend on how fast the machine is.
std::map<std::string, long> sleeps_of(const fs::path& run_folder) {
  std::map<std::string, long> sleeps;
  for (const std::string& process : processes_of(run_folder)) {
    const std::string pid = process.substr(0, process.find(' '));
    std::error_code ended;
    for (const auto& task : fs::directory_iterator("/proc/" + pid + "/task", ended)) {
      const std::string status = contents(task.path() / "status");
      const std::string key = "\nvoluntary_ctxt_switches:";
      if (const auto at = status.find(key); at != std::string::npos)
        sleeps[pid] += std::stol(status.substr(at + key.size()));
    }
  }
  return sleeps;
}

/// Asks every 50 ms, for at most `limit`.
bool becomes_true(std::chrono::seconds limit, const std::function<bool()>& condition) {
  const auto end = std::chrono::steady_clock::now() + limit;
  while (!condition()) {
    if (std::chrono::steady_clock::now() > end) return false;
    ::usleep(50'000);
  }
  return true;
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
  void SetUp() override { ASSERT_EQ(exit_code_, 0) << contents(folder_ / "first.err"); }

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
    return nlohmann::json::parse(contents(run(name) / "result.json"));
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
        << contents(err);
    return out;
  }
  static std::string log_url(const fs::path& log) { return "file://" + log.string() + "?speed=0"; }
  static fs::path run(const std::string& name) { return folder_ / name / "current"; }

  static fs::path folder_;
  static int exit_code_;
  static int second_exit_code_;
};

fs::path Arm2::folder_;
int Arm2::exit_code_ = -1;
int Arm2::second_exit_code_ = -1;

TEST_F(Arm2, TheStructureIsRightAfterThirtySamples) {
  const test::RigTruth truth(kSource / "config/arm2");
  const auto schemas = read_log(run("first") / "schema.lcmlog", kBodySchema);
  ASSERT_EQ(schemas.size(), 1u);
  EXPECT_EQ(truth.objection(from_message(schemas[0]), truth.parts()), "");
}

TEST_F(Arm2, TheResultSaysWhatWasLearnedAndHowWell) {
  const auto result = nlohmann::json::parse(contents(run("first") / "result.json"));
  EXPECT_EQ(result["rig"], "arm2");
  EXPECT_EQ(result["seed"], 3);
  EXPECT_EQ(result["samples"], 30);
  EXPECT_GT(result["seconds"], 0);
  EXPECT_EQ(result["structure"]["complete"], true);
  EXPECT_EQ(result["structure"]["samples"], 24);  // every fifth is TEST
  EXPECT_EQ(result["structure"]["edges"].size(), 4u);
  EXPECT_EQ(result["held_out"]["samples"], 6);
  EXPECT_EQ(result["held_out_against"], "noise-free simulator");
  ASSERT_EQ(result["held_out"]["parts"].size(), 4u);
  for (const auto& part : result["held_out"]["parts"]) {
    EXPECT_EQ(part["count"], 6);
    EXPECT_LT(part["position_median_m"], 0.0003) << part;
    EXPECT_LT(part["rotation_median_deg"], 0.03) << part;
    EXPECT_GT(part["position_median_m"], 0.0)
        << "the learned model cannot be exact: was it the truth?";
  }
}

TEST_F(Arm2, TheResultNamesEachFileOnce) {
  const std::string out = contents(folder_ / "first.out");
  for (const char* file : {"result.json", "report.html", "samples.lcmlog", "run.lcmlog.00"}) {
    const std::size_t place = out.find(std::string("  ") + file + " ");
    ASSERT_NE(place, std::string::npos) << file << " in " << out;
    EXPECT_EQ(out.find(std::string("  ") + file + " ", place + 1), std::string::npos) << file;
  }
}

TEST_F(Arm2, NothingWasLostOnTheWay) {
  const auto utimes = [](const fs::path& log, const auto& channel) {
    std::set<std::int64_t> times;
    for (const auto& message : read_log(run("first") / log, channel)) {
      // The two frames of the start pose may have passed before the loggers listened.
      if (message.image_seq >= 2) times.insert(message.utime);
    }
    return times;
  };
  const auto images = utimes("images.lcmlog.00", kCameraImage);
  const auto markers = utimes("run.lcmlog.00", kMarkerPoses);
  EXPECT_GE(images.size(), 60u) << "two a sample";
  EXPECT_EQ(images, markers);
  std::map<std::string, std::int64_t> losses;
  for (const process_info_t& info : read_log(run("first") / "run.lcmlog.00", kProcessInfo)) {
    for (const counter_t& counter : info.counters) {
      for (const char* loss :
           {"skipped", "malformed", "senseless", "refused", "dropped", "lost", "send failed"}) {
        if (counter.count > 0 && counter.counter_name.starts_with(loss))
          losses[info.process_name + ": " + counter.counter_name] = counter.count;
      }
    }
  }
  EXPECT_TRUE(losses.empty()) << testing::PrintToString(losses);
}

TEST_F(Arm2, ThePictureIsAFrameWithMarkersDrawnIn) {
  const cv::Mat picture = cv::imread((run("first") / "detections.png").string());
  ASSERT_EQ(picture.size(), cv::Size(1280, 960));
  // The frame is grey; coloured pixels were drawn: outlines (yellow) and the axes of each marker.
  int num_yellow = 0, num_red = 0, num_blue = 0;
  for (const cv::Vec3b& bgr : cv::Mat_<cv::Vec3b>(picture)) {
    num_yellow += bgr[2] - bgr[0] > 100 && bgr[1] - bgr[0] > 60;
    num_red += bgr[2] - bgr[1] > 100;
    num_blue += bgr[0] - bgr[2] > 100;
  }
  EXPECT_GT(num_yellow, 500);
  EXPECT_GT(num_red, 50);
  EXPECT_GT(num_blue, 10);
}

TEST_F(Arm2, TheReportTellsTheRunWithItsPictureAndAgainstTheTruth) {
  const fs::path html = folder_ / "report.html";
  ASSERT_EQ(shell(in_quotes(kBin / "bodyschema") + " report " + in_quotes(run("first")) +
                  " --out " + in_quotes(html) + " >/dev/null"),
            0);
  const std::string page = contents(html);
  for (const char* part :
       {"The body is known: 5 parts", "src=\"data:image/jpeg;base64,/9j/",
        "the simulator’s noise-free truth", "end effector", "frame → MARKER_POSES",
        "ACTION_COMMAND → SAMPLE", "<h2>Events</h2>", "Processor time", "<h2>Configuration</h2>"}) {
    EXPECT_NE(page.find(part), std::string::npos) << part;
  }
  EXPECT_EQ(page.find("class=\"warn\""), std::string::npos);
}

TEST_F(Arm2, TheBusAndTheImagesAreRecordedApart) {
  EXPECT_FALSE(payloads(run("first") / "images.lcmlog.00", "CAMERA_IMAGE").empty());
  EXPECT_TRUE(payloads(run("first") / "images.lcmlog.00", "SAMPLE").empty());
  EXPECT_TRUE(payloads(run("first") / "run.lcmlog.00", "CAMERA_IMAGE").empty());
  // On the bus the newest sample is repeated; in the file each stands once.
  EXPECT_TRUE(are_equal(distinct_payloads(run("first") / "run.lcmlog.00", kSample),
                        distinct_payloads(run("first") / "samples.lcmlog", kSample)));
  EXPECT_EQ(read_log(run("first") / "samples.lcmlog", kSample).size(), 30u);
}

TEST_F(Arm2, TwoRunsWithOneSeedAreIdentical) {
  ASSERT_EQ(second_exit_code_, 0) << contents(folder_ / "second.err");
  EXPECT_TRUE(are_equal(payloads(run("first") / "samples.lcmlog", "SAMPLE"),
                        payloads(run("second") / "samples.lcmlog", "SAMPLE")));
  EXPECT_TRUE(are_equal(payloads(run("first") / "schema.lcmlog", "BODY_SCHEMA"),
                        payloads(run("second") / "schema.lcmlog", "BODY_SCHEMA")));
}

TEST_F(Arm2, NoProcessIsLeftBehind) {
  for (const char* name : {"first", "second"}) {
    EXPECT_EQ(processes_of(fs::canonical(run(name))), std::vector<std::string>{}) << name;
    std::string socket = contents(run(name) / "socket");
    ASSERT_FALSE(socket.empty());
    EXPECT_FALSE(fs::exists(fs::path(socket).parent_path())) << "supervisord's private folder";
    const std::string log = contents(run(name) / "supervisord.log");
    EXPECT_NE(log.find("stopped: robot_simulator (exit status 0)"), std::string::npos) << log;
  }
}

TEST_F(Arm2, NoProcessIsLeftBehindWhenTheScriptIsKilled) {
  const std::string line = command("killed", 300);
  const pid_t script = ::fork();
  ASSERT_GE(script, 0);
  if (script == 0) {
    ::execl("/bin/sh", "sh", "-c", line.c_str(), nullptr);
    ::_exit(127);
  }
  const bool is_running = becomes_true(std::chrono::seconds(60), [] {
    std::error_code error;
    return fs::file_size(run("killed") / "samples.lcmlog", error) > 0 && !error;
  });
  std::error_code no_run;
  const fs::path folder = fs::canonical(run("killed"), no_run);
  const std::size_t before = no_run ? 0 : processes_of(folder).size();
  ::kill(script, SIGKILL);
  ::waitpid(script, nullptr, 0);
  ASSERT_TRUE(is_running) << contents(folder_ / "killed.err");
  EXPECT_GE(before, 9u) << "the search for processes finds the group while it runs";
  const bool has_ended =
      becomes_true(std::chrono::seconds(20), [&] { return processes_of(folder).empty(); });
  const std::vector<std::string> left = processes_of(folder);
  EXPECT_TRUE(has_ended) << testing::PrintToString(left);
  // This test must not leave them behind either.
  for (const std::string& process : left) ::kill(std::stoi(process), SIGKILL);
}

TEST_F(Arm2, AReplayThroughTheObserverGivesTheSameSamples) {
  EXPECT_TRUE(are_equal(distinct_payloads(replay("observer"), kSample),
                        distinct_payloads(run("first") / "run.lcmlog.00", kSample)));
}

TEST_F(Arm2, AReplayThroughTheSimulatorGivesTheSameStates) {
  // Live, the state before the first action is repeated at 1 Hz; no command causes it.
  const auto states = [](const fs::path& log) {
    return distinct_payloads<sim_state_t>(
        log, kSimState, [](const sim_state_t& state) { return state.action_id >= 0; });
  };
  EXPECT_TRUE(are_equal(states(replay("robot_simulator", "--seed 3 --ideal")),
                        states(run("first") / "run.lcmlog.00")));
}

TEST_F(Arm2, AReplayThroughTheBabblerGivesTheSameActions) {
  EXPECT_TRUE(
      are_equal(distinct_payloads(replay("motor_babbler", "--seed 3 --samples 30"), kActionCommand),
                distinct_payloads(run("first") / "run.lcmlog.00", kActionCommand)));
}

TEST_F(Arm2, AReplayThroughTheCameraGivesTheSameImages) {
  // The two frames of the start pose may have passed live before the logger listened.
  const auto images = [](const fs::path& log) {
    return distinct_payloads<camera_image_t>(
        log, kCameraImage, [](const camera_image_t& image) { return image.image_seq >= 2; });
  };
  EXPECT_TRUE(
      are_equal(images(replay("camera", "--ideal")), images(run("first") / "images.lcmlog.00")));
}

TEST_F(Arm2, AReplayThroughTheMarkerEstimatorGivesTheSamePoses) {
  const auto poses = [](const fs::path& log) {
    return distinct_payloads<marker_poses_t>(
        log, kMarkerPoses, [](const marker_poses_t& frame) { return frame.image_seq >= 2; });
  };
  const fs::path images = run("first") / "images.lcmlog.00";
  EXPECT_TRUE(are_equal(poses(replay("marker_estimator", "--images " + in_quotes(log_url(images)))),
                        poses(run("first") / "run.lcmlog.00")));
}

TEST_F(Arm2, AReplayFromTheLogGivesTheSameSchemaBytesTwice) {
  const std::string live = payloads(run("first") / "run.lcmlog.00", "LEARNED_SCHEMA", true);
  ASSERT_FALSE(live.empty());
  for (const char* name : {"replay1.lcmlog", "replay2.lcmlog"}) {
    const fs::path out = folder_ / name;
    ASSERT_EQ(shell(in_quotes(kBin / "structure_learner") + " --config " +
                    in_quotes(run("first") / "config/structure_learner.yaml") + " --in " +
                    in_quotes("file://" + (run("first") / "samples.lcmlog").string() + "?speed=0") +
                    " --out " + in_quotes("file://" + out.string() + "?mode=w") + " 2>/dev/null"),
              0);
    EXPECT_TRUE(are_equal(payloads(out, "LEARNED_SCHEMA", true), live));
  }
}

TEST_F(Arm2, AReplayThroughTheMonitorGivesTheSameBodySchemaBytes) {
  const fs::path out = folder_ / "monitor.lcmlog";
  ASSERT_EQ(shell(in_quotes(kBin / "model_monitor") + " --config " +
                  in_quotes(run("first") / "config/model_monitor.yaml") + " --in " +
                  in_quotes("file://" + (run("first") / "run.lcmlog.00").string() + "?speed=0") +
                  " --out " + in_quotes("file://" + out.string() + "?mode=w") + " 2>/dev/null"),
            0);
  EXPECT_TRUE(are_equal(payloads(out, "BODY_SCHEMA", true),
                        payloads(run("first") / "schema.lcmlog", "BODY_SCHEMA")));
}

TEST_F(Arm2, LogplayerOnALiveBusGivesTheSameSchemaBytes) {
  const fs::path expected = folder_ / "expected";
  std::ofstream(expected, std::ios::binary)
      << payloads(run("first") / "run.lcmlog.00", "LEARNED_SCHEMA", true);
  const int status = shell(in_quotes(kSource / "tests/private_bus.sh") + " " +
                           in_quotes(kSource / "tests/pipeline/replay_live.sh") + " " +
                           in_quotes(kBin) + " " + in_quotes(run("first") / "config") + " " +
                           in_quotes(run("first") / "samples.lcmlog") + " " + in_quotes(expected));
  if (status == 77) GTEST_SKIP() << "no user namespaces";
  EXPECT_EQ(status, 0);
}

TEST_F(Arm2, LearningFromTheSampleLogOfflineGivesTheStructureOfTheRun) {
  const fs::path json = folder_ / "learned.json";
  ASSERT_EQ(
      shell(in_quotes(kBin / "bodyschema") + " learn " +
            in_quotes(run("first") / "samples.lcmlog") + " --root 1 --json >" + in_quotes(json)),
      0);
  auto learned = nlohmann::json::parse(contents(json));
  const auto result = nlohmann::json::parse(contents(run("first") / "result.json"));
  EXPECT_EQ(learned["noise"]["from"], "covariances");
  learned["noise"].erase("from");  // neither is in a schema
  learned.erase("one_cluster");
  EXPECT_EQ(learned, result["structure"]);
}

TEST_F(Arm2, AReplayOfTheGroupLearnsWhatTheRunLearned) {
  ASSERT_EQ(replay_group("again", run("first") / "run.lcmlog.00"), 0)
      << contents(folder_ / "again.err");
  EXPECT_TRUE(are_equal(payloads(run("again") / "samples.lcmlog", "SAMPLE"),
                        payloads(run("first") / "samples.lcmlog", "SAMPLE")));
  EXPECT_TRUE(are_equal(payloads(run("again") / "schema.lcmlog", "BODY_SCHEMA"),
                        payloads(run("first") / "schema.lcmlog", "BODY_SCHEMA")));
  for (const char* key : {"rig", "samples", "structure", "held_out", "held_out_against"})
    EXPECT_EQ(result("again")[key], result("first")[key]) << key;
  EXPECT_EQ(result("again")["replay_of"], fs::canonical(run("first") / "run.lcmlog.00").string());
  EXPECT_NE(contents(folder_ / "again.out").find("arm2 · replay of "), std::string::npos);
  EXPECT_EQ(processes_of(fs::canonical(run("again"))), std::vector<std::string>{});
}

TEST_F(Arm2, APlayedReplayLearnsTheSameAndNoCommandIsOnItsBus) {
  ASSERT_EQ(replay_group("played", run("first") / "run.lcmlog.00", "--speed 5"), 0)
      << contents(folder_ / "played.err");
  EXPECT_TRUE(are_equal(payloads(run("played") / "schema.lcmlog", "BODY_SCHEMA"),
                        payloads(run("first") / "schema.lcmlog", "BODY_SCHEMA")));
  EXPECT_TRUE(are_equal(payloads(run("played") / "samples.lcmlog", "SAMPLE"),
                        payloads(run("first") / "samples.lcmlog", "SAMPLE")));
  EXPECT_EQ(result("played")["lost_frames"], 0);
  EXPECT_EQ(result("played")["lost_samples"], nlohmann::json::array());
  std::set<std::string> channels;
  for_each_event(run("played") / "run.lcmlog.00",
                 [&](const LogEvent& event) { channels.insert(event.channel); });
  EXPECT_TRUE(channels.count("MARKER_POSES"));
  EXPECT_FALSE(channels.count("ACTION_COMMAND"));
  EXPECT_FALSE(channels.count("SIM_STATE")) << "the truth is on the bus";
  for (const char* robot : {"robot_simulator.log", "motor_babbler.log", "camera.log"})
    EXPECT_FALSE(fs::exists(run("played") / robot)) << robot;
}

TEST_F(Arm2, AReplayWithAHoleSaysWhatIsLostAndLearnsFromTheRest) {
  const auto without = [](const std::string& name, const std::set<std::int64_t>& removed) {
    const fs::path holed = folder_ / (name + ".lcmlog");
    LogAppender log(holed, LogAppender::Mode::kOverwrite, LogAppender::Durability::kToKernel);
    for (const sample_t& sample : read_log(kSource / "logs/arm2_15.lcmlog", kSample)) {
      if (!removed.count(sample.sample_index)) log.append(kSample, sample);
    }
    return holed;
  };
  const auto expect = [&](const std::string& name, const fs::path& log, const std::string& flags,
                          int samples, const std::string& said) {
    ASSERT_EQ(replay_group(name, log, "--rig arm2 " + flags), 0)
        << contents(folder_ / (name + ".err"));
    EXPECT_EQ(result(name)["samples"], samples);
    const std::string out = contents(folder_ / (name + ".out"));
    EXPECT_NE(out.find("\n" + said + "\n"), std::string::npos) << out;
  };
  const fs::path middle = without("middle", {7});
  expect("without 7", middle, "", 14, "lost SAMPLE 7");
  expect("without 7, played", middle, "--speed 20", 14, "lost SAMPLE 7");
  expect("without the first", without("first five", {0, 1, 2, 3, 4}), "", 10, "lost SAMPLE 0…4");
  EXPECT_EQ(result("without the first")["lost_samples"], nlohmann::json({{0, 4}}));
}

// A lab's robot: tags, prints, lens and joints differ from the rig's files.
TEST_F(Arm2, WithCalibrationErrorsArm4IsLearnedRight) {
  ASSERT_EQ(shell(run_command("honest", "--rig arm4 --seed 3 --samples 30")), 0)
      << contents(folder_ / "honest.err");
  const test::RigTruth truth(kSource / "config/arm4");
  const auto schemas = read_log(run("honest") / "schema.lcmlog", kBodySchema);
  ASSERT_EQ(schemas.size(), 1u);
  EXPECT_EQ(truth.objection(from_message(schemas[0]), truth.parts()), "");
  const nlohmann::json honest = result("honest");
  EXPECT_EQ(honest["wrong"], nlohmann::json::array());
  EXPECT_NEAR(honest["held_out"]["scale"].get<double>(), 1, 0.01);
  EXPECT_NE(honest["held_out"]["scale"], 1);
  ASSERT_EQ(honest["held_out"]["parts"].size(), 4u);
  for (const auto& part : honest["held_out"]["parts"]) {
    EXPECT_LT(part["aligned_position_median_m"], 0.002) << part;
    EXPECT_LT(part["aligned_rotation_median_deg"], 0.5) << part;
    EXPECT_LT(part["aligned_position_median_m"], part["position_median_m"]) << part;
  }
  EXPECT_NE(contents(folder_ / "honest.out").find("aligned median"), std::string::npos);
}

TEST_F(Arm2, TheRecordingInLogsTeachesTheStructure) {
  ASSERT_EQ(replay_group("example", kSource / "logs/arm2_15.lcmlog", "--rig arm2"), 0)
      << contents(folder_ / "example.err");
  EXPECT_EQ(contents(folder_ / "example.err").find("cannot be read"), std::string::npos)
      << "make it again, as logs/README.md says: " << contents(folder_ / "example.err");
  const test::RigTruth truth(kSource / "config/arm2");
  const auto schemas = read_log(run("example") / "schema.lcmlog", kBodySchema);
  ASSERT_EQ(schemas.size(), 1u);
  EXPECT_EQ(truth.objection(from_message(schemas[0]), truth.parts()), "");
  EXPECT_EQ(result("example")["samples"], 15);
}

TEST_F(Arm2, AReplayOfSamplesThatAreCutOffSaysWhereAndLearnsFromTheRest) {
  const fs::path whole = run("first") / "samples.lcmlog", cut = folder_ / "cut.lcmlog";
  fs::copy_file(whole, cut, fs::copy_options::overwrite_existing);
  fs::resize_file(cut, fs::file_size(whole) * 9 / 10);
  // No rig is named and none lies beside the log: it is found from the samples.
  ASSERT_EQ(replay_group("cut", cut), 0) << contents(folder_ / "cut.err");
  EXPECT_EQ(result("cut")["rig"], "arm2");
  const int whole_samples = static_cast<int>(read_log(cut, kSample).size());
  EXPECT_EQ(result("cut")["samples"], whole_samples);
  EXPECT_EQ(result("cut")["structure"]["complete"], true);
  EXPECT_EQ(result("cut")["held_out_against"], "observations");
  const std::string said = contents(folder_ / "cut.err");
  EXPECT_NE(said.find("is cut off in the middle of an event at byte "), std::string::npos) << said;
  EXPECT_NE(said.find("; the " + std::to_string(whole_samples) + " events before it are good"),
            std::string::npos)
      << said;
}

TEST_F(Arm2, AReplayOfAnOlderVersionsLogIsRefusedWithTheReason) {
  const fs::path older = folder_ / "older.lcmlog";
  {
    LogAppender log(older, LogAppender::Mode::kOverwrite, LogAppender::Durability::kToKernel);
    for_each_event(run("first") / "samples.lcmlog", [&](const LogEvent& event) {
      std::vector<std::uint8_t> data = event.data;
      data[0] ^= 1;  // the fingerprint
      log.append_bytes(event.channel, data, event.event_utime);
    });
  }
  EXPECT_NE(replay_group("older", older, "--rig arm2"), 0);
  const std::string said = contents(folder_ / "older.err");
  EXPECT_NE(said.find("SAMPLE: 30 of 30 messages cannot be read: fingerprint "), std::string::npos)
      << said;
  EXPECT_NE(said.find("built from other message definitions"), std::string::npos) << said;
  EXPECT_NE(said.find("holds nothing to learn from"), std::string::npos) << said;
  EXPECT_FALSE(fs::exists(run("older"))) << "a run was begun";
}

TEST_F(Arm2, AMisspeltCommandNamesTheNearest) {
  EXPECT_NE(shell(run_command("misspelt", "lern")), 0);
  EXPECT_NE(contents(folder_ / "misspelt.err").find("did you mean 'learn'?"), std::string::npos)
      << contents(folder_ / "misspelt.err");
}

TEST_F(Arm2, ASecondGroupInTheSameFolderIsRefusedAndTheFirstGoesOn) {
  ASSERT_EQ(shell(run_command("twice", "--rig arm2 --ideal --seed 3 --samples 5 --keep")), 0)
      << contents(folder_ / "twice.err");
  const fs::path folder = fs::canonical(run("twice"));
  const auto status = [&] {
    EXPECT_EQ(shell(run_command("twice", "status --json --seconds 5.2")), 0)
        << contents(folder_ / "twice.err");
    return nlohmann::json::parse(contents(folder_ / "twice.out"));
  };
  const auto began = std::chrono::steady_clock::now();
  const std::map<std::string, long> slept_before = sleeps_of(folder);
  const auto group = status();
  const std::map<std::string, long> slept = sleeps_of(folder);
  const double seconds =
      std::chrono::duration<double>(std::chrono::steady_clock::now() - began).count();
  EXPECT_EQ(group["missing"], nlohmann::json::array());
  double resident_bytes = 0, cpu_percent = 0;
  for (const auto& process : group["processes"]) {
    resident_bytes += process["resident_bytes"].get<double>();
    cpu_percent += process["cpu_percent"].get<double>();
  }
  EXPECT_EQ(group["processes"].size(), 8u);
  EXPECT_LT(resident_bytes, 1.5e9);
  // Nobody polls, nobody spins: about 23 wakings a second are eight processes' signs of life, and
  // half a percent of a core each on an idle machine.
  EXPECT_GE(slept_before.size(), 9u);
  for (const auto& [pid, count] : slept_before) {
    ASSERT_TRUE(slept.contains(pid)) << pid << " ended";
    EXPECT_LT(static_cast<double>(slept.at(pid) - count) / seconds, 60) << "wakings of " << pid;
  }
  EXPECT_LT(cpu_percent, 50) << "processor time of an idle group, of one core: "
                             << group["processes"].dump(1);
  const std::size_t before = processes_of(folder).size();
  EXPECT_GE(before, 9u);
  EXPECT_NE(shell(run_command("twice", "--rig arm2 --ideal --seed 3 --samples 5")), 0);
  EXPECT_NE(contents(folder_ / "twice.err").find("a group runs already, from " + folder.string()),
            std::string::npos);
  EXPECT_EQ(processes_of(folder).size(), before);
  EXPECT_EQ(shell(run_command("twice", "stop")), 0);
  EXPECT_EQ(processes_of(folder), std::vector<std::string>{});
}

}  // namespace
}  // namespace bodyschema
