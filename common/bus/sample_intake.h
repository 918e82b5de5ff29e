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
#include "common/bus/arguments.h"

namespace bodyschema {

class Process;

/// Delivers SAMPLEs in order of their index, each once and without gaps: samples from before the
/// start of this process, and those lost with a datagram, are read from the observer's log; the
/// observer is asked for those that the log does not have. Samples behind a gap wait until it is
/// closed, so that on every machine the same samples come in the same order.
///
/// A gap is given up when the observer was heard ten times and did not fill it: its log was
/// deleted. Its samples are then "lost SAMPLE" in counters(). While the observer is silent the gap
/// stays.
///
/// The first content of an index counts. Another one ("conflicting SAMPLE") comes from an observer
/// that began anew, and a process that learned from the first must begin anew too; or from a sender
/// that is no observer.
///
/// If the log exists and the observer is live, the observer is on this machine and writes each
/// sample before it sends it: a sample that is not in the file is not the observer's ("unrecorded
/// SAMPLE") and is refused. Other machines cannot recognise it.
class SampleIntake {
 public:
  /// Flags of a process that reads samples.
  struct Options {
    std::string samples_file;
    bool is_replayed = false;
    void add_to(Arguments app);
  };
  using Handler = std::function<void(const sample_t&)>;
  /// Publishes a SAMPLE_REQUEST.
  using Ask = std::function<void(sample_request_t request)>;
  /// Publishes in the name of the process; does not ask in a replay, nor if `has_observer` says
  /// that no observer runs.
  static Ask asking(Process& process, bool has_observer = true);

  /// Delivers the samples that `samples_file` holds. An empty name, a file that does not exist yet
  /// or a damaged one is no error. Without `ask` gaps that the file cannot fill are given up at
  /// once.
  SampleIntake(std::string samples_file, Handler handler, Ask ask = nullptr);

  /// Returns false for a refused sample: unrecorded or conflicting.
  bool on_sample(const sample_t& sample);
  /// Asks at 2 Hz. `now_us`: Process::on_tick's.
  void on_tick(std::int64_t now_us);

  /// "lost SAMPLE", "conflicting SAMPLE", "unrecorded SAMPLE", "damaged bytes of samples.lcmlog" →
  /// count since the start.
  const std::map<std::string, std::int64_t>& counters() const { return counters_; }
  std::int64_t num_lost() const { return counters_.at("lost SAMPLE"); }
  /// First and last index of every gap that was given up, in order.
  const std::vector<std::pair<std::int64_t, std::int64_t>>& lost() const { return lost_; }
  /// Reason for waiting, for people; "" if it waits for nothing.
  std::string activity() const;

 private:
  enum class Taken { kNew, kRepeated, kConflicting, kTooLate };
  void read_file();
  bool is_recorded_here() const;
  Taken take(const sample_t& sample);
  void hand_on(bool over_gaps);
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
  // Identity of the file when it was read last, and the position reached.
  std::uintmax_t file_id_ = 0;
  std::int64_t size_read_ = 0, position_ = 0;
  std::int64_t newest_recorded_ = -1;
  std::int64_t asked_us_ = -1;
  bool is_observer_heard_ = false;  ///< since the last request
  int num_unanswered_ = 0;
  int num_repeats_ = 0;  ///< of the newest sample, while others wait behind a gap
};

}  // namespace bodyschema
