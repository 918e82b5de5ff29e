#pragma once

#include <cstdint>
#include <vector>

#include "common/estimation/measurement_model.h"
#include "common/schema/body_schema.h"
#include "common/schema/sample.h"
#include "processes/structure_learner/command_track.h"
#include "processes/structure_learner/search/model_forest.h"

namespace bodyschema {

struct CommandLag {
  std::int64_t us = 0;
  bool is_significant = false;  ///< much more is explained than without it
};

/// At the lag the motions of the parts relative to each other over some frames are explained best
/// by those of the commands (linear regression), whatever the bodies are. 0 where that is below a
/// quarter of the frames' interval or explains nothing more, and of poses at rest.
CommandLag command_lag(const std::vector<ActionPoseSample>& samples, int num_signals);

/// Whether the commands of a while before are mixtures of those of now, whatever the while: as of
/// sines of one frequency in several phases. Then nothing tells a delay from joints that several
/// signals move.
bool is_one_rhythm(const std::vector<ActionPoseSample>& samples, int num_signals);
/// Why a part hangs on nothing then.
inline constexpr const char* kOneRhythm =
    "all signals follow one rhythm, in which poses that come late look like joints that several "
    "signals move: move each signal in a rhythm of its own, or hold the arm still at each pose";

/// Near `delay`, at which the models over `actions` were found, the one by which they, fitted
/// again, leave least; `delay` where that is hardly less, and of soft models, whose motion has more
/// of a past than a delay.
CommandDelay refined_delay(const std::vector<ActionPoseSample>& samples,
                           const std::vector<Signal>& signals, const NormalizedActions& actions,
                           const std::vector<AcceptedModel>& models,
                           const MeasurementModel& measurement, const CommandDelay& delay);

/// Of a recording that is held against a schema as it is: by which it leaves least; none where that
/// is hardly less than without.
CommandDelay command_delay(const std::vector<ActionPoseSample>& samples, const BodySchema& schema);

}  // namespace bodyschema
