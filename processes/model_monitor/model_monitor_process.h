#pragma once

#include <cstdint>
#include <deque>
#include <filesystem>
#include <string>

#include "common/bus/awaited_answer.h"
#include "common/bus/rig_door.h"
#include "common/bus/sample_intake.h"
#include "common/bus/sample_trail.h"
#include "common/bus/saved_message.h"
#include "processes/model_monitor/model_monitor.h"
#include "processes/model_monitor/monitor_memory.h"

namespace bodyschema {

/// The monitor on a bus. Schema and memory are saved before they are published, on every change and
/// at 1 Hz. The samples of a recording are there all at once: each TEST sample waits for the
/// learner's proposal, or what was judged ahead of it would be judged again.
class ModelMonitorProcess {
 public:
  struct Options : SampleIntake::Options {
    std::filesystem::path schema_file, initial_file, refiner_file;
    void add_to(Arguments app);
  };
  ModelMonitorProcess(Process& process, const Options& options);
  ModelMonitorProcess(const ModelMonitorProcess&) = delete;

 private:
  /// Restores monitor_. Returns the trail of the samples that it rests on.
  SampleTrail restore(const Options& options);
  void on_learned_schema(const body_schema_t& proposal);
  void on_refined_schema(const body_schema_t& refined);
  void on_tick(std::int64_t now_us);
  /// Judges waiting samples.
  void go_on();
  void follow(const sample_t& sample);
  void publish_news();
  void publish();
  void say();

  Process& process_;
  const RigDoor door_;
  const std::filesystem::path schema_file_, history_file_;
  ModelMonitor monitor_;
  SavedMessage<body_schema_t> saved_schema_;
  MemoryFile saved_memory_;
  SampleTrail trail_;
  AwaitedAnswer proposals_;
  std::deque<sample_t> waiting_;
  bool is_news_ = false;
  std::string problem_;  ///< why schema or memory are not saved; ""
  std::int64_t sent_us_ = 0;
  SampleIntake intake_;
};

}  // namespace bodyschema
