#include "processes/driver_test/driver_test.h"

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <chrono>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>
#include <optional>
#include <utility>

#include "common/bus/bus.h"
#include "common/config/rig.h"
#include "common/text/clock.h"
#include "processes/driver_test/conformance.h"

namespace bodyschema {
namespace {

using SteadyClock = std::chrono::steady_clock;

/// Linux cuts the name of a process.
constexpr std::size_t kLongestComm = 15;

struct DriverTestArguments {
  std::string in = default_url();
  std::string rig_folder;
  double step_share = 0.05;
  bool yes = false;
  bool json = false;
  std::string restart;
  std::string kill;
};

std::string host_name() {
  std::array<char, 256> name{};
  return ::gethostname(name.data(), name.size() - 1) == 0 ? name.data() : "";
}

std::string list_of(const std::vector<double>& action) {
  return fmt::format("[{:.4g}]", fmt::join(action, ", "));
}

std::string outcome_text(RuleResult::Outcome outcome) {
  return outcome == RuleResult::Outcome::kOk       ? "ok"
         : outcome == RuleResult::Outcome::kFailed ? "FAILED"
                                                   : "skipped";
}

/// The driver on a live bus.
class LiveDriver {
 public:
  explicit LiveDriver(const DriverTestArguments& arguments)
      : arguments_(arguments), bus_(arguments.in, arguments.in) {
    if (bus_.is_replay()) throw std::runtime_error("a log has no driver: --in wants a bus");
    bus_.subscribe<motion_status_t>(kMotionStatus,
                                    [this](const motion_status_t& m) { statuses_.push_back(m); });
    bus_.subscribe<process_info_t>(kProcessInfo, [this](const process_info_t& m) {
      if (m.process_name == arguments_.kill) process_ = m;
    });
  }

  DriverLink link() {
    DriverLink link;
    link.send = [this](const action_command_t& m) { bus_.publish(kActionCommand, m); };
    link.receive = [this](double seconds) { return receive(seconds); };
    link.now_s = [] {
      return std::chrono::duration<double>(SteadyClock::now().time_since_epoch()).count();
    };
    if (!arguments_.restart.empty()) link.restart = [this] { restart_by_command(); };
    if (!arguments_.kill.empty()) link.restart = [this] { restart_by_kill(); };
    return link;
  }

  /// Finds the process that --kill would end. @throws std::runtime_error if that is not the driver:
  /// one in a container tells a number that is another program's here, and numbers are used again.
  void find_process() {
    const auto end = SteadyClock::now() + std::chrono::seconds(5);
    while (!process_ && SteadyClock::now() < end) bus_.handle(std::chrono::milliseconds(100));
    if (!process_) {
      throw std::runtime_error("--kill: no PROCESS_INFO of " + arguments_.kill + " within 5 s");
    }
    if (process_->host != host_name()) {
      throw std::runtime_error("--kill: " + arguments_.kill + " runs on " + process_->host +
                               "; use --restart COMMAND, or test there");
    }
    std::string name;
    std::ifstream file(fmt::format("/proc/{}/comm", process_->pid));
    std::getline(file, name);
    if (process_->pid > 1 && name == arguments_.kill.substr(0, kLongestComm)) return;
    throw std::runtime_error(
        fmt::format("--kill: process {} is {} here, not {}; use --restart COMMAND", process_->pid,
                    name.empty() ? "nothing" : "'" + name + "'", arguments_.kill));
  }

 private:
  std::vector<motion_status_t> receive(double seconds) {
    bus_.handle(
        std::chrono::milliseconds(static_cast<int>(std::clamp(seconds, 0.001, 60.0) * 1e3)));
    return std::exchange(statuses_, {});
  }

  void restart_by_command() {
    const int status = std::system(arguments_.restart.c_str());
    if (status == -1 || !WIFEXITED(status) || WEXITSTATUS(status) != 0) {
      throw std::runtime_error("--restart: '" + arguments_.restart + "' failed");
    }
    drain();
  }

  void restart_by_kill() {
    find_process();
    if (::kill(process_->pid, SIGKILL) != 0) {
      throw std::runtime_error(fmt::format("--kill: process {} of {}: {}", process_->pid,
                                           arguments_.kill, std::strerror(errno)));
    }
    drain();
  }

  /// Drops the messages that the driver had sent before it ended.
  void drain() {
    const auto end = SteadyClock::now() + std::chrono::milliseconds(50);
    while (SteadyClock::now() < end) bus_.handle(std::chrono::milliseconds(5));
    statuses_.clear();
    process_.reset();
  }

  const DriverTestArguments& arguments_;
  Bus bus_;
  std::vector<motion_status_t> statuses_;
  std::optional<process_info_t> process_;
};

void confirm(const DriverTestArguments& arguments, const ConformanceOptions& options,
             const ConformancePlan& plan) {
  std::cerr << fmt::format(
      "The test moves the arm on {} about 25 times between\n  {}\nand\n  {}\n(command units; "
      "{}).\n",
      arguments.in, list_of(plan.here), list_of(plan.there),
      plan.is_from_middle
          ? "the driver does not say where the arm is, so the FIRST MOTION GOES TO THE MIDDLE of "
            "all ranges"
          : fmt::format("{:g} % of each range", 100 * options.step_share));
  if (arguments.yes) return;
  std::cerr << "Is the arm clear, and is nothing else commanding it? Type yes: " << std::flush;
  std::string answer;
  if (!std::getline(std::cin, answer) || answer != "yes") {
    std::cerr << "not confirmed; --yes does without the question\n";
    std::exit(2);
  }
}

void run_driver_test(const DriverTestArguments& arguments) {
  ConformanceOptions options;
  options.signals = load_signals(arguments.rig_folder);
  options.step_share = arguments.step_share;
  options.epoch = wall_clock_us();
  LiveDriver driver(arguments);
  if (!arguments.kill.empty()) driver.find_process();  // before the arm moves
  const DriverLink link = driver.link();
  const ConformancePlan plan = plan_conformance(link, options);
  confirm(arguments, options, plan);
  const std::vector<RuleResult> results = test_conformance(
      link, options, plan, [](const std::string& line) { std::cerr << line << " …\n"; });

  int failed = 0, skipped = 0;
  nlohmann::ordered_json json = nlohmann::ordered_json::array();
  for (const RuleResult& result : results) {
    failed += result.outcome == RuleResult::Outcome::kFailed;
    skipped += result.outcome == RuleResult::Outcome::kSkipped;
    if (arguments.json) {
      json.push_back({{"rule", result.rule},
                      {"name", result.name},
                      {"outcome", outcome_text(result.outcome)},
                      {"note", result.note}});
    } else {
      std::cout << fmt::format("{:2}  {}: {}{}\n", result.rule, result.name,
                               outcome_text(result.outcome),
                               result.note.empty() ? "" : ": " + result.note);
    }
  }
  if (arguments.json) {
    std::cout << json.dump(2) << "\n";
  } else {
    std::cout << fmt::format("{} rules: {} ok, {} failed, {} skipped (lcmtypes/DRIVER.md)\n",
                             results.size(), results.size() - failed - skipped, failed, skipped);
  }
  std::cout.flush();
  if (failed > 0) end_as_failed();
}

}  // namespace

void add_driver_test_command(Arguments console) {
  const auto arguments = std::make_shared<DriverTestArguments>();
  Arguments test = console.add_subcommand(
      "driver-test", "Does the driver on the bus keep lcmtypes/DRIVER.md? Moves the arm gently");
  test.add_option("--in", arguments->in, "URL of the bus").capture_default_str();
  test.add_option("--rig-folder", arguments->rig_folder, "The rig's configuration").required();
  test.add_option("--step-share", arguments->step_share,
                  "Size of the motions, share of each range; a motion should last half a second")
      .in_range(0.001, 0.4)
      .capture_default_str();
  test.add_flag("--yes", arguments->yes, "Do not ask before moving");
  test.add_flag("--json", arguments->json, "The result as JSON");
  const Argument restart = test.add_option(
      "--restart", arguments->restart, "Shell command that ends the driver and starts it again");
  test.add_option("--kill", arguments->kill,
                  "Process name of the driver: kill -9; its supervisor starts it again")
      .excludes(restart);
  test.callback([arguments] { run_driver_test(*arguments); });
}

}  // namespace bodyschema
