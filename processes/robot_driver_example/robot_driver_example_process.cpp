#include "processes/robot_driver_example/robot_driver_example_process.h"

#include <spdlog/spdlog.h>

#include <chrono>
#include <optional>
#include <stdexcept>
#include <thread>

#include "common/bus/event_log.h"

namespace bodyschema {
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

void RobotDriverProcess::Options::add_to(Arguments app) {
  app.add_option("--record", record, "Keeps the newest status over a restart").required();
}

RobotDriverProcess::RobotDriverProcess(Process& process, const Options& options)
    : process_(process),
      config_(RobotDriverConfig::load(process.config_file())),
      record_(options.record),
      port_(config_.device),
      driver_(
          config_, load_record(record_),
          [this](const motion_status_t& status) { return save(status); }, now()) {
  process.bus().subscribe(kActionCommand,
                          [this](const action_command_t& command) { on_command(command); });
  process.on_tick([this](std::int64_t) { on_tick(); });
  process.on_idle([this] { serve_port(); });
  process.on_end([this] { on_end(); });
}

void RobotDriverProcess::act(RobotDriver::Answer answer) {
  for (const std::string& line : answer.lines) port_.write_line(line);
  driver_.save(answer);
  for (const motion_status_t& status : answer.statuses) {
    process_.bus().publish(kMotionStatus, status);
  }
}

void RobotDriverProcess::serve_port() {
  while (const auto line = port_.read_line()) act(driver_.on_line(*line, now()));
  if (port_.is_open()) return;
  if (port_.problem() != last_problem_) spdlog::warn("{}; I keep trying", port_.problem());
  last_problem_ = port_.problem();
  act(driver_.on_disconnect(port_.problem(), now()));
}

void RobotDriverProcess::on_command(const action_command_t& command) {
  serve_port();  // so that the command meets the arm as it is
  act(driver_.on_command(command, now()));
}

void RobotDriverProcess::on_tick() {
  if (!port_.is_open() && port_.open()) {
    spdlog::info("{} is open", config_.device);
    last_problem_.clear();
    act(driver_.on_connect(now()));
  }
  serve_port();
  act(driver_.on_tick(now()));
  process_.set_activity(
      driver_.is_lost() ? process_info_t::PHASE_WAITING : process_info_t::PHASE_WORKING,
      driver_.is_lost()      ? "waits for the robot: " + port_.problem()
      : driver_.is_at_rest() ? "at rest"
                             : "moves");
}

void RobotDriverProcess::on_end() {
  act(driver_.on_end(now()));
  // A second is enough for an arm that was told to halt; after that it is up to its brakes.
  for (int i = 0; i < 100 && port_.is_open() && !driver_.is_at_rest(); ++i) {
    std::this_thread::sleep_for(std::chrono::milliseconds(10));
    act(driver_.on_tick(now()));
    serve_port();
  }
}

std::string RobotDriverProcess::save(const motion_status_t& status) {
  try {
    write_one_event_log(record_, kMotionStatus, status);
    return "";
  } catch (const std::runtime_error& error) {
    process_.count("record not saved");
    return error.what();
  }
}

}  // namespace bodyschema
