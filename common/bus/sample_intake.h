#pragma once

#include <cstdint>
#include <functional>
#include <map>
#include <string>
#include <unordered_map>
#include <utility>
#include <vector>

#include "bodyschema/sample_request_t.hpp"
#include "bodyschema/sample_t.hpp"

namespace bodyschema {

class Process;

/// Hands SAMPLEs on in order of their index, each once and without gaps: what was recorded before
/// this process started and what a datagram lost is read from the observer's log, and where there
/// is none, or it does not have them, the observer is asked to send them again. Samples behind a
/// gap wait until it is closed, so that on every machine the same samples come in the same order.
///
/// A gap is given up when the observer was heard ten times and did not fill it: its log was
/// deleted. The samples in it are then "lost SAMPLE" in counters(). While nothing is heard of the
/// observer there is no hurry.
///
/// The first content of an index counts. Another one ("conflicting SAMPLE") comes from an observer
/// that began anew, and whoever learned from the first must do so too.
class SampleIntake {
 public:
  using Handler = std::function<void(const sample_t&)>;
  /// Publishes a SAMPLE_REQUEST.
  using Ask = std::function<void(sample_request_t request)>;
  /// Publishes in the name of the process; nobody is asked in a replay, where nobody answers, nor
  /// where `has_observer` says that none runs.
  static Ask asking(Process& process, bool has_observer = true);

  /// Hands on what `samples_file` holds already. An empty name, a file that does not exist yet or a
  /// damaged one is no error. Without `ask` what the file cannot fill is given up at once.
  SampleIntake(std::string samples_file, Handler handler, Ask ask = nullptr);

  void on_sample(const sample_t& sample);
  /// Asks at 2 Hz. `now_us`: Process::on_tick's.
  void on_tick(std::int64_t now_us);

  /// "lost SAMPLE", "conflicting SAMPLE" → count since the start.
  const std::map<std::string, std::int64_t>& counters() const { return counters_; }
  std::int64_t num_lost() const { return counters_.at("lost SAMPLE"); }
  /// First and last index of every gap that was given up, in order.
  const std::vector<std::pair<std::int64_t, std::int64_t>>& lost() const { return lost_; }
  /// What it waits for, for people; "" if for nothing.
  std::string activity() const;

 private:
  void catch_up();
  bool read_file();
  void take(const sample_t& sample);
  bool hand_on_next();
  void hand_on();
  void give_up_gap();

  const std::string samples_file_;
  const Handler handler_;
  const Ask ask_;
  std::int64_t next_index_ = 0;
  std::map<std::int64_t, sample_t> ahead_;               ///< behind a gap, by index
  std::unordered_map<std::int64_t, std::size_t> known_;  ///< index handed on → what it was
  std::map<std::string, std::int64_t> counters_ = {{"conflicting SAMPLE", 0}, {"lost SAMPLE", 0}};
  std::vector<std::pair<std::int64_t, std::int64_t>> lost_;
  bool is_begun_anew_ = false;
  std::int64_t size_read_ = 0;    ///< of the file, when it was last read [bytes]
  std::int64_t position_ = 0;     ///< up to where, in whole events
  std::int64_t asked_us_ = -1;
  bool is_observer_heard_ = false;  ///< since the last request
  int num_unanswered_ = 0;
  int num_repeats_ = 0;  ///< of the newest sample, while others wait behind a gap
};

}  // namespace bodyschema
