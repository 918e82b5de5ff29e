#pragma once

#include <filesystem>
#include <optional>
#include <string>

#include "common/schema/body_schema.h"

namespace CLI {
class App;
}

namespace bodyschema {

/// Adds `learn`, `predict`, `show` and `rig`: work on files, without a bus. The result goes to
/// stdout.
void add_offline_commands(CLI::App& console);

/// Reads a schema file: a log with one BODY_SCHEMA; of several the last counts.
/// @throws std::runtime_error.
BodySchema load_schema(const std::filesystem::path& file);

}  // namespace bodyschema
