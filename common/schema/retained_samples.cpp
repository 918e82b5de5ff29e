#include "common/schema/retained_samples.h"

#include <algorithm>
#include <bit>
#include <iterator>
#include <stdexcept>
#include <string>

namespace bodyschema {
int retained_power(std::int64_t index) {
  constexpr int kPowerOfZero = 62;
  return index == 0 ? kPowerOfZero : std::countr_zero(static_cast<std::uint64_t>(index));
}

std::int64_t retained_stride(std::int64_t first, std::int64_t last) {
  std::int64_t stride = 1;
  while (last / stride - (first + stride - 1) / stride >= kMostRetained) stride *= 2;
  return stride;
}

void require_retained(std::int64_t last, std::int64_t newest, std::int64_t max_lag) {
  if (last < newest - max_lag)
    throw std::invalid_argument("samples up to " + std::to_string(last) +
                                " are not retained any more");
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
