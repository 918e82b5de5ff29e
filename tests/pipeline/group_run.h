#pragma once

#include <sys/wait.h>

#include <chrono>
#include <cstdlib>
#include <filesystem>
#include <functional>
#include <string>
#include <thread>

#include "common/bus/event_log.h"
#include "tests/support/text_of.h"

// What tests that launch whole groups by ./run have in common.

namespace bodyschema::test {

namespace fs = std::filesystem;

inline const fs::path kSource = BODYSCHEMA_SOURCE_FOLDER;
inline const fs::path kBin = BODYSCHEMA_BIN_FOLDER;

/// The exit code; 128 if a signal ended it.
inline int shell(const std::string& command) {
  const int status = std::system(command.c_str());
  return WIFEXITED(status) ? WEXITSTATUS(status) : 128;
}

inline std::string in_quotes(const fs::path& path) { return "'" + path.string() + "'"; }

/// Raw payloads of one channel, one after the other.
inline std::string payloads(const fs::path& log, const std::string& channel,
                            bool only_last = false) {
  std::string bytes;
  for_each_event(log, [&](const LogEvent& event) {
    if (event.channel != channel) return;
    if (only_last) bytes.clear();
    bytes.append(event.data.begin(), event.data.end());
  });
  return bytes;
}

/// Asks every 50 ms, for at most `limit`.
inline bool becomes_true(std::chrono::seconds limit, const std::function<bool()>& condition) {
  const auto end = std::chrono::steady_clock::now() + limit;
  while (!condition()) {
    if (std::chrono::steady_clock::now() > end) return false;
    std::this_thread::sleep_for(std::chrono::milliseconds(50));
  }
  return true;
}

}  // namespace bodyschema::test
