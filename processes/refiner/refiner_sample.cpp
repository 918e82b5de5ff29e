#include "processes/refiner/refiner_sample.h"

#include <map>

#include "common/bus/convert.h"

namespace bodyschema {

RefinerSample refiner_sample(const sample_t& message) {
  return {from_message(message), tag_sights(message)};
}

std::vector<RefinerSample> refiner_samples(const std::vector<ActionPoseSample>& samples) {
  std::vector<RefinerSample> result;
  for (const ActionPoseSample& sample : samples) result.push_back({sample, {}});
  return result;
}

std::vector<RefinerSample> refiner_samples(const std::vector<sample_t>& messages) {
  std::map<std::int64_t, const sample_t*> by_index;
  for (const sample_t& message : messages) by_index.try_emplace(message.sample_index, &message);
  std::vector<RefinerSample> result;
  for (const auto& [index, message] : by_index) result.push_back(refiner_sample(*message));
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
