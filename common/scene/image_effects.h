#pragma once

#include <array>
#include <cstdint>
#include <opencv2/core/mat.hpp>

namespace bodyschema {

/// Effects of a real camera on a clean picture.
struct ImageEffects {
  double blur_sd_px = 0.7;  ///< Gaussian blur of the lens [px]; 0: none
  double noise_sd = 2;      ///< Gaussian noise of the sensor [grey levels]; 0: none
  int pixel_samples = 1;    ///< along each side of a pixel, whose value is their mean; 1 to 8
  bool shadows = false;     ///< for pictures that people look at; three times slower
};

/// A sensor with Gaussian noise, and the rounding to whole grey levels behind it. The noise of a
/// pixel is a function of (seed, action_id, frame, pixel) alone: a counter-based generator, no
/// state.
class SensorNoise {
 public:
  explicit SensorNoise(double sd);
  /// CV_8UC1 of a CV_32FC1 in grey levels. @throws std::invalid_argument on another type.
  cv::Mat read(const cv::Mat& image, std::int64_t seed, std::int64_t action_id,
               std::int64_t frame) const;

 private:
  // Quantiles of the distribution: a uniform index makes a Gaussian value.
  std::array<float, 4096> quantiles_{};
};

}  // namespace bodyschema
