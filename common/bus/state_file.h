#pragma once

#include <cstdint>
#include <filesystem>
#include <string>
#include <utility>

namespace bodyschema {

/// The text that a process needs after a restart, kept in a file. A full disk does not end the
/// process: a failed save is reported and tried again. Without a file nothing is kept, and
/// everything counts as saved.
class StateFile {
 public:
  /// `text` needs no saving, because the file holds it or nothing was done yet.
  StateFile(std::filesystem::path file, std::string text)
      : file_(std::move(file)), wanted_(text), saved_(std::move(text)) {}

  /// Replaces the file as a whole unless it holds `text`; only retry() repeats a failed save. True
  /// if the file holds `text`.
  bool save(const std::string& text);
  /// To be called now and then. True if the file holds the text of the last save().
  bool retry();

  /// "" or why the text of the last save() is not on disk, for people.
  const std::string& problem() const { return problem_; }
  /// Attempts that failed, since the start.
  std::int64_t num_failed() const { return num_failed_; }

 private:
  const std::filesystem::path file_;
  std::string wanted_, saved_;
  std::string problem_;
  std::int64_t num_failed_ = 0;
};

}  // namespace bodyschema
