#pragma once

#include <nlohmann/json.hpp>
#include <string>

#include "processes/console/status_board.h"

namespace bodyschema {

/// One screen of lines of at most `width` characters: what is wrong, the headline, all else.
std::string status_text(const GroupStatus& status, int width);

/// `status --json`.
nlohmann::ordered_json status_json(const GroupStatus& status);

}  // namespace bodyschema
