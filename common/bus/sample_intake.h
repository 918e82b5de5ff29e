#pragma once

#include <cstdint>
#include <functional>
#include <string>

#include "bodyschema/sample_t.hpp"

namespace bodyschema {

/// Hands SAMPLEs on in order of their index, each once, without gaps where the observer's sample
/// log can fill them: what was recorded before this process started, and what a datagram lost.
class SampleIntake {
 public:
  /// Hands on what `samples_file` holds already. An empty name, or a file that does not exist yet,
  /// is no error: then live samples are all there is, gaps included.
  SampleIntake(std::string samples_file, std::function<void(const sample_t&)> handler);

  void on_sample(const sample_t& sample);
  /// Looks into the log when no sample has come for 2 s: the last one of a run may be lost too.
  /// `now_us`: the clock.
  void on_tick(std::int64_t now_us);

  /// Samples that were missed and could not be found in the log.
  std::int64_t num_lost() const { return num_lost_; }

 private:
  void read_log();
  void hand_on(const sample_t& sample);

  const std::string samples_file_;
  const std::function<void(const sample_t&)> handler_;
  std::int64_t next_index_ = 0;
  std::int64_t num_lost_ = 0;
  std::uintmax_t size_read_ = 0;  ///< of the log [bytes]
  bool is_quiet_ = false;         ///< no sample since the last tick
  std::int64_t quiet_since_us_ = 0;
};

}  // namespace bodyschema
