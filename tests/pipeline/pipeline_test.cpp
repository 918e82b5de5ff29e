// What a run of the group learns, records, prints and leaves behind.

#include <gtest/gtest.h>
#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

#include <chrono>
#include <map>
#include <nlohmann/json.hpp>
#include <opencv2/imgcodecs.hpp>
#include <set>
#include <string>
#include <vector>

#include "tests/pipeline/arm2_group.h"

namespace bodyschema::test {
namespace {

/// How often each thread of the run went to sleep so far, by its path in /proc: every time but the
/// first it had been woken. Unlike its processor time this does not depend on how fast the machine
/// is.
std::map<std::string, long> sleeps_of(const fs::path& run_folder) {
  std::map<std::string, long> sleeps;
  for (const std::string& process : processes_of(run_folder)) {
    const std::string pid = process.substr(0, process.find(' '));
    std::error_code ended;
    for (const auto& task : fs::directory_iterator("/proc/" + pid + "/task", ended)) {
      const std::string status = text_of(task.path() / "status");
      const std::string key = "\nvoluntary_ctxt_switches:";
      if (const auto at = status.find(key); at != std::string::npos)
        sleeps[task.path()] = std::stol(status.substr(at + key.size()));
    }
  }
  return sleeps;
}

TEST_F(Arm2, TheStructureIsRightAfterThirtySamples) {
  const RigTruth truth(kSource / "config/arm2");
  const auto schemas = read_log(run("first") / "schema.lcmlog", kBodySchema);
  ASSERT_EQ(schemas.size(), 1u);
  EXPECT_EQ(truth.objection(from_message(schemas[0]), truth.parts()), "");
}

TEST_F(Arm2, TheResultSaysWhatWasLearnedAndHowWell) {
  const auto result = nlohmann::json::parse(text_of(run("first") / "result.json"));
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
  const std::string out = text_of(folder_ / "first.out");
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
  const std::string page = text_of(html);
  for (const char* part :
       {"The body is known: 5 parts", "src=\"data:image/jpeg;base64,/9j/",
        "the simulator’s noise-free truth", "end effector", "frame → MARKER_POSES",
        "ACTION_COMMAND → SAMPLE", "<h2>Events</h2>", "Processor time", "<h2>Configuration</h2>"}) {
    EXPECT_NE(page.find(part), std::string::npos) << part;
  }
  EXPECT_EQ(page.find("class=\"warn\""), std::string::npos);
}

TEST_F(Arm2, NoProcessIsLeftBehind) {
  for (const char* name : {"first", "second"}) {
    EXPECT_EQ(processes_of(fs::canonical(run(name))), std::vector<std::string>{}) << name;
    std::string socket = text_of(run(name) / "socket");
    ASSERT_FALSE(socket.empty());
    EXPECT_FALSE(fs::exists(fs::path(socket).parent_path())) << "supervisord's private folder";
    const std::string log = text_of(run(name) / "supervisord.log");
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
  ASSERT_TRUE(is_running) << text_of(folder_ / "killed.err");
  EXPECT_GE(before, 9u) << "the search for processes finds the group while it runs";
  const bool has_ended =
      becomes_true(std::chrono::seconds(20), [&] { return processes_of(folder).empty(); });
  const std::vector<std::string> left = processes_of(folder);
  EXPECT_TRUE(has_ended) << testing::PrintToString(left);
  // This test must not leave them behind either.
  for (const std::string& process : left) ::kill(std::stoi(process), SIGKILL);
}

// A lab's robot: tags, prints, lens and joints differ from the rig's files.
TEST_F(Arm2, WithCalibrationErrorsArm4IsLearnedRight) {
  ASSERT_EQ(shell(run_command("honest", "--rig arm4 --seed 3 --samples 30")), 0)
      << text_of(folder_ / "honest.err");
  const RigTruth truth(kSource / "config/arm4");
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
  EXPECT_NE(text_of(folder_ / "honest.out").find("aligned median"), std::string::npos);
}

TEST_F(Arm2, AMisspeltCommandNamesTheNearest) {
  EXPECT_NE(shell(run_command("misspelt", "lern")), 0);
  EXPECT_NE(text_of(folder_ / "misspelt.err").find("did you mean 'learn'?"), std::string::npos)
      << text_of(folder_ / "misspelt.err");
}

TEST_F(Arm2, ASecondGroupInTheSameFolderIsRefusedAndTheFirstGoesOn) {
  ASSERT_EQ(shell(run_command("twice", "--rig arm2 --ideal --seed 3 --samples 5 --keep")), 0)
      << text_of(folder_ / "twice.err");
  const fs::path folder = fs::canonical(run("twice"));
  const auto status = [&] {
    EXPECT_EQ(shell(run_command("twice", "status --json --seconds 5.2")), 0)
        << text_of(folder_ / "twice.err");
    return nlohmann::json::parse(text_of(folder_ / "twice.out"));
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
  // Nobody polls, nobody spins: up to 26 wakings a second are eight processes' signs of life. A
  // thread that polls every 20 ms would show.
  EXPECT_GE(slept_before.size(), 18u);
  for (const auto& [thread, count] : slept_before) {
    ASSERT_TRUE(slept.contains(thread)) << thread << " ended";
    EXPECT_LT(static_cast<double>(slept.at(thread) - count) / seconds, 45) << "of " << thread;
  }
  EXPECT_LT(cpu_percent, 50) << "processor time of an idle group, of one core: "
                             << group["processes"].dump(1);
  const std::size_t before = processes_of(folder).size();
  EXPECT_GE(before, 9u);
  EXPECT_NE(shell(run_command("twice", "--rig arm2 --ideal --seed 3 --samples 5")), 0);
  EXPECT_NE(text_of(folder_ / "twice.err").find("a group runs already, from " + folder.string()),
            std::string::npos);
  EXPECT_EQ(processes_of(folder).size(), before);
  EXPECT_EQ(shell(run_command("twice", "stop")), 0);
  EXPECT_EQ(processes_of(folder), std::vector<std::string>{});
}

}  // namespace
}  // namespace bodyschema::test
