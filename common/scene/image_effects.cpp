#include "common/scene/image_effects.h"

#include <algorithm>
#include <boost/math/distributions/normal.hpp>
#include <stdexcept>

namespace bodyschema {
namespace {

// The finaliser of SplitMix64 (Steele, Lea, Flood, OOPSLA 2014): a bijection of 64 bits that passes
// BigCrush when it is fed a counter.
std::uint64_t mix(std::uint64_t x) {
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ULL;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebULL;
  return x ^ (x >> 31);
}

constexpr std::uint64_t kGolden = 0x9e3779b97f4a7c15ULL;

std::uint64_t absorb(std::uint64_t key, std::int64_t value) {
  return mix(key * kGolden + static_cast<std::uint64_t>(value) + kGolden);
}

}  // namespace

SensorNoise::SensorNoise(double sd) {
  if (!(sd >= 0 && sd <= 30)) throw std::invalid_argument("noise_sd must be within 0 … 30");
  if (sd == 0) return;
  const boost::math::normal noise(0, sd);
  for (std::size_t i = 0; i < quantiles_.size(); ++i)
    quantiles_[i] = static_cast<float>(
        quantile(noise, (static_cast<double>(i) + 0.5) / static_cast<double>(quantiles_.size())));
}

cv::Mat SensorNoise::read(const cv::Mat& image, std::int64_t seed, std::int64_t action_id,
                          std::int64_t frame) const {
  if (image.type() != CV_32FC1)
    throw std::invalid_argument("SensorNoise: needs a grey image in single precision");
  cv::Mat result(image.size(), CV_8UC1);
  const std::uint64_t key = absorb(absorb(absorb(0, seed), action_id), frame);
  std::uint64_t counter = 0;
  for (int y = 0; y < image.rows; ++y) {
    const float* exact = image.ptr<float>(y);
    std::uint8_t* row = result.ptr<std::uint8_t>(y);
    for (int x = 0; x < image.cols; x += 5) {
      // 64 bits serve five pixels with 12 bits each.
      std::uint64_t bits = mix(key + kGolden * ++counter);
      const int end = std::min(x + 5, image.cols);
      for (int i = x; i < end; ++i, bits >>= 12)
        row[i] = cv::saturate_cast<std::uint8_t>(exact[i] + quantiles_[bits & 4095]);
    }
  }
  return result;
}

}  // namespace bodyschema
