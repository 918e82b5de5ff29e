#pragma once

#include <array>
#include <cstdint>
#include <opencv2/core/mat.hpp>
#include <vector>

namespace bodyschema {

/// Looks up an image at fixed places by the polynomials through 8 × 8 pixels, to 1/2048 px. An edge
/// with a blur of 0.8 px is moved by at most 0.003 px; the cubic of cv::remap moves it by 0.02 px,
/// and its places are rounded to 1/32 px.
class ImageLookup {
 public:
  /// Nothing to look up.
  ImageLookup() = default;
  /// `u`, `v`: CV_64FC1, the places [px] for each pixel of the result, at least 3 px inside of an
  /// image of `width` × `height`. @throws std::invalid_argument if one is not.
  ImageLookup(const cv::Mat& u, const cv::Mat& v, int width, int height);

  bool empty() const { return places_.empty(); }
  /// `image`: CV_32FC1 of that size. The result has the size of `u`.
  cv::Mat operator()(const cv::Mat& image) const;

 private:
  static constexpr int kTaps = 8;
  static constexpr int kPhases = 1024;

  struct Place {
    std::int32_t first;  ///< index of the upper left of the 8 × 8 pixels
    std::uint16_t phase_u, phase_v;
  };

  std::array<std::array<float, kTaps>, kPhases + 1> weights_{};
  std::vector<Place> places_;
  int rows_ = 0, cols_ = 0, width_ = 0, height_ = 0;
};

}  // namespace bodyschema
