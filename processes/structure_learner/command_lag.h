#pragma once

#include <cstdint>
#include <vector>

#include "common/estimation/measurement_model.h"
#include "common/schema/body_schema.h"
#include "common/schema/sample.h"
#include "processes/structure_learner/search/model_forest.h"

namespace bodyschema {

/// By how much the poses of a stream come after their commands: drives, filters and exposure take
/// time, and clocks differ.
struct CommandLag {
  std::int64_t us = 0;          ///< below 0: before them
  bool is_significant = false;  ///< much more is explained than without it
};

/// At the lag the motions of the parts relative to each other over some frames are explained best
/// by those of the commands (linear regression), whatever the bodies are. 0 where that is below a
/// quarter of the frames' interval or explains nothing more, and of poses at rest.
CommandLag command_lag(const std::vector<ActionPoseSample>& samples, int num_signals);

/// Near `lag_us`, at which the models over `actions` were found, the one by which they, fitted
/// again, leave least; `lag_us` where that is hardly less.
std::int64_t refined_lag_us(const std::vector<ActionPoseSample>& samples,
                            const std::vector<Signal>& signals, const NormalizedActions& actions,
                            const std::vector<AcceptedModel>& models,
                            const MeasurementModel& measurement, std::int64_t lag_us);

/// Of a recording that is held against a schema as it is: by which it leaves least; 0 where that is
/// hardly less than without.
std::int64_t command_lag_us(const std::vector<ActionPoseSample>& samples, const BodySchema& schema);

/// Each sample with the command of `lag_us` before it, linear between two; those that have none, at
/// the ends and behind gaps, are left out.
std::vector<ActionPoseSample> with_commands_of_before(const std::vector<ActionPoseSample>& samples,
                                                      std::int64_t lag_us);

}  // namespace bodyschema
