#pragma once

#include <sys/types.h>

#include <string>

namespace bodyschema {

/// Plays a recording onto the bus with lcm-logplayer: what the learning half of the group needs,
/// never a command.
class LogPlayer {
 public:
  LogPlayer() = default;
  LogPlayer(const LogPlayer&) = delete;
  LogPlayer& operator=(const LogPlayer&) = delete;
  ~LogPlayer();

  /// `from`: SAMPLE or MARKER_POSES. `speed`: so many times faster than it was. @throws
  /// std::runtime_error if there is no lcm-logplayer.
  void start(const std::string& log, const std::string& from, double speed, const std::string& url);
  bool has_started() const { return pid_ > 0; }
  /// @throws std::runtime_error if it failed.
  bool is_running();

 private:
  pid_t pid_ = -1;
  bool has_ended_ = false;
};

}  // namespace bodyschema
