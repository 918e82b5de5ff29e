#pragma once

#include <vector>

#include "common/schema/body_schema.h"
#include "common/schema/sample.h"

namespace bodyschema {

/// All poses of the recording are one cluster: no part moves by more than three times the noise of
/// its marker, or no joint of the schema by more than 5° or 10 mm. What was learned holds near
/// these poses; how it goes on is a guess. False where no signal moves.
bool is_one_cluster(const BodySchema& schema, const std::vector<ActionPoseSample>& samples);

}  // namespace bodyschema
