#include "processes/refiner/refiner_sample.h"

#include "common/bus/convert.h"

namespace bodyschema {

RefinerSample refiner_sample(const sample_t& message) {
  return {from_message(message), tag_sights(message)};
}

std::vector<RefinerSample> refiner_samples(const std::vector<ActionPoseSample>& samples,
                                           const std::vector<std::vector<TagSight>>& sights) {
  std::vector<RefinerSample> result;
  for (const ActionPoseSample& sample : samples) {
    result.push_back({sample, {}});
    if (!sights.empty())
      result.back().tags = sights.at(static_cast<std::size_t>(sample.sample_index));
  }
  return result;
}

std::vector<RefinerSample> thinned(std::vector<RefinerSample> samples, std::size_t most) {
  if (samples.size() <= most) return samples;
  std::vector<RefinerSample> result;
  for (std::size_t n = 0; n < most; ++n)
    result.push_back(std::move(samples[n * samples.size() / most]));
  return result;
}

}  // namespace bodyschema
