#include "processes/structure_learner/command_track.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "common/estimation/quantile.h"

namespace bodyschema {
namespace {

/// Commands farther apart, in median intervals, tell nothing of those between them. Chosen.
constexpr double kMostApart = 4;
/// In time constants: the error of the assumed start has decayed to e⁻³ = 5 %. Chosen.
constexpr double kForgotten = 3;

}  // namespace

double time_of(const ActionPoseSample& sample) { return static_cast<double>(sample.utime); }

double median_interval_us(const std::vector<ActionPoseSample>& samples) {
  std::vector<double> intervals;
  for (std::size_t n = 1; n < samples.size(); ++n)
    intervals.push_back(time_of(samples[n]) - time_of(samples[n - 1]));
  return intervals.empty() ? 0 : upper_median(std::move(intervals));
}

CommandTrack::CommandTrack(const std::vector<ActionPoseSample>& samples)
    : samples_(samples), most_apart_us_(kMostApart * median_interval_us(samples)) {}

std::optional<Eigen::VectorXd> CommandTrack::at(double time_us) const {
  const auto after = std::ranges::lower_bound(samples_, time_us, {}, time_of);
  if (after == samples_.end()) return std::nullopt;
  if (time_of(*after) == time_us) return after->action;
  if (after == samples_.begin()) return std::nullopt;
  const auto before = after - 1;
  const double apart_us = time_of(*after) - time_of(*before);
  if (apart_us > most_apart_us_) return std::nullopt;
  const double share = (time_us - time_of(*before)) / apart_us;
  return before->action + share * (after->action - before->action);
}

std::vector<std::size_t> CommandTrack::within(double past_us, double future_us) const {
  std::vector<std::size_t> inner;
  for (std::size_t begin = 0, end = 0; begin < samples_.size(); begin = end) {
    for (end = begin + 1; end < samples_.size() && !is_behind_gap(end);) ++end;
    for (std::size_t n = begin; n < end; ++n)
      if (time_of(samples_[n]) - past_us >= time_of(samples_[begin]) &&
          time_of(samples_[n]) + future_us <= time_of(samples_[end - 1]))
        inner.push_back(n);
  }
  return inner;
}

bool CommandTrack::is_behind_gap(std::size_t n) const {
  return n == 0 || time_of(samples_[n]) - time_of(samples_[n - 1]) > most_apart_us_;
}

DelayedTrack::DelayedTrack(const CommandTrack& track, const CommandDelay& delay)
    : track_(track),
      dead_us_(static_cast<double>(delay.lag_us - delay.smear_us)),
      constant_us_(static_cast<double>(delay.smear_us)) {
  if (delay.smear_us == 0) return;
  const std::vector<ActionPoseSample>& samples = track.samples();
  double begin_us = 0;
  for (std::size_t n = 0; n < samples.size(); ++n) {
    const bool begins = track.is_behind_gap(n);
    if (begins) begin_us = time_of(samples[n]);
    begins_us_.push_back(begin_us);
    // As if it had moved evenly before.
    const bool is_alone = n + 1 == samples.size() || track.is_behind_gap(n + 1);
    states_.push_back(!begins ? followed(n - 1, time_of(samples[n]))
                      : is_alone
                          ? samples[n].action
                          : Eigen::VectorXd(samples[n].action - constant_us_ * rate_after(n)));
  }
}

double DelayedTrack::past_us() const { return std::max(0.0, dead_us_) + kForgotten * constant_us_; }
double DelayedTrack::future_us() const { return std::max(0.0, -dead_us_); }

std::optional<Eigen::VectorXd> DelayedTrack::at(double time_us) const {
  time_us -= dead_us_;
  if (states_.empty()) return track_.at(time_us);
  const std::vector<ActionPoseSample>& samples = track_.samples();
  const auto after = std::ranges::lower_bound(samples, time_us, {}, time_of);
  if (after == samples.end()) return std::nullopt;
  const auto n = static_cast<std::size_t>(after - samples.begin());
  if (time_us - begins_us_[n] < kForgotten * constant_us_) return std::nullopt;
  return time_of(*after) == time_us ? states_[n] : followed(n - 1, time_us);
}

Eigen::VectorXd DelayedTrack::rate_after(std::size_t n) const {
  const ActionPoseSample &from = track_.samples()[n], &to = track_.samples()[n + 1];
  const double apart_us = time_of(to) - time_of(from);
  if (apart_us <= 0) return Eigen::VectorXd::Zero(from.action.size());
  return (to.action - from.action) / apart_us;
}

Eigen::VectorXd DelayedTrack::followed(std::size_t n, double time_us) const {
  const ActionPoseSample& from = track_.samples()[n];
  const double passed_us = time_us - time_of(from);
  const Eigen::VectorXd rate = rate_after(n);
  const double kept = std::exp(-passed_us / constant_us_);
  return from.action + rate * (passed_us - constant_us_) +
         kept * (states_[n] - from.action + constant_us_ * rate);
}

std::vector<ActionPoseSample> with_commands_of_before(const std::vector<ActionPoseSample>& samples,
                                                      const CommandDelay& delay) {
  if (delay == CommandDelay{}) return samples;
  if (!std::ranges::is_sorted(samples, {}, time_of)) {
    std::vector<ActionPoseSample> ascending;
    for (const ActionPoseSample& sample : samples)
      if (ascending.empty() || time_of(sample) >= time_of(ascending.back()))
        ascending.push_back(sample);
    return with_commands_of_before(ascending, delay);
  }
  const CommandTrack track(samples);
  const DelayedTrack drive(track, delay);
  std::vector<ActionPoseSample> moved;
  for (const ActionPoseSample& sample : samples)
    if (std::optional<Eigen::VectorXd> action = drive.at(time_of(sample))) {
      moved.push_back(sample);
      moved.back().action = *std::move(action);
    }
  return moved;
}

}  // namespace bodyschema
