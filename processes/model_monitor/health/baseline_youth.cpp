#include "processes/model_monitor/health/baseline_youth.h"

#include <algorithm>
#include <cmath>
#include <utility>

namespace bodyschema {
namespace {

/// Share of first complete structures that are wrong: chosen.
constexpr double kWrongShare = 0.1;
/// Changes of the body a sample: chosen, one in a thousand.
constexpr double kChangeRate = 1e-3;
/// Odds at which a change is believed: chosen. With these three a baseline is young for 16 samples.
constexpr double kClearOdds = 3;

double log_odds(std::int64_t num_mismatches, std::int64_t num_confirming) {
  const auto k = static_cast<double>(num_mismatches), n = static_cast<double>(num_confirming);
  const double log_beta = std::lgamma(k + 1) + std::lgamma(n + 1) - std::lgamma(n + k + 2);
  return std::log(kWrongShare) + log_beta - k * std::log(kChangeRate);
}

bool is_about_a_part_alone(const health_event_t& event) {
  return event.event_part >= 0 && event.event_tag < 0 &&
         event.event_cause == health_event_t::CAUSE_MARKER_MISSING;
}

/// Each change begins with one.
bool is_mismatch(const health_event_t& event) {
  return event.event_kind == health_event_t::EVENT_MISMATCH ||
         event.event_kind == health_event_t::EVENT_DRIFT || event.event_tag >= 0;
}

}  // namespace

BaselineYouth::BaselineYouth(std::int64_t num_confirming)
    : num_confirming_(num_confirming),
      is_over_(log_odds(1, num_confirming) < -std::log(kClearOdds)) {}

double BaselineYouth::log_odds_wrong() const { return log_odds(num_mismatches_, num_confirming_); }

bool BaselineYouth::is_story_believed() const { return log_odds_wrong() < -std::log(kClearOdds); }

std::vector<health_event_t> BaselineYouth::on_sample(std::vector<health_event_t> events,
                                                     bool is_confirming) {
  if (is_over_) return events;
  std::vector<health_event_t> told;
  bool is_quiet = true;
  for (health_event_t& event : events) {
    if (is_about_a_part_alone(event)) {
      told.push_back(std::move(event));
      continue;
    }
    if (is_mismatch(event)) {
      is_quiet = false;
      if (story_since_ < 0) story_since_ = event.event_sample - std::max(event.samples_used, 1) + 1;
    }
    held_back_.push_back(std::move(event));
  }
  num_mismatches_ += !is_quiet;
  num_confirming_ += is_quiet && is_confirming;
  if (!has_story()) is_over_ = log_odds(1, num_confirming_) < -std::log(kClearOdds);
  return told;
}

std::vector<health_event_t> BaselineYouth::end() {
  is_over_ = true;
  num_mismatches_ = 0;
  story_since_ = -1;
  return std::exchange(held_back_, {});
}

}  // namespace bodyschema
