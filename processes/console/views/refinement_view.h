#pragma once

#include <optional>
#include <string>

#include "processes/console/views/json.h"
#include "processes/refiner/refine.h"

namespace bodyschema {

/// `refine`, for programs and for people. `claimed`: the rig before.
Json refinement_json(const Refinement& result, const std::optional<RigCalibration>& claimed);
std::string refinement_text(const Refinement& result, const std::optional<RigCalibration>& claimed);

}  // namespace bodyschema
