#pragma once

#include <string>
#include <string_view>

namespace bodyschema {

/// What the user types for a command of this program: "./run WORDS" where the launcher says so
/// (BODYSCHEMA_COMMAND), else "bodyschema WORDS".
std::string to_type(const std::string& words);

/// `text` for an error: of more than 40 bytes the first ones and "…".
std::string abbreviated(std::string_view text);

}  // namespace bodyschema
