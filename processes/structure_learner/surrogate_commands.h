#pragma once

#include <vector>

#include "common/estimation/measurement_model.h"
#include "common/estimation/time_blocks.h"
#include "common/schema/sample.h"
#include "processes/structure_learner/search/model_forest.h"

namespace bodyschema {

/// Commands that cannot have moved anything (surrogate data: Theiler et al., Physica D 58, 1992):
/// those of a stream circularly shifted in time, since what is slow in commands and what is slow in
/// poses agree by chance; those of poses at rest in another order.
class SurrogateCommands {
 public:
  /// Of motion that repeats itself whatever the shift there are none. Keeps a reference to
  /// `samples`.
  SurrogateCommands(const std::vector<ActionPoseSample>& samples, int num_signals,
                    const MeasurementModel& measurement);

  /// Screws as many, fitted to such commands, leave hardly more of the motion than the model does:
  /// of a stream mostly, where what is new in every frame is noise and does not count; of poses at
  /// rest sometimes. (Chains of three joints and more are refined from the model alone, which
  /// leaves too much: that is lenient.) False of a stream where too few frames follow each other
  /// to tell, and of rigid and of soft models.
  bool explain_as_well(const AcceptedModel& accepted) const;
  bool is_stream() const { return blocks_.is_stream(); }
  /// The stream is too short for TimeBlocks: a frame's neighbours tell its pose, so that a Gaussian
  /// process cannot be judged.
  bool is_short() const { return is_stream() && !actions_.blocks().is_stream(); }

 private:
  void shift();
  void shuffle();

  const std::vector<ActionPoseSample>& samples_;
  const MeasurementModel measurement_;
  const NormalizedActions actions_;
  const TimeBlocks blocks_;
  std::vector<NormalizedActions> others_;
};

}  // namespace bodyschema
