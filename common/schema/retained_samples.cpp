#include "common/schema/retained_samples.h"

#include <algorithm>
#include <bit>
#include <iterator>
#include <stdexcept>
#include <string>

namespace bodyschema {
namespace {

// 0 is a multiple of all of them.
constexpr int kPowerOfZero = 62;

int power_of(std::int64_t index) {
  return index == 0 ? kPowerOfZero : std::countr_zero(static_cast<std::uint64_t>(index));
}

}  // namespace

std::int64_t retained_stride(std::int64_t first, std::int64_t last) {
  std::int64_t stride = 1;
  while (last / stride - (first + stride - 1) / stride >= kMostRetained) stride *= 2;
  return stride;
}

void RetainedSamples::add(std::shared_ptr<const ActionPoseSample> sample) {
  newest_ = sample->sample_index;
  by_power_[power_of(newest_)].push_back(std::move(sample));
  // A stride never reaches back farther than this: from there on the next larger one is enough.
  for (auto& [power, samples] : by_power_) {
    if (power == kPowerOfZero) continue;
    const std::int64_t oldest = newest_ - kMaxLag - (kMostRetained << power);
    while (!samples.empty() && samples.front()->sample_index < oldest) samples.pop_front();
  }
}

SharedSamples RetainedSamples::between(std::int64_t first, std::int64_t last) const {
  if (last < newest_ - kMaxLag)
    throw std::invalid_argument("samples up to " + std::to_string(last) +
                                " are not retained any more");
  const int power = std::countr_zero(static_cast<std::uint64_t>(retained_stride(first, last)));
  SharedSamples result;
  for (auto of = by_power_.lower_bound(power); of != by_power_.end(); ++of)
    for (const auto& sample : of->second)
      if (sample->sample_index >= first && sample->sample_index <= last) result.push_back(sample);
  std::sort(result.begin(), result.end(),
            [](const auto& a, const auto& b) { return a->sample_index < b->sample_index; });
  return result;
}

std::size_t RetainedSamples::size() const {
  std::size_t size = 0;
  for (const auto& [power, samples] : by_power_) size += samples.size();
  return size;
}

std::vector<ActionPoseSample> retained(const std::vector<ActionPoseSample>& samples) {
  if (samples.empty()) return {};
  const std::int64_t stride = retained_stride(0, samples.back().sample_index);
  std::vector<ActionPoseSample> result;
  std::copy_if(samples.begin(), samples.end(), std::back_inserter(result),
               [stride](const auto& sample) { return sample.sample_index % stride == 0; });
  return result;
}

}  // namespace bodyschema
