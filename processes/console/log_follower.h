#pragma once

#include <cstdint>
#include <filesystem>
#include <functional>
#include <map>

#include "common/bus/event_log.h"
#include "common/bus/log_summary.h"

namespace bodyschema {

/// Reads logs while somebody else writes them: every event once, as soon as it is whole.
class LogFollower {
 public:
  /// `event` begins at `byte` of `file`.
  using Visit = std::function<void(const LogEvent& event, const std::filesystem::path& file,
                                   std::int64_t byte)>;

  /// Reads what `file` got since the last time; returns whether there was a new event. A file that
  /// is not there yet, or empty, is no error; one that is damaged or no log is read up to there and
  /// says so in its summary. A message in pieces is one event, at the byte of its last piece.
  bool read(const std::filesystem::path& file, const Visit& visit);

  /// Summaries of what was read so far, by file. A torn event at the end, which may still be
  /// growing, counts as damage until it is whole.
  const std::map<std::filesystem::path, LogSummary>& summaries() const { return summaries_; }

 private:
  struct Progress {
    std::int64_t position = 0;   ///< [bytes] of whole events
    std::int64_t seen_size = 0;  ///< [bytes] of the file when it was last looked into
    EventJoiner joiner;          ///< of pieces up to position
    bool is_damaged = false;     ///< nothing can be read beyond position, ever
  };
  std::map<std::filesystem::path, Progress> progress_;
  std::map<std::filesystem::path, LogSummary> summaries_;
};

}  // namespace bodyschema
