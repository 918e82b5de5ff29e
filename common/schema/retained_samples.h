#pragma once

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

/// Keeps what any such set of the newest samples may ask for: for every `first`, and every `last`
/// down to kMaxLag below the newest index. That is about kMostRetained samples and half as many
/// more whenever their number doubles; adding one costs the same however many there are.
class RetainedSamples {
 public:
  static constexpr std::int64_t kMaxLag = 1000;

  /// Indices ascend.
  void add(std::shared_ptr<const ActionPoseSample> sample);
  /// The retained set of [first, last], ascending.
  /// @throws std::invalid_argument if `last` is more than kMaxLag below the newest index.
  SharedSamples between(std::int64_t first, std::int64_t last) const;

  std::size_t size() const;
  /// Everything that is kept, in no order.
  template <class Visit>
  void for_each(Visit&& visit) const {
    for (const auto& [power, samples] : by_power_)
      for (const auto& sample : samples) visit(*sample);
  }

 private:
  /// By the power of two that divides the index; oldest first.
  std::map<int, std::deque<std::shared_ptr<const ActionPoseSample>>> by_power_;
  std::int64_t newest_ = -1;
};

/// The same of a recording, which is there at once.
std::vector<ActionPoseSample> retained(const std::vector<ActionPoseSample>& samples);

}  // namespace bodyschema
