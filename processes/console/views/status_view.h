#pragma once

#include <string>

#include "processes/console/status_board.h"
#include "processes/console/views/json.h"

namespace bodyschema {

/// One screen of lines of at most `width` characters: what is wrong, the headline, all else.
std::string status_text(const GroupStatus& status, int width);

/// `status --json`.
Json status_json(const GroupStatus& status);

}  // namespace bodyschema
