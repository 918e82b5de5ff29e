#pragma once

#include <cstdint>
#include <filesystem>
#include <map>
#include <string>

#include "common/bus/event_log.h"

namespace bodyschema {

/// What an LCM log holds, whoever wrote it and however it ended.
struct LogSummary {
  struct Channel {
    std::int64_t num_events = 0;
    /// Of a channel of ours: messages that this program cannot use, and why not the first of them,
    /// e.g. because they were recorded with older message definitions.
    std::int64_t num_unreadable = 0;
    std::string problem;

    bool is_readable() const { return num_events > num_unreadable; }
  };

  std::map<std::string, Channel> channels;
  std::int64_t num_events = 0;
  double duration_s = 0;  ///< from the first to the last event
  /// "", or where the log is cut off or damaged; nothing behind that byte was looked at.
  std::string ending;

  bool has_readable(const std::string& channel) const;
};

/// Reads the whole log. @throws std::runtime_error if there is none, or it is no LCM log at all.
LogSummary summarize_log(const std::filesystem::path& path);

/// Why this program cannot use the event; "" if it can, or the channel is none of ours.
std::string problem_of(const LogEvent& event);

}  // namespace bodyschema
