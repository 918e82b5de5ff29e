// robot_driver_example: ACTION_COMMAND -> MOTION_STATUS, for the serial robot of imaginary_robot

#include <spdlog/spdlog.h>

#include <chrono>
#include <exception>
#include <thread>

#include "common/bus/event_log.h"
#include "common/bus/process.h"
#include "processes/robot_driver_example/robot_driver_example.h"
#include "processes/robot_driver_example/serial_line.h"

using namespace bodyschema;

namespace {

template <class Clock>
std::int64_t microseconds_of() {
  return std::chrono::duration_cast<std::chrono::microseconds>(Clock::now().time_since_epoch())
      .count();
}

RobotDriver::Now now() {
  return {microseconds_of<std::chrono::steady_clock>(),
          microseconds_of<std::chrono::system_clock>()};
}

std::optional<motion_status_t> load_record(const std::filesystem::path& file) {
  if (!std::filesystem::exists(file)) return std::nullopt;
  try {
    return read_log(file, kMotionStatus).at(0);
  } catch (const std::exception& error) {
    throw std::runtime_error(std::string(error.what()) +
                             "; look whether the arm is clear, then delete the record");
  }
}

}  // namespace

int main(int argc, char** argv) {
  std::filesystem::path record;
  const auto add_options = [&](Arguments app) {
    app.add_option("--record", record, "Keeps the newest status over a restart").required();
  };
  const auto body = [&](Process& process) {
    const RobotDriverConfig config = RobotDriverConfig::load(process.config_file());
    SerialLine port(config.device);
    const auto save = [&](const motion_status_t& status) -> std::string {
      try {
        write_one_event_log(record, kMotionStatus, status);
        return "";
      } catch (const std::runtime_error& error) {
        process.count("record not saved");
        return error.what();
      }
    };
    RobotDriver driver(config, load_record(record), save, now());

    const auto act = [&](RobotDriver::Answer answer) {
      for (const std::string& line : answer.lines) port.write_line(line);
      driver.save(answer);
      for (const motion_status_t& status : answer.statuses) {
        process.bus().publish(kMotionStatus, status);
      }
    };
    std::string last_problem;
    const auto serve_port = [&] {
      while (const auto line = port.read_line()) act(driver.on_line(*line, now()));
      if (port.is_open()) return;
      if (port.problem() != last_problem) spdlog::warn("{}; I keep trying", port.problem());
      last_problem = port.problem();
      act(driver.on_disconnect(port.problem(), now()));
    };
    process.bus().subscribe<action_command_t>(kActionCommand, [&](const action_command_t& command) {
      serve_port();  // so that the command meets the arm as it is
      act(driver.on_command(command, now()));
    });
    process.on_tick([&](std::int64_t) {
      if (!port.is_open() && port.open()) {
        spdlog::info("{} is open", config.device);
        last_problem.clear();
        act(driver.on_connect(now()));
      }
      serve_port();
      act(driver.on_tick(now()));
      process.set_activity(
          driver.is_lost() ? process_info_t::PHASE_WAITING : process_info_t::PHASE_WORKING,
          driver.is_lost()      ? "waits for the robot: " + port.problem()
          : driver.is_at_rest() ? "at rest"
                                : "moves");
    });
    process.on_idle(serve_port);
    process.on_end([&] {
      act(driver.on_end(now()));
      // A second is enough for an arm that was told to halt; after that it is up to its brakes.
      for (int i = 0; i < 100 && port.is_open() && !driver.is_at_rest(); ++i) {
        std::this_thread::sleep_for(std::chrono::milliseconds(10));
        act(driver.on_tick(now()));
        serve_port();
      }
    });
    process.run();
  };
  return run_process("robot_driver_example", argc, argv, body, add_options);
}
