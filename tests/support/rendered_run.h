#pragma once

#include <filesystem>
#include <map>
#include <memory>
#include <optional>
#include <set>
#include <vector>

#include "bodyschema/sample_t.hpp"
#include "common/geometry/pose.h"
#include "common/schema/body_schema.h"
#include "common/schema/sample.h"
#include "processes/motor_babbler/motor_babbler.h"

namespace bodyschema::test {

/// A rig's whole way from action to sample in one thread without a bus: simulator, rendered images,
/// marker estimator, observer, and learner and monitor where actions are chosen by what they found,
/// all with the rig's own configuration. The samples are those that ./run records with the same seed.
class RenderedRun {
 public:
  struct Step {
    sample_t message;
    ActionPoseSample sample;
    /// Noise-free pose X_CB of every part of the rig, seen or not.
    std::map<int, Pose> truth;
  };

  RenderedRun(const std::filesystem::path& rig_folder, std::int64_t seed,
              const std::set<int>& hidden_parts = {},
              std::optional<Choice> choice = std::nullopt);  ///< else the rig's
  ~RenderedRun();

  /// The next sample. Actions that the simulator refuses are passed over.
  Step next();

  int num_rejected() const;

 private:
  struct Implementation;
  std::unique_ptr<Implementation> implementation_;
};

}  // namespace bodyschema::test
