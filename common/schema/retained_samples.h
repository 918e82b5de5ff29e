#pragma once

#include <algorithm>
#include <cstdint>
#include <deque>
#include <map>
#include <memory>
#include <vector>

#include "common/schema/sample.h"

namespace bodyschema {

/// Samples that share their content.
using SharedSamples = std::vector<std::shared_ptr<const ActionPoseSample>>;

/// Of how many samples ever, those that everything is weighed on: of the samples of one body, from
/// index `first` to `last`, the ones whose index is a multiple of the least power of two that
/// leaves at most kMostRetained indices. All of them, while they are few; then every second, every
/// fourth, … A function of the indices alone, whatever was skipped and whenever `first` was
/// learned.
inline constexpr std::int64_t kMostRetained = 2000;
std::int64_t retained_stride(std::int64_t first, std::int64_t last);

/// The power of two that divides an index; that of 0 is larger than any.
int retained_power(std::int64_t index);
/// @throws std::invalid_argument if `last` is more than `max_lag` below the newest index.
void require_retained(std::int64_t last, std::int64_t newest, std::int64_t max_lag);

inline std::int64_t index_of(const ActionPoseSample& sample) { return sample.sample_index; }

/// Keeps what any such set of the newest samples may ask for: for every `first`, and every `last`
/// down to kMaxLag below the newest index. That is about kMostRetained samples and half as many
/// more whenever their number doubles; adding one costs the same however many there are.
/// `index_of(sample)` is a sample's index.
template <class Sample>
class Retained {
 public:
  static constexpr std::int64_t kMaxLag = 1000;
  using Shared = std::shared_ptr<const Sample>;

  /// Indices ascend.
  void add(Shared sample) {
    newest_ = index_of(*sample);
    by_power_[retained_power(newest_)].push_back(std::move(sample));
    // A stride never reaches back farther than this: from there on the next larger one is enough.
    for (auto& [power, samples] : by_power_) {
      if (power == retained_power(0)) continue;
      const std::int64_t oldest = newest_ - kMaxLag - (kMostRetained << power);
      while (!samples.empty() && index_of(*samples.front()) < oldest) samples.pop_front();
    }
  }
  /// The retained set of [first, last], ascending.
  /// @throws std::invalid_argument if `last` is more than kMaxLag below the newest index.
  std::vector<Shared> between(std::int64_t first, std::int64_t last) const {
    require_retained(last, newest_, kMaxLag);
    const int power = retained_power(retained_stride(first, last));
    std::vector<Shared> result;
    for (auto of = by_power_.lower_bound(power); of != by_power_.end(); ++of)
      for (const Shared& sample : of->second)
        if (index_of(*sample) >= first && index_of(*sample) <= last) result.push_back(sample);
    std::sort(result.begin(), result.end(),
              [](const Shared& a, const Shared& b) { return index_of(*a) < index_of(*b); });
    return result;
  }

  std::size_t size() const {
    std::size_t size = 0;
    for (const auto& [power, samples] : by_power_) size += samples.size();
    return size;
  }
  /// Everything that is kept, in no order.
  template <class Visit>
  void for_each(Visit&& visit) const {
    for (const auto& [power, samples] : by_power_)
      for (const Shared& sample : samples) visit(*sample);
  }

 private:
  /// By the power of two that divides the index; oldest first.
  std::map<int, std::deque<Shared>> by_power_;
  std::int64_t newest_ = -1;
};
using RetainedSamples = Retained<ActionPoseSample>;

/// The same of a recording, which is there at once.
std::vector<ActionPoseSample> retained(const std::vector<ActionPoseSample>& samples);

}  // namespace bodyschema
