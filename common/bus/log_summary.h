#pragma once

#include <cstdint>
#include <filesystem>
#include <map>
#include <set>
#include <string>

#include "common/bus/event_log.h"

namespace bodyschema {

/// Contents of one channel of a log.
struct ChannelSummary {
  std::int64_t events = 0;
  std::int64_t bytes = 0;        ///< of the payloads
  std::int64_t unreadable = 0;   ///< malformed, senseless, or of another version
  std::string first_problem;     ///< of the first unreadable event
  bool is_known = true;          ///< false: no channel of ours
  std::int64_t first_utime = 0;  ///< event times [us since 1970]
  std::int64_t last_utime = 0;
};

/// Contents and end of a log.
struct LogSummary {
  std::map<std::string, ChannelSummary> channels;
  std::int64_t events = 0;
  std::int64_t first_utime = 0;  ///< event time of the first event [us since 1970]
  std::int64_t last_utime = 0;   ///< the latest
  std::int64_t file_bytes = 0;
  std::int64_t incomplete = 0;     ///< messages of which pieces are missing
  std::int64_t unread_bytes = 0;   ///< after the last whole event
  std::string damage;              ///< why the rest was not read; "" if all was
  std::set<std::string> versions;  ///< of the programs that were heard, from PROCESS_INFO

  void add(const LogEvent& event);
  std::int64_t unreadable() const;
  /// Whole, not empty, and nothing of our channels unreadable.
  bool is_sound() const { return damage.empty() && events > 0 && unreadable() + incomplete == 0; }
};

/// Reads the whole log; unreadable events are counted, never an error.
/// @throws std::runtime_error if there is no such file or it is not an LCM log.
LogSummary summarize_log(const std::filesystem::path& file);

/// Why this program cannot use the event; "" if it can, or the channel is none of ours.
std::string problem_of(const LogEvent& event);

/// Version of this program, as PROCESS_INFO carries it.
std::string program_version();

/// One line about every flaw and what to do, none if the log is sound; for people.
std::string flaws_text(const LogSummary& summary);

}  // namespace bodyschema
