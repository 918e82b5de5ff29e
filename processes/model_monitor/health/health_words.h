#pragma once

#include <string>
#include <vector>

#include "processes/model_monitor/health/findings.h"

namespace bodyschema {

/// For people: "q3 (4→5) stuck at −0.21 ± 0.01 since sample 290: adopted after 2 samples, by 31
/// nats". Found, adopted, confirmed, undone, back to normal: nothing else happens to a change.
std::string text_of(const AdaptationEvent& event, const std::vector<Signal>& signals);
/// "q3 (4→5) stuck at −0.21 ± 0.01 since sample 290, in the schema since 291, confirmed by 40
/// samples".
std::string text_of(const Finding& finding, const std::vector<Signal>& signals);

}  // namespace bodyschema
