#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <vector>

#include "common/schema/sample.h"

namespace bodyschema {

/// How the poses of a stream come after their commands: drives, filters and exposure take time, and
/// clocks differ. A drive of first order after a dead time (the process control model of that name,
/// FOPDT), between commands that are linear in time.
struct CommandDelay {
  std::int64_t lag_us = 0;    ///< dead time + time constant; below 0: before them
  std::int64_t smear_us = 0;  ///< time constant of the drive: 0 … 1.25 lag_us

  bool operator==(const CommandDelay&) const = default;
};

/// [µs]
double time_of(const ActionPoseSample& sample);
/// 0 of fewer than two samples.
double median_interval_us(const std::vector<ActionPoseSample>& samples);

/// The commands of a stream, ascending in time, and those between them, linear in time. Keeps a
/// reference.
class CommandTrack {
 public:
  explicit CommandTrack(const std::vector<ActionPoseSample>& samples);

  /// std::nullopt before the first, after the last, and where too far from the next.
  std::optional<Eigen::VectorXd> at(double time_us) const;

  /// The samples around which it is known everywhere within `margin_us`.
  std::vector<std::size_t> within(double margin_us) const { return within(margin_us, margin_us); }
  std::vector<std::size_t> within(double past_us, double future_us) const;
  const std::vector<ActionPoseSample>& samples() const { return samples_; }
  /// Nothing is known of what is between sample n and the one before.
  bool is_behind_gap(std::size_t n) const;

 private:
  const std::vector<ActionPoseSample>& samples_;
  const double most_apart_us_;
};

/// Where the commands of a track have brought an arm that follows them with a delay. Keeps a
/// reference.
class DelayedTrack {
 public:
  DelayedTrack(const CommandTrack& track, const CommandDelay& delay);

  /// How far before and after a sample commands must be known.
  double past_us() const;
  double future_us() const;

  /// std::nullopt where too little is known of the commands before.
  std::optional<Eigen::VectorXd> at(double time_us) const;

 private:
  Eigen::VectorXd rate_after(std::size_t n) const;
  // From sample n on, its commands being linear up to the next.
  Eigen::VectorXd followed(std::size_t n, double time_us) const;

  const CommandTrack& track_;
  const double dead_us_, constant_us_;
  std::vector<double> begins_us_;        // by sample: of the commands known without a gap
  std::vector<Eigen::VectorXd> states_;  // by sample: without the dead time
};

/// Each sample with the command that brought it there; those that have none, at the ends and behind
/// gaps, are left out, and those of a time before one that came earlier.
std::vector<ActionPoseSample> with_commands_of_before(const std::vector<ActionPoseSample>& samples,
                                                      const CommandDelay& delay);

}  // namespace bodyschema
