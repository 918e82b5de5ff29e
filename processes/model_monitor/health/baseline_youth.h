#pragma once

#include <cstdint>
#include <vector>

#include "bodyschema/health_event_t.hpp"

namespace bodyschema {

/// Whether a change of the body is believed, or that its baseline was wrong from the start.
///
/// A wrong baseline fails at some unknown rate: with a uniform prior of it the probability of k
/// mismatches and n samples without one is B(k + 1, n + 1), Laplace's rule of succession. A right
/// one fails when the body changes, which is rare. So a mismatch in the first samples, or one after
/// the other, speaks against the baseline, one after many quiet samples for a change.
///
/// While the baseline is young, what was decided on changes is held back. A part whose marker is
/// not seen is told at once: no structure is needed to know that.
class BaselineYouth {
 public:
  /// Of a baseline whose tree so many samples confirmed that it was not learned from.
  explicit BaselineYouth(std::int64_t num_confirming = 0);

  /// One more sample, and what was decided at it. Returns what can be told now.
  std::vector<health_event_t> on_sample(std::vector<health_event_t> events, bool is_confirming);
  /// The body did change. Returns what was held back.
  std::vector<health_event_t> end();

  /// A change is told as soon as it is found.
  bool is_over() const { return is_over_; }
  /// A change was found, or suspected so that it would be told, and is held back.
  bool has_story() const { return num_mismatches_ > 0; }
  /// The first sample that disagreed; −1 without a story.
  std::int64_t story_since() const { return story_since_; }
  /// Of "the baseline was wrong" against "the body changed", from when mismatches came alone
  /// [nats].
  double log_odds_wrong() const;
  /// The body changed, by these odds.
  bool is_story_believed() const;
  std::int64_t num_confirming() const { return num_confirming_; }

 private:
  std::int64_t num_confirming_ = 0;
  std::int64_t num_mismatches_ = 0;
  std::int64_t story_since_ = -1;
  bool is_over_ = false;
  std::vector<health_event_t> held_back_;
};

}  // namespace bodyschema
