#include "common/scene/image_lookup.h"

#include <cmath>
#include <opencv2/core.hpp>
#include <stdexcept>

namespace bodyschema {
namespace {

constexpr int kBefore = 3, kAfter = 4;  // pixels beside the place, each way

}  // namespace

ImageLookup::ImageLookup(const cv::Mat& u, const cv::Mat& v, int width, int height)
    : rows_(u.rows), cols_(u.cols), width_(width), height_(height) {
  for (int p = 0; p <= kPhases; ++p) {
    // Lagrange's, through the pixels at −3 … 4.
    const double t = static_cast<double>(p) / kPhases + kBefore;
    for (int i = 0; i < kTaps; ++i) {
      double weight = 1;
      for (int j = 0; j < kTaps; ++j)
        if (j != i) weight *= (t - j) / (i - j);
      weights_[p][i] = static_cast<float>(weight);
    }
  }
  places_.reserve(u.total());
  for (int row = 0; row < rows_; ++row) {
    for (int column = 0; column < cols_; ++column) {
      const double x = u.at<double>(row, column), y = v.at<double>(row, column);
      const double left = std::floor(x), top = std::floor(y);
      if (!(left >= kBefore && top >= kBefore && left + kAfter < width && top + kAfter < height))
        throw std::invalid_argument("a place outside of the image is looked up");
      places_.push_back(
          {(static_cast<int>(top) - kBefore) * width + static_cast<int>(left) - kBefore,
           static_cast<std::uint16_t>(std::lround((x - left) * kPhases)),
           static_cast<std::uint16_t>(std::lround((y - top) * kPhases))});
    }
  }
}

cv::Mat ImageLookup::operator()(const cv::Mat& image) const {
  CV_Assert(image.type() == CV_32FC1 && image.cols == width_ && image.rows == height_ &&
            image.isContinuous());
  cv::Mat result(rows_, cols_, CV_32FC1);
  float* out = result.ptr<float>();
  for (const Place& place : places_) {
    const float* pixel = image.ptr<float>() + place.first;
    const auto& wu = weights_[place.phase_u];
    const auto& wv = weights_[place.phase_v];
    std::array<float, kTaps> columns{};
    for (int row = 0; row < kTaps; ++row, pixel += width_)
      for (int column = 0; column < kTaps; ++column) columns[column] += wv[row] * pixel[column];
    float sum = 0;
    for (int column = 0; column < kTaps; ++column) sum += wu[column] * columns[column];
    *out++ = sum;
  }
  return result;
}

}  // namespace bodyschema
