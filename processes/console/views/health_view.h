#pragma once

#include <string>
#include <vector>

#include "bodyschema/model_health_t.hpp"
#include "processes/console/views/json.h"

namespace bodyschema {

/// MODEL_HEALTH as status, report, watch and `monitor` tell it, in one way. `signals`: their names;
/// null where something is not told.
Json event_json(const health_event_t& event, const std::vector<std::string>& signals);
Json finding_json(const finding_t& finding, const std::vector<std::string>& signals);

/// nullptr where the edge was not judged.
const edge_health_t* health_of(const std::optional<model_health_t>& health, int from, int to);

inline constexpr const char* kWhatIsWrong = "What is wrong now";

/// MODEL_HEALTH in one sentence about the body as a whole.
struct BodyVerdict {
  /// "Nothing is known to be wrong with the body.", "The body is not as the schema says in 1
  /// place.", …
  std::string sentence;
  /// The lines under kWhatIsWrong; empty: nothing is known to be wrong.
  std::vector<std::string> wrong;
  bool is_in_doubt = false;      ///< nothing is, but an edge may be: the sentence says which
  bool is_schema_wrong = false;  ///< something is found that the schema does not have yet
};
BodyVerdict verdict_of(const model_health_t& health);

/// Said where a run is over or its babbler done.
inline constexpr const char* kNobodyWatches =
    "No sample comes any more: what breaks from now on is not noticed.";

}  // namespace bodyschema
