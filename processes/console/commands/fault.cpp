#include <fmt/format.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdlib>
#include <memory>
#include <optional>
#include <stdexcept>
#include <vector>

#include "common/bus/bus.h"
#include "common/text/clock.h"
#include "processes/console/commands/commands.h"
#include "processes/console/commands/files.h"

namespace bodyschema {
namespace {

using SteadyClock = std::chrono::steady_clock;

struct FaultArguments {
  std::string in = default_url();
  bool json = false;
  std::vector<double> target_m;
  fault_command_t command{};
};

void inject(FaultArguments& arguments) {
  std::ranges::copy(arguments.target_m, arguments.command.target_m);
  fault_command_t& command = arguments.command;
  command.utime = command.epoch = wall_clock_us();
  command.sender = "console";

  Bus bus(arguments.in, arguments.in);
  if (bus.is_replay()) throw std::runtime_error("a log has no simulator: --in wants a bus");
  bool is_heard = false;
  std::optional<sim_state_t> done;
  bus.subscribe<sim_state_t>(kSimState, [&](const sim_state_t& state) {
    is_heard = true;
    if (state.fault_epoch == command.epoch && state.fault_id == command.fault_id) done = state;
  });
  // A simulator repeats its state at 1 Hz; one that is heard may have many commands to serve first.
  const auto begin = SteadyClock::now();
  auto next_send = begin;
  while (!done && SteadyClock::now() < begin + std::chrono::seconds(is_heard ? 10 : 4)) {
    if (SteadyClock::now() >= next_send) {
      bus.publish(kFaultCommand, command);
      next_send += std::chrono::milliseconds(500);
    }
    bus.handle(std::chrono::milliseconds(50));
  }
  if (!done)
    throw std::runtime_error(
        is_heard ? "the simulator is heard but did not acknowledge within 10 s; its log says why"
                 : "no simulator is heard on " + arguments.in +
                       " within 4 s; faults are for simulated rigs, in a group that runs "
                       "(./run --keep)");
  if (!done->fault_answer.empty()) throw std::runtime_error("refused: " + done->fault_answer);
  const bool is_repair = command.fault == fault_command_t::FAULT_REPAIR;
  print(arguments.json, {{"faults", done->faults}, {"utime", done->utime}},
        !done->faults.empty() ? fmt::format("{}\n", fmt::join(done->faults, "\n"))
        : is_repair           ? "repaired: as built\n"
                              : "nothing is broken\n");
}

}  // namespace

// Long, but a list: one subcommand a fault.
void add_fault_command(Arguments console) {
  const auto arguments = std::make_shared<FaultArguments>();
  Arguments fault =
      console.add_subcommand("fault", "Break the simulated arm, or repair it; the simulator alone");
  fault.add_option("--in", arguments->in, "URL of the bus").capture_default_str();
  fault.add_flag("--json", arguments->json, "The result as JSON");
  fault.require_subcommand(1);
  const auto add = [&](const char* name, const char* help, std::int8_t kind) {
    Arguments sub = fault.add_subcommand(name, help);
    sub.fallthrough();  // options of `fault` may come last
    sub.callback([arguments, kind] {
      arguments->command.fault = kind;
      inject(*arguments);
    });
    return sub;
  };
  using Command = fault_command_t;
  Command& command = arguments->command;
  command.number = -1;
  const auto add_place = [&](Arguments sub, const char* name, const char* help) {
    sub.add_option(name, command.place, help).required();
    return sub;
  };
  const auto add_number = [&](Arguments sub, const char* name, const char* help) {
    sub.add_option(name, command.number, help).required().in_range(0, 9999);
  };
  const auto add_angle = [&](Arguments sub, const char* name, const char* help) {
    sub.add_option(name, command.amount_deg, help)
        .required()
        .in_range(-90.0, 90.0)
        .check([](const std::string& text) {
          return std::isnan(std::strtod(text.c_str(), nullptr)) ? "expected a number" : "";
        });
  };
  add_place(add("stuck", "The joints of a signal no longer move", Command::FAULT_STUCK), "SIGNAL",
            "Name in signals.yaml");
  add_angle(add_place(add("bend", "A link is bent in its middle", Command::FAULT_BEND), "LINK",
                      "Name in robot.yaml"),
            "DEG", "Angle [deg]");
  add_number(add("tool", "Another tool", Command::FAULT_TOOL), "N",
             "Of robot.yaml's tools; 0 is the first");
  add_number(add("marker-lost", "A marker falls off", Command::FAULT_MARKER_LOST), "ID",
             "Tag in markers.yaml");
  add_number(
      add("marker-moved", "A marker sits elsewhere on its part", Command::FAULT_MARKER_MOVED), "ID",
      "Tag in markers.yaml");
  add("camera-bump", "The camera is knocked to another pose", Command::FAULT_CAMERA_BUMP);
  add_angle(
      add_place(add("drift", "A link bends more with each action; 0 ends it", Command::FAULT_DRIFT),
                "LINK", "Name in robot.yaml"),
      "DEG_PER_SAMPLE", "Angle an action [deg]");
  Arguments target =
      add("target", "No fault: a target tag is put elsewhere", Command::FAULT_TARGET);
  add_number(target, "ID", "Of target_tags in robot.yaml");
  target
      .add_option("POSITION", arguments->target_m,
                  "X Y Z of its centre in the camera's frame as built [m]")
      .required()
      .expected(3)
      .in_range(-1000.0, 1000.0);
  add("repair", "As built", Command::FAULT_REPAIR);
}

}  // namespace bodyschema
