#include "common/scene/image_effects.h"

#include <algorithm>
#include <cmath>
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

// Φ(x) of the normal distribution.
double normal_cdf(double x) { return 0.5 * std::erfc(-x / std::sqrt(2.0)); }

}  // namespace

SensorNoise::SensorNoise(double sd) : sd_(sd) {
  if (!(sd >= 0 && sd <= 30)) throw std::invalid_argument("noise_sd must be within 0 … 30");
  int level = -127;
  for (std::size_t i = 0; i < quantiles_.size(); ++i) {
    const double probability = (static_cast<double>(i) + 0.5) / quantiles_.size();
    while (sd > 0 && level < 127 && normal_cdf((level + 0.5) / sd) < probability) ++level;
    quantiles_[i] = sd > 0 ? static_cast<std::int8_t>(level) : 0;
  }
}

void SensorNoise::add(cv::Mat& image, std::int64_t seed, std::int64_t action_id,
                      std::int64_t frame) const {
  if (sd_ == 0) return;
  if (image.type() != CV_8UC1)
    throw std::invalid_argument("SensorNoise: needs an 8-bit grey image");
  const std::uint64_t key = absorb(absorb(absorb(0, seed), action_id), frame);
  std::uint64_t counter = 0;
  for (int y = 0; y < image.rows; ++y) {
    std::uint8_t* row = image.ptr<std::uint8_t>(y);
    for (int x = 0; x < image.cols; x += 5) {
      // 64 bits serve five pixels with 12 bits each.
      std::uint64_t bits = mix(key + kGolden * ++counter);
      const int end = std::min(x + 5, image.cols);
      for (int i = x; i < end; ++i, bits >>= 12) {
        row[i] = static_cast<std::uint8_t>(std::clamp(row[i] + quantiles_[bits & 4095], 0, 255));
      }
    }
  }
}

}  // namespace bodyschema
