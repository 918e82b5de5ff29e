#pragma once

#include <cstdint>
#include <string>

namespace bodyschema {

/// Progress on stderr: a terminal gets a line that rewrites itself, a file one line after another.
class ProgressLine {
 public:
  ProgressLine();
  ProgressLine(const ProgressLine&) = delete;
  ProgressLine& operator=(const ProgressLine&) = delete;
  /// The line is gone from a terminal.
  ~ProgressLine();
  /// Each change.
  void show(const std::string& line);
  /// For what changes all the time: a terminal gets it at most ten times a second, a file every
  /// five seconds.
  void show_throttled(const std::string& line);
  /// The line stays.
  void end();

 private:
  const bool is_terminal_;
  std::string shown_;
  std::int64_t shown_us_ = 0;
};

}  // namespace bodyschema
