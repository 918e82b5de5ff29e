#pragma once

#include <cstdint>
#include <filesystem>
#include <optional>

#include "common/bus/rig_door.h"
#include "processes/observer/observer.h"
#include "processes/observer/sample_outbox.h"

namespace bodyschema {

/// The observer on a bus: every sample goes through the outbox, which has it on disk before anybody
/// hears of it. A sample that is still held back at the end is an error.
class ObserverProcess {
 public:
  struct Options {
    std::filesystem::path samples_file;
    void add_to(Arguments app);
  };
  ObserverProcess(Process& process, const Options& options);
  ObserverProcess(const ObserverProcess&) = delete;

 private:
  void restore();
  void send(const std::optional<sample_t>& sample);
  void on_tick(std::int64_t now_us);
  void on_idle();
  void on_end() const;

  Process& process_;
  const RigDoor door_;
  Observer observer_;
  SampleOutbox outbox_;
};

}  // namespace bodyschema
