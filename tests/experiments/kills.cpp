// Result of a run whose processes are killed (kill -9) at random moments all along it, beside one
// without kills, same rig and seed. Prints Markdown; exit code 1 if a
// sample was lost or doubled, the structure is wrong or the end effector's held-out error is more
// than 20 % larger.
//
//   kills --rig arm7 --samples 100 --kills 100 --seed 1

#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <functional>
#include <map>
#include <nlohmann/json.hpp>
#include <random>
#include <set>
#include <sstream>
#include <string>
#include <thread>
#include <tuple>
#include <vector>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "tests/support/rig_truth.h"

using namespace bodyschema;

namespace {

namespace fs = std::filesystem;

const fs::path kSource = BODYSCHEMA_SOURCE_FOLDER;
const fs::path kBuild = BODYSCHEMA_BUILD_FOLDER;
/// Programs of the group, each as often as it runs in it.
const std::vector<std::string> kVictims = {"robot_simulator", "camera",        "marker_estimator",
                                           "observer",        "motor_babbler", "structure_learner",
                                           "model_monitor",   "controller",    "lcm-logger"};
constexpr double kMaxRatio = 1.2;

std::string contents(const fs::path& file) {
  std::ifstream stream(file, std::ios::binary);
  std::stringstream text;
  text << stream.rdbuf();
  return text.str();
}

/// Asks every 10 ms; false after `limit`.
bool becomes_true(std::chrono::seconds limit, const std::function<bool()>& condition) {
  const auto end = std::chrono::steady_clock::now() + limit;
  while (!condition()) {
    if (std::chrono::steady_clock::now() > end) return false;
    std::this_thread::sleep_for(std::chrono::milliseconds(10));
  }
  return true;
}

/// One ./run in a folder of its own.
class Run {
 public:
  Run(const fs::path& folder, const std::string& arguments) : folder_(folder) {
    fs::create_directories(folder);
    const std::string command = "BODYSCHEMA_BUILD='" + kBuild.string() + "' BODYSCHEMA_LOGS='" +
                                folder.string() + "' exec '" + (kSource / "run").string() + "' " +
                                arguments + " >'" + (folder / "out").string() + "' 2>'" +
                                (folder / "err").string() + "' </dev/null";
    script_ = ::fork();
    if (script_ == 0) {
      ::execl("/bin/sh", "sh", "-c", command.c_str(), nullptr);
      ::_exit(127);
    }
  }
  ~Run() {
    // ./run ends its group on the way out.
    if (script_ > 0) {
      ::kill(script_, SIGTERM);
      ::waitpid(script_, nullptr, 0);
    }
  }
  Run(const Run&) = delete;
  Run& operator=(const Run&) = delete;

  bool has_ended() {
    if (script_ <= 0) return true;
    int status = 0;
    if (::waitpid(script_, &status, WNOHANG) != script_) return false;
    exit_code_ = WIFEXITED(status) ? WEXITSTATUS(status) : 128 + WTERMSIG(status);
    script_ = -1;
    return true;
  }
  int exit_code() const { return exit_code_; }
  std::string words() const { return contents(folder_ / "err"); }
  fs::path current() const { return folder_ / "current"; }

  std::vector<sample_t> samples() const {
    const fs::path log = current() / "samples.lcmlog";
    return fs::exists(log) ? read_log(log, kSample) : std::vector<sample_t>();
  }

  /// Process ids of the program `name` in this group: those that inherited the run's folder.
  std::vector<pid_t> processes(const std::string& name) const {
    std::error_code none;
    const fs::path folder = fs::canonical(current(), none);
    if (none) return {};
    const std::string mark = '\0' + ("BODYSCHEMA_RUN=" + folder.string()) + '\0';
    std::vector<pid_t> found;
    for (const auto& entry : fs::directory_iterator("/proc")) {
      const std::string pid = entry.path().filename();
      if (pid.find_first_not_of("0123456789") != std::string::npos) continue;
      const std::string command = contents(entry.path() / "cmdline");
      if (fs::path(command.c_str()).filename() != name) continue;
      if (('\0' + contents(entry.path() / "environ")).find(mark) == std::string::npos) continue;
      found.push_back(std::stoi(pid));
    }
    std::sort(found.begin(), found.end());
    return found;
  }

 private:
  const fs::path folder_;
  pid_t script_ = -1;
  int exit_code_ = -1;
};

/// Result of a run.
struct Outcome {
  std::string objection;  ///< "" if nothing was lost, doubled or learned wrongly
  double end_effector_m = -1;
  double seconds = 0;
  std::int64_t samples = 0;
};

Outcome judge(const Run& run, const std::string& rig, std::int64_t num_samples) {
  Outcome outcome;
  const std::vector<sample_t> samples = run.samples();
  outcome.samples = static_cast<std::int64_t>(samples.size());
  std::set<std::tuple<std::string, std::int64_t, std::int64_t>> actions;
  for (std::size_t i = 0; i < samples.size(); ++i) {
    if (samples[i].sample_index != static_cast<std::int64_t>(i)) {
      outcome.objection += "sample " + std::to_string(i) + " has index " +
                           std::to_string(samples[i].sample_index) + "; ";
      break;
    }
    actions.emplace(samples[i].source, samples[i].epoch, samples[i].action_id);
  }
  if (outcome.samples != num_samples) {
    outcome.objection += std::to_string(outcome.samples) + " samples; ";
  }
  if (actions.size() != samples.size()) outcome.objection += "an action has two samples; ";

  const test::RigTruth truth(kSource / "config" / rig);
  const fs::path schema_file = run.current() / "schema.lcmlog";
  if (!fs::exists(schema_file)) {
    outcome.objection += "no schema";
  } else {
    const auto schemas = read_log(schema_file, kBodySchema);
    outcome.objection += truth.objection(from_message(schemas.at(0)), truth.parts());
  }
  if (!fs::exists(run.current() / "result.json")) {
    outcome.objection += "no result.json";
    return outcome;
  }
  const auto result = nlohmann::json::parse(contents(run.current() / "result.json"));
  outcome.seconds = result["seconds"];
  for (const auto& part : result["held_out"]["parts"]) {
    if (part["part"] == result["end_effector"] && part["position_median_m"].is_number()) {
      outcome.end_effector_m = part["position_median_m"];
    }
  }
  return outcome;
}

void print_row(const std::string& name, const Outcome& outcome) {
  std::printf("| %s | %lld | %s | %.2f mm | %.0f |\n", name.c_str(),
              static_cast<long long>(outcome.samples),
              outcome.objection.empty() ? "right" : outcome.objection.c_str(),
              1e3 * outcome.end_effector_m, outcome.seconds);
}

/// The k-th kill comes after a share k/num_kills of the samples, except their last twentieth, so
/// that the run does not end before the last kill. Kills by program.
std::map<std::string, int> kill_all_along(Run* run, std::int64_t num_samples, int num_kills,
                                          std::uint64_t seed) {
  std::mt19937_64 random(seed);
  std::map<std::string, int> killed;
  std::vector<std::string> victims;
  for (int k = 0; k < num_kills; ++k) {
    const std::int64_t after = k * (num_samples - num_samples / 20) / num_kills;
    const bool is_due = becomes_true(std::chrono::seconds(120), [&] {
      return run->has_ended() || static_cast<std::int64_t>(run->samples().size()) >= after;
    });
    if (!is_due || run->has_ended()) break;
    if (victims.empty()) {
      // Those that this version of the group has.
      becomes_true(std::chrono::seconds(30), [&] { return !run->processes("lcm-logger").empty(); });
      for (const std::string& name : kVictims) {
        if (fs::exists(kBuild / "bin" / name) || name == "lcm-logger") victims.push_back(name);
      }
    }
    std::this_thread::sleep_for(
        std::chrono::milliseconds(std::uniform_int_distribution<int>(0, 400)(random)));
    const std::string& victim =
        victims[std::uniform_int_distribution<std::size_t>(0, victims.size() - 1)(random)];
    const std::uint64_t which = random();
    std::vector<pid_t> pids;
    becomes_true(std::chrono::seconds(60), [&] {
      pids = run->processes(victim);
      return !pids.empty() || run->has_ended();
    });
    if (pids.empty()) break;
    if (::kill(pids[which % pids.size()], SIGKILL) == 0) ++killed[victim];
  }
  return killed;
}

}  // namespace

int main(int argc, char** argv) {
  std::string rig = "arm7";
  std::int64_t num_samples = 100;
  int num_kills = 100;
  std::uint64_t seed = 1;
  std::string keep;
  CLI::App app("A run whose processes are killed at random moments");
  app.add_option("--rig", rig);
  app.add_option("--samples", num_samples)->check(CLI::PositiveNumber);
  app.add_option("--kills", num_kills)->check(CLI::NonNegativeNumber);
  app.add_option("--seed", seed, "Of the run and of the kills");
  app.add_option("--logs", keep, "Folder for the logs of both runs, which are kept");
  CLI11_PARSE(app, argc, argv);

  const fs::path folder =
      keep.empty() ? fs::temp_directory_path() / ("bodyschema kills " + std::to_string(::getpid()))
                   : fs::absolute(keep);
  const std::string arguments = "--rig " + rig + " --samples " + std::to_string(num_samples) +
                                " --seed " + std::to_string(seed);

  Run calm(folder / "calm", arguments);
  if (!becomes_true(std::chrono::seconds(600), [&] { return calm.has_ended(); }) ||
      calm.exit_code() != 0) {
    std::fprintf(stderr, "kills: the run without kills failed:\n%s", calm.words().c_str());
    return 1;
  }
  const Outcome undisturbed = judge(calm, rig, num_samples);

  Run run(folder / "killed", arguments);
  const std::map<std::string, int> killed = kill_all_along(&run, num_samples, num_kills, seed);
  int num_killed = 0;
  for (const auto& [name, count] : killed) num_killed += count;
  const bool has_ended = becomes_true(std::chrono::seconds(300), [&] { return run.has_ended(); });
  const Outcome disturbed = judge(run, rig, num_samples);

  std::printf(
      "%s, seed %llu: %d kills\n\n| run | samples | structure | end effector, held out | s |\n"
      "| --- | --- | --- | --- | --- |\n",
      rig.c_str(), static_cast<unsigned long long>(seed), num_killed);
  print_row("without kills", undisturbed);
  print_row("with kills", disturbed);
  std::printf("\n| process | kills |\n| --- | --- |\n");
  for (const auto& [name, count] : killed) std::printf("| %s | %d |\n", name.c_str(), count);

  std::string problem = disturbed.objection;
  if (!has_ended || run.exit_code() != 0) problem += "; the run with kills failed: " + run.words();
  if (num_killed != num_kills) problem += "; only " + std::to_string(num_killed) + " kills";
  if (!(disturbed.end_effector_m >= 0) || !(undisturbed.end_effector_m > 0) ||
      disturbed.end_effector_m > kMaxRatio * undisturbed.end_effector_m) {
    problem += "; the held-out error is more than 20 % larger";
  }
  if (!problem.empty()) {
    std::fprintf(stderr, "kills: %s\nlogs are in %s\n", problem.c_str(), folder.c_str());
    return 1;
  }
  if (keep.empty()) fs::remove_all(folder);
  return 0;
}
