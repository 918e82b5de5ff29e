#pragma once

#include <spdlog/spdlog.h>

#include <filesystem>
#include <functional>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "common/bus/event_log.h"

namespace bodyschema {

/// Moves a file that cannot be used out of the way, to FILE.bad-1, with a warning.
inline void set_aside(const std::filesystem::path& file, const std::string& problem) {
  const auto aside = copy_aside(file);
  std::filesystem::remove(file);
  spdlog::warn("{}; set aside as {}", problem, aside.filename().string());
}

/// Whether `read` could use the file: it returns "" or why not, or throws std::runtime_error. One
/// that cannot be used is set aside as FILE.bad-1 with a warning: what it held is found out again
/// from the samples, and nobody stumbles over it at each start. False without a file.
inline bool use_or_set_aside(const std::filesystem::path& file,
                             const std::function<std::string()>& read) {
  if (file.empty() || !std::filesystem::exists(file)) return false;
  std::string problem;
  try {
    problem = read();
    if (problem.empty()) return true;
    problem = file.string() + ": " + problem;
  } catch (const std::runtime_error& error) {
    problem = error.what();
  }
  set_aside(file, problem);
  return false;
}

/// A message that outlives its process: a log of one event, replaced atomically. Without a file
/// nothing is kept.
template <class Message>
class SavedMessage {
 public:
  SavedMessage(std::filesystem::path file, Channel<Message> channel)
      : file_(std::move(file)), channel_(channel) {}

  /// What was saved; std::nullopt if nothing was that can be used: undamaged, and without an
  /// `objection`. See use_or_set_aside().
  std::optional<Message> load(const std::function<std::string(const Message&)>& objection) {
    std::vector<Message> messages;
    const bool is_of_use = use_or_set_aside(file_, [&] {
      messages = read_log(file_, channel_);
      return messages.empty() ? std::string("holds no ") + channel_.name
                              : objection(messages.back());
    });
    if (!is_of_use) return std::nullopt;
    saved_ = encode(channel_, messages.back());
    return std::move(messages.back());
  }

  /// Writes the message unless it is what was written last. Returns "" or why it could not be
  /// written, for people; the next call tries again.
  std::string save(const Message& message) {
    std::vector<std::uint8_t> bytes = encode(channel_, message);
    if (file_.empty() || bytes == saved_) return "";
    try {
      write_one_event_log(file_, channel_, message);
    } catch (const std::runtime_error& error) {
      return error.what();
    }
    saved_ = std::move(bytes);
    return "";
  }

 private:
  const std::filesystem::path file_;
  const Channel<Message> channel_;
  std::vector<std::uint8_t> saved_;
};

}  // namespace bodyschema
