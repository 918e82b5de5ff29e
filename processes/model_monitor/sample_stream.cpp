#include "processes/model_monitor/sample_stream.h"

#include <cmath>

namespace bodyschema {
namespace {

constexpr std::int64_t kBlock_us = 1'000'000;
constexpr std::int64_t kLongestInterval_us = 250'000;
constexpr double kLargestStep = 0.1;  // of a signal's range

}  // namespace

bool is_small_step(const Eigen::VectorXd& from, const Eigen::VectorXd& to,
                   const std::vector<Signal>& signals) {
  for (std::size_t s = 0; s < signals.size(); ++s) {
    const auto n = static_cast<Eigen::Index>(s);
    if (std::abs(to(n) - from(n)) > kLargestStep * (signals[s].upper - signals[s].lower))
      return false;
  }
  return true;
}

bool SampleStream::repeats(const ActionPoseSample& sample, const std::vector<Signal>& signals) {
  const bool is_repeated = last_ && sample.utime > last_->utime &&
                           sample.utime - last_->utime <= kLongestInterval_us &&
                           sample.utime - last_->judged_utime < kBlock_us &&
                           is_small_step(last_->action, sample.action, signals);
  last_ = Last{sample.utime, is_repeated ? last_->judged_utime : sample.utime, sample.action};
  sample_index_ = sample.sample_index;
  if (is_repeated) {
    ++num_repetitions_;
  } else if (num_repetitions_ > 0) {
    repetitions_before_.emplace_back(count(), num_repetitions_);
    if (repetitions_before_.size() > kRemembered) repetitions_before_.pop_front();
  }
  return is_repeated;
}

std::int64_t SampleStream::sample_index_of(std::int64_t count) const {
  std::int64_t repetitions =
      repetitions_before_.size() < kRemembered ? 0 : repetitions_before_.front().second;
  for (const auto& [first, before] : repetitions_before_)
    if (first <= count) repetitions = before;
  return count + repetitions;
}

}  // namespace bodyschema
