#pragma once

#include <cstdint>
#include <filesystem>
#include <future>
#include <optional>
#include <string>

#include "common/bus/rig_door.h"
#include "common/bus/sample_intake.h"
#include "common/bus/saved_message.h"
#include "processes/refiner/refiner.h"

namespace bodyschema {

/// The refiner on a bus: SAMPLE, LEARNED_SCHEMA → REFINED_SCHEMA. Live, it refines beside the loop
/// and repeats its newest answer at 1 Hz; a replay waits for each. What predicts the held-out
/// corners better than the rig's files is kept in files: the schema, and beside it the tags and the
/// lens as found, which `bodyschema adopt` writes into the rig. The refined schema goes with these
/// alone: its calibration is not the rig's until then.
class RefinerProcess {
 public:
  struct Options : SampleIntake::Options {
    std::filesystem::path schema_file, proposed_folder;
    void add_to(Arguments app);
  };
  RefinerProcess(Process& process, const Options& options);
  RefinerProcess(const RefinerProcess&) = delete;

 private:
  void restore(const std::filesystem::path& samples_file);
  void on_tick(std::int64_t now_us);
  void on_end();
  void work();
  void refine_now();
  void collect();
  void save();
  void say(const RefinedProposal& proposal);

  Process& process_;
  const RigDoor door_;
  const std::filesystem::path proposed_folder_;
  SavedMessage<body_schema_t> saved_;
  Refiner refiner_;
  SampleIntake intake_;
  std::future<RefinedProposal> fit_;
  std::optional<body_schema_t> answer_;    ///< the newest
  std::optional<body_schema_t> refined_;   ///< the newest that is better
  std::optional<RigCalibration> unsaved_;  ///< goes with refined_
  std::string words_;                      ///< of the newest refinement
  std::int64_t sent_us_ = 0;
};

}  // namespace bodyschema
