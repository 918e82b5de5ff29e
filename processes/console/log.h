#pragma once

#include <nlohmann/json.hpp>
#include <string>

#include "common/bus/log_summary.h"

namespace CLI {
class App;
}

namespace bodyschema {

/// Adds `log`: what an LCM log holds, and whether it is whole and of this version.
void add_log_command(CLI::App& console);

/// `log --json`.
nlohmann::ordered_json log_json(const LogSummary& summary);
/// A table of the channels, and a line for every flaw.
std::string log_text(const LogSummary& summary);

}  // namespace bodyschema
