#pragma once

#include <cstdint>
#include <future>
#include <string>

#include "common/bus/awaited_answer.h"
#include "common/bus/rig_door.h"
#include "common/bus/sample_intake.h"
#include "processes/structure_learner/structure_learner.h"

namespace bodyschema {

/// The learner on a bus. Live, it fits and prepares beside the loop, and repeats the newest
/// proposal at 1 Hz. A replay does not wait: a prefix that the monitor will judge is learned at
/// once, the rest at the end, so that it always writes the same messages.
class StructureLearnerProcess {
 public:
  using Options = SampleIntake::Options;
  StructureLearnerProcess(Process& process, const Options& options);
  StructureLearnerProcess(const StructureLearnerProcess&) = delete;

 private:
  void learn_from(const sample_t& sample);
  void on_model_health(const model_health_t& health);
  void on_tick(std::int64_t now_us);
  void on_end();
  void work();
  void start_fit();
  void start_preparation();
  void collect();
  void learn_now();
  void publish();

  Process& process_;
  const RigDoor door_;
  StructureLearner learner_;
  SampleIntake intake_;
  const std::int64_t resumed_after_;  ///< newest sample of the file
  /// Where no babbler waits for the monitor's verdict on every TEST sample the learner does, or it
  /// would learn from a body that the monitor knows to have changed.
  AwaitedAnswer verdicts_;
  std::future<body_schema_t> fit_;
  std::future<void> preparation_;
  body_schema_t learned_;
  bool has_learned_ = false;
  std::int64_t sent_us_ = 0;
};

}  // namespace bodyschema
