#pragma once

#include <cstdint>
#include <filesystem>
#include <optional>
#include <string>

#include "common/bus/rig_door.h"
#include "common/bus/sample_intake.h"
#include "common/bus/state_file.h"
#include "processes/motor_babbler/motor_babbler.h"

namespace bodyschema {

/// The babbler on a bus. A command is sent once the state that knows of it is saved.
class MotorBabblerProcess {
 public:
  struct Options {
    std::int64_t seed = 1;
    std::int64_t num_samples = 0;  ///< 0: the configuration's stopping rule
    std::string samples_file;
    std::filesystem::path state_file;
    void add_to(Arguments app);
  };
  MotorBabblerProcess(Process& process, const Options& options);
  MotorBabblerProcess(const MotorBabblerProcess&) = delete;

 private:
  void subscribe();
  void remember(const sample_t& sample);
  void on_tick(std::int64_t now_us);
  void on_idle();
  void send(const std::optional<action_command_t>& command);

  Process& process_;
  const MotorBabblerConfig config_;
  const RigDoor door_;
  MotorBabbler babbler_;
  StateFile state_;
  SampleIntake intake_;
  std::int64_t num_late_schemas_ = 0;  ///< as they were warned of
};

}  // namespace bodyschema
