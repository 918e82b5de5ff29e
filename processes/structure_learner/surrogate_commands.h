#pragma once

#include <vector>

#include "common/estimation/measurement_model.h"
#include "common/schema/sample.h"
#include "processes/structure_learner/search/model_forest.h"

namespace bodyschema {

/// Commands that cannot have moved anything: those of a stream, shifted in time around its ends
/// (surrogate data, Theiler et al., Physica D 58, 1992). What is slow in the commands and what is
/// slow in the poses agree by chance; how well shows here.
class SurrogateCommands {
 public:
  /// Of a stream (TimeBlocks), else there are none. Keeps a reference to `samples`.
  SurrogateCommands(const std::vector<ActionPoseSample>& samples, int num_signals,
                    const MeasurementModel& measurement);

  /// False if screws as many, fitted to the commands of other times, mostly leave hardly more of
  /// the motion than the model does. What is new in every frame is noise and does not count. True
  /// of rigid and of soft models, and of what is no stream.
  bool are_worse(const AcceptedModel& accepted) const;

 private:
  const std::vector<ActionPoseSample>& samples_;
  const MeasurementModel measurement_;
  const NormalizedActions actions_;
  std::vector<NormalizedActions> shifted_;
};

}  // namespace bodyschema
