// soak: cost of many samples. Sends synthetic samples of a robot to the processes that keep
// data of every sample (structure_learner, model_monitor, `bodyschema watch`, `bodyschema
// report --follow`), in step with the monitor's verdicts as a babbler is, and prints, over the run,
// the memory that each holds, and the bytes that it read and its processor time per sample. Fails
// if one of them grows, or if all together hold more than 1 GB. (The learner's time is not judged:
// it searches as long as nothing new comes.)
//
// soak [--samples N] [--robot d] [--keep FOLDER]; on a bus of its own (tests/private_bus.sh).

#include <unistd.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <chrono>
#include <csignal>
#include <cstdio>
#include <deque>
#include <fstream>
#include <limits>
#include <map>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "tests/common/bus/bus_test_support.h"
#include "tests/support/synthetic_robot.h"

using namespace bodyschema;

namespace {

namespace fs = std::filesystem;

// The retained set is full after 2000 samples; from then on a run's memory stays, except for half a
// set more whenever the samples double.
constexpr std::int64_t kFull = 2000;
// A search briefly needs several times the memory that is kept: the least over this many samples
// counts.
constexpr std::int64_t kMoment = 100;
// Allowed growth from there on: 1000 samples of five parts (4 kB) per doubling, an index of the
// samples (SampleIntake, 64 B each), and malloc's fragmentation.
constexpr double kMaxGrowthMb = 12, kMaxGrowthMbADoubling = 8;
constexpr double kMaxSumMb = 1000;

struct Usage {
  double memory_mb = 0;
  double read_kb = 0, processor_ms = 0;  // since the start
};

Usage usage_of(pid_t pid) {
  const auto number_after = [&](const std::string& file, const std::string& word) {
    std::ifstream stream("/proc/" + std::to_string(pid) + "/" + file);
    double number = 0;
    for (std::string w; stream >> w;)
      if (w == word && stream >> number) return number;
    throw std::runtime_error("process " + std::to_string(pid) + " is gone");
  };
  // Two numbers after 11 others that follow the name in parentheses (proc(5): utime, stime).
  std::ifstream stat("/proc/" + std::to_string(pid) + "/stat");
  stat.ignore(std::numeric_limits<std::streamsize>::max(), ')');
  std::string skipped;
  for (int n = 0; n < 11; ++n) stat >> skipped;
  double user = 0, system = 0;
  stat >> user >> system;
  return {number_after("status", "VmRSS:") / 1024, number_after("io", "rchar:") / 1024,
          (user + system) * 1e3 / static_cast<double>(::sysconf(_SC_CLK_TCK))};
}

class Soak {
 public:
  Soak(const fs::path& folder, const std::string& robot) : folder_(folder), rng_(41) {
    robot_ = test::chapter_robot(robot, rng_);
    fs::create_directories(folder_ / "config");
    const std::string rig = robot == "a" ? "/arm2" : "/arm7";
    for (const auto& file : fs::directory_iterator(BODYSCHEMA_CONFIG + rig))
      fs::copy(file, folder_ / "config", fs::copy_options::overwrite_existing);
    std::ofstream signals(folder_ / "config" / "signals.yaml");
    signals.precision(17);
    signals << "signals:\n";
    for (const Signal& signal : robot_.signals)
      signals << "  - {name: " << signal.name << ", lower: " << signal.lower
              << ", upper: " << signal.upper << "}\n";
    signals << "root_part: 1\nend_effector_part: " << robot_.visible_parts().back() << "\n";
    signals.close();

    samples_ = std::make_unique<LogAppender>(samples_file(), LogAppender::Mode::kOverwrite,
                                             LogAppender::Durability::kToKernel);
    log_ = std::make_unique<LogAppender>(folder_ / "run.lcmlog.00", LogAppender::Mode::kOverwrite,
                                         LogAppender::Durability::kToKernel);
    bus_.subscribe(kLearnedSchema, [this](const body_schema_t& m) { log(kLearnedSchema, m); });
    bus_.subscribe(kBodySchema, [this](const body_schema_t& m) { log(kBodySchema, m); });
    bus_.subscribe(kProcessInfo, [this](const process_info_t& m) {
      log(kProcessInfo, m);
      if (m.phase != process_info_t::PHASE_STARTING) heard_[m.process_name] = true;
    });
    bus_.subscribe(kModelHealth, [this](const model_health_t& m) {
      log(kModelHealth, m);
      judged_ = m.judged_sample;
      is_complete_ = m.schema_complete == 1;
    });

    const std::string bin = BODYSCHEMA_BIN "/", config = folder_ / "config/";
    start("structure_learner", {bin + "structure_learner", "--config",
                                config + "structure_learner.yaml", "--samples", samples_file()});
    start("model_monitor", {bin + "model_monitor", "--config", config + "model_monitor.yaml",
                            "--schema", folder_ / "schema.lcmlog", "--samples", samples_file()});
    start("watch", {bin + "bodyschema", "watch", "--rig-folder", config, "--rig", "soak", "--out",
                    folder_, "--patience-s", "1000000"});
    start("report", {bin + "bodyschema", "report", folder_, "--follow"});
    wait_for([&] { return heard_["structure_learner"] && heard_["model_monitor"]; },
             "the processes");
  }

  /// One action of the babbler and all that follows from it.
  void step(std::int64_t index) {
    const Eigen::VectorXd action = robot_.random_action(rng_);
    ActionPoseSample sample = test::observe(
        robot_, action,
        {.regime = test::Regime::kTag, .with_covariances = true, .with_other_hypothesis = true},
        index, rng_);
    sample.utime = 1'000'000 * (index + 1);
    sample.purpose = index % 5 == 4 ? Purpose::kTest : Purpose::kTrain;
    sim_state_t state{};
    state.utime = sample.utime - 500'000;
    state.action_id = index;
    state.X_WC = to_message(Pose::Identity());
    std::vector<std::int32_t> parts;
    std::vector<pose_t> poses;
    for (const auto& [part, X_CB] : robot_.poses_in_camera(action)) {
      parts.push_back(part);
      poses.push_back(to_message(X_CB));
    }
    state.num_parts = static_cast<std::int32_t>(parts.size());
    state.true_part = std::move(parts);
    state.X_WB = std::move(poses);
    bus_.publish(kSimState, state);
    log(kSimState, state);
    sample_t message = to_message(sample);
    message.action_id = index;
    samples_->append(kSample, message);
    bus_.publish(kSample, message);
    log(kSample, message);
    bus_.handle(std::chrono::milliseconds(0));
    if (sample.purpose == Purpose::kTest)
      wait_for([&] { return judged_ >= index; }, "the verdict on " + std::to_string(index));
  }

  std::map<std::string, Usage> usage() const {
    std::map<std::string, Usage> result;
    for (const auto& [name, program] : programs_) result[name] = usage_of(program->pid());
    return result;
  }
  bool is_complete() const { return is_complete_; }

  /// The report is written once more and the watch sums up, both over all samples.
  void end() {
    programs_.at("report")->send_signal(SIGTERM);
    programs_.at("watch")->send_signal(SIGTERM);
    programs_.at("report")->wait();
    programs_.at("watch")->wait();
  }

 private:
  fs::path samples_file() const { return folder_ / "samples.lcmlog"; }
  void start(const std::string& name, const std::vector<std::string>& arguments) {
    programs_[name] = std::make_unique<test::Program>(arguments);
  }
  template <class Message>
  void log(const Channel<Message>& channel, const Message& message) {
    // As a logger's: by the time of receipt.
    log_->append_bytes(channel.name, encode(channel, message), ++received_us_);
  }
  template <class IsDone>
  void wait_for(IsDone is_done, const std::string& what) {
    const auto end = std::chrono::steady_clock::now() + std::chrono::minutes(2);
    while (!is_done()) {
      if (std::chrono::steady_clock::now() > end)
        throw std::runtime_error("waited two minutes for " + what);
      bus_.handle(std::chrono::milliseconds(20));
    }
  }

  const fs::path folder_;
  test::Rng rng_;
  test::SyntheticRobot robot_;
  Bus bus_{default_url(), default_url()};
  std::unique_ptr<LogAppender> samples_, log_;
  std::map<std::string, std::unique_ptr<test::Program>> programs_;
  std::map<std::string, bool> heard_;
  std::int64_t judged_ = -1;
  std::int64_t received_us_ = 1'700'000'000'000'000;
  bool is_complete_ = false;
};

using UsageOf = std::map<std::string, Usage>;        // by program
using UsageAfter = std::map<std::int64_t, UsageOf>;  // by the number of samples

/// Since `before`, after so many samples.
void print_row(std::int64_t n, const UsageOf& now, std::int64_t printed, const UsageOf& before) {
  double sum = 0;
  std::printf("| %lld |", static_cast<long long>(n));
  for (const auto& [name, u] : now) {
    const Usage& then = before.at(name);
    const auto num_new = static_cast<double>(n - printed);
    std::printf(" %.0f | %.1f | %.2f |", u.memory_mb, (u.read_kb - then.read_kb) / num_new,
                (u.processor_ms - then.processor_ms) / num_new);
    sum += u.memory_mb;
  }
  std::printf(" %.0f |\n", sum);
  std::fflush(stdout);
}

/// Prints the table.
UsageAfter run(Soak* soak, std::int64_t num_samples) {
  UsageAfter usage;
  std::printf("| samples |");
  for (const auto& [name, u] : soak->usage())
    std::printf(" %s MB | kB read a sample | ms a sample |", name.c_str());
  std::printf(" all MB |\n| --- |");
  for (std::size_t i = 0; i < soak->usage().size(); ++i) std::printf(" --- | --- | --- |");
  std::printf(" --- |\n");
  std::map<std::string, Usage> before = soak->usage();
  std::map<std::string, std::deque<double>> recent_mb;
  std::int64_t printed = 0;
  for (std::int64_t n = 1; n <= num_samples; ++n) {
    soak->step(n - 1);
    for (const auto& [name, u] : soak->usage()) {
      std::deque<double>& memory = recent_mb[name];
      memory.push_back(u.memory_mb);
      if (std::ssize(memory) > kMoment) memory.pop_front();
    }
    if (n % std::max<std::int64_t>(500, num_samples / 20) != 0 && n != kFull / 2 && n != kFull &&
        n != num_samples)
      continue;
    usage[n] = soak->usage();
    for (auto& [name, u] : usage[n]) u.memory_mb = *std::ranges::min_element(recent_mb.at(name));
    print_row(n, usage[n], printed, before);
    before = usage[n];
    printed = n;
  }
  return usage;
}

/// What grows; "": nothing.
std::string problems_of(const UsageAfter& usage, std::int64_t num_samples) {
  std::string problems;
  const double doublings = std::log2(static_cast<double>(num_samples) / kFull);
  const auto& full = usage.at(kFull);
  double sum_mb = 0;
  for (const auto& [name, last] : usage.at(num_samples)) {
    sum_mb += last.memory_mb;
    const double growth = last.memory_mb - full.at(name).memory_mb;
    if (growth > kMaxGrowthMb + kMaxGrowthMbADoubling * doublings)
      problems += name + " grew by " + std::to_string(growth) + " MB; ";
    const Usage& half = usage.at(kFull / 2).at(name);
    const double first_kb = (full.at(name).read_kb - half.read_kb) / (kFull / 2);
    const double later_kb =
        (last.read_kb - full.at(name).read_kb) / static_cast<double>(num_samples - kFull);
    if (later_kb > 1.5 * first_kb + 1)
      problems += name + " reads " + std::to_string(later_kb) + " kB a sample after " +
                  std::to_string(first_kb) + "; ";
    const double first_ms = (full.at(name).processor_ms - half.processor_ms) / (kFull / 2);
    const double later_ms =
        (last.processor_ms - full.at(name).processor_ms) / static_cast<double>(num_samples - kFull);
    if (name != "structure_learner" && later_ms > 2 * first_ms + 1)
      problems += name + " takes " + std::to_string(later_ms) + " ms a sample after " +
                  std::to_string(first_ms) + "; ";
  }
  if (sum_mb > kMaxSumMb) problems += "all processes hold " + std::to_string(sum_mb) + " MB; ";
  return problems;
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app("Memory and work of the processes over many samples");
  std::int64_t num_samples = 100'000;
  std::string keep, robot = "a";
  app.add_option("--samples", num_samples, "So many samples")
      ->check(CLI::Range(2 * kFull, 10'000'000L));
  app.add_option("--robot", robot, "a: two joints, five parts; d: seven joints, ten parts")
      ->check(CLI::IsMember({"a", "d"}));
  app.add_option("--keep", keep, "Keep the run's folder, here");
  CLI11_PARSE(app, argc, argv);

  const test::TemporaryFolder temporary;
  try {
    Soak soak(keep.empty() ? temporary.path() : fs::path(keep), robot);
    const UsageAfter usage = run(&soak, num_samples);
    soak.end();
    std::string problems = soak.is_complete() ? "" : "the body was not learned; ";
    problems += problems_of(usage, num_samples);
    if (problems.empty()) return 0;
    std::fprintf(stderr, "soak: %s\n", problems.c_str());
  } catch (const std::exception& error) {
    std::fprintf(stderr, "soak: %s\n", error.what());
  }
  return 1;
}
