#pragma once

#include <filesystem>
#include <map>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "bodyschema/sample_t.hpp"
#include "common/geometry/pose.h"
#include "common/schema/body_schema.h"
#include "common/schema/sample.h"
#include "processes/model_monitor/model_monitor.h"
#include "processes/motor_babbler/motor_babbler.h"

namespace bodyschema::test {

/// A rig's whole path from action to sample in one thread without a bus: simulator, rendered
/// images, marker estimator, observer, and, if actions are chosen by their results, learner and
/// monitor, all with the rig's own configuration. The samples are those that ./run --ideal (or, if
/// not ideal, ./run) records with the same seed.
class RenderedRun {
 public:
  struct Step {
    sample_t message;
    ActionPoseSample sample;
    /// Noise-free pose X_CB of every part of the rig, seen or not, its joints in the middle of
    /// their backlash.
    std::map<int, Pose> truth;
  };

  /// `is_ideal`: without robot.yaml's calibration errors.
  RenderedRun(const std::filesystem::path& rig_folder, std::int64_t seed,
              const std::set<int>& hidden_parts = {},
              std::optional<Choice> choice = std::nullopt,  ///< else the rig's
              bool is_ideal = true);
  ~RenderedRun();

  /// The next sample. Actions that the simulator refuses are passed over.
  Step next();

  int num_rejected() const;

  /// Breaks the arm before the next action, as FAULT_COMMAND does (common/scene/faults.h).
  /// @throws std::runtime_error with the simulator's words if it refuses.
  void break_body(std::int8_t fault, const std::string& place = "", int number = -1,
                  double amount_deg = 0);
  /// The monitor that the babbler chooses by (Choice::kActive).
  const ModelMonitor& monitor() const;

 private:
  struct Implementation;
  std::unique_ptr<Implementation> implementation_;
};

}  // namespace bodyschema::test
