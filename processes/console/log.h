#pragma once

#include <cstdint>
#include <filesystem>
#include <nlohmann/json.hpp>
#include <string>

#include "common/bus/arguments.h"
#include "common/bus/log_summary.h"

namespace bodyschema {

/// Adds `log`: what an LCM log holds, and whether it is whole and of this version.
void add_log_command(Arguments console);

/// The one rig folder below `rigs` to which all that the log tells may belong: cameras, tags,
/// signals, parts. @throws std::runtime_error if there is none or several.
std::filesystem::path rig_of(const std::filesystem::path& log, const std::filesystem::path& rigs);

/// `log --json`.
nlohmann::ordered_json log_json(const LogSummary& summary);
/// A table of the channels, and a line for every flaw.
std::string log_text(const LogSummary& summary);

/// Writes a small copy of a log, enough to replay and to report it: without images, ground truth
/// (SIM_STATE) and channels that are not ours, every message once however often it was repeated, of
/// PROCESS_INFO each process' first and last. Returns the number of events written.
/// @throws std::runtime_error; nothing is left of the copy then.
std::int64_t thin_log(const std::filesystem::path& file, const std::filesystem::path& copy);

}  // namespace bodyschema
