#pragma once

#include <cstdint>
#include <deque>
#include <filesystem>
#include <functional>
#include <map>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "bodyschema/sample_request_t.hpp"
#include "bodyschema/sample_t.hpp"
#include "common/bus/event_log.h"

namespace bodyschema {

/// Sends the observer's samples: each once it is on disk, the newest one again at 1 Hz, and
/// requested ones, at most 250 a second.
///
/// A sample that cannot be written (the disk is full) is held back, with those after it, and tried
/// again every second. So a sample that was used is in the log after a crash.
class SampleOutbox {
 public:
  using Publish = std::function<void(const sample_t&)>;

  /// `file`: samples.lcmlog, continued; empty: only the newest sample is kept. The readable samples
  /// of a damaged file are kept, and the whole of it in FILE.bad-1.
  /// @throws std::runtime_error if the file cannot be opened or another process writes it.
  SampleOutbox(std::filesystem::path file, Publish publish);

  /// Samples of the file at the start, in order of the indices, one at a time.
  void for_each_recorded(const std::function<void(const sample_t&)>& visit) const;

  void send(const sample_t& sample);
  void on_request(const sample_request_t& request);
  /// `now_us`: Process::on_tick's.
  void on_tick(std::int64_t now_us);

  /// Why samples are held back, for people; "" if none is.
  std::string problem() const;
  /// "held SAMPLE", "sent again SAMPLE", "damaged bytes of samples.lcmlog" → count since the start.
  const std::map<std::string, std::int64_t>& counters() const { return counters_; }

 private:
  void open();
  void flush();
  void send_again();

  const std::filesystem::path file_;
  const Publish publish_;
  std::optional<LogAppender> log_;
  std::map<std::int64_t, std::int64_t> positions_;  ///< sample_index → byte in the file
  std::deque<sample_t> held_;
  std::string problem_;
  std::int64_t tried_us_ = 0;
  std::optional<sample_t> newest_;
  std::int64_t sent_us_ = 0;
  bool is_newest_sent_ = false;  ///< since the last tick
  std::set<std::int64_t> wanted_;
  std::map<std::string, std::int64_t> counters_;
};

}  // namespace bodyschema
