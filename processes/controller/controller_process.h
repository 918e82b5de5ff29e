#pragma once

#include <filesystem>

#include "common/bus/rig_door.h"
#include "common/bus/state_file.h"
#include "processes/controller/controller.h"

namespace bodyschema {

/// The controller on a bus. A MOVE is sent once the state that knows of it is saved; CONTROL_STATUS
/// and HOLD wait for no disk.
class ControllerProcess {
 public:
  struct Options {
    std::filesystem::path state_file;
    void add_to(Arguments app);
  };
  ControllerProcess(Process& process, const Options& options);
  ControllerProcess(const ControllerProcess&) = delete;

 private:
  void on_pose_target(const pose_target_t& target);
  void on_tick(std::int64_t now_us);
  void send(const Controller::Answer& answer);
  void say();

  Process& process_;
  const RigDoor door_;
  Controller controller_;
  StateFile state_;
};

}  // namespace bodyschema
