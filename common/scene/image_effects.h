#pragma once

#include <array>
#include <cstdint>
#include <opencv2/core/mat.hpp>

namespace bodyschema {

/// Effects of a real camera on a clean picture.
struct ImageEffects {
  double blur_sd_px = 0.7;  ///< Gaussian blur of lens and pixel [px]; 0: none
  double noise_sd = 2;      ///< Gaussian noise of the sensor [grey levels]; 0: none
  int msaa_samples = 0;     ///< samples a pixel for the outlines of solids: 0, 2, 4 …
  bool shadows = false;     ///< for pictures that people look at; three times slower
};

/// Adds Gaussian noise, rounded to whole grey levels. The noise of a pixel is a function of (seed,
/// action_id, frame, pixel) alone: a counter-based generator, no state.
class SensorNoise {
 public:
  explicit SensorNoise(double sd);
  void add(cv::Mat& image, std::int64_t seed, std::int64_t action_id, std::int64_t frame) const;

 private:
  double sd_;
  // Quantiles of the distribution: a uniform index makes a Gaussian value.
  std::array<std::int8_t, 4096> quantiles_;
};

}  // namespace bodyschema
