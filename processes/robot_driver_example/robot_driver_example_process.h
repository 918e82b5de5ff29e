#pragma once

#include <filesystem>
#include <string>

#include "common/bus/process.h"
#include "processes/robot_driver_example/robot_driver_example.h"
#include "processes/robot_driver_example/serial_line.h"

namespace bodyschema {

/// The driver on a bus and a serial port, which is opened again whenever it is lost. At the end the
/// arm is halted, and waited for during a second.
class RobotDriverProcess {
 public:
  struct Options {
    std::filesystem::path record;
    void add_to(Arguments app);
  };
  RobotDriverProcess(Process& process, const Options& options);
  RobotDriverProcess(const RobotDriverProcess&) = delete;

 private:
  void act(RobotDriver::Answer answer);
  void serve_port();
  void on_command(const action_command_t& command);
  void on_tick();
  void on_end();
  std::string save(const motion_status_t& status);

  Process& process_;
  const RobotDriverConfig config_;
  const std::filesystem::path record_;
  SerialLine port_;
  RobotDriver driver_;
  std::string last_problem_;  ///< of the port, as it was warned of
};

}  // namespace bodyschema
