#include "common/scene/image_lookup.h"

#include <gtest/gtest.h>

#include <cmath>
#include <stdexcept>

namespace bodyschema {
namespace {

constexpr int kSide = 256;

/// An edge with a blur of 0.8 px.
double edge(double x, double y) {
  return 128 + 90 * std::erf((0.96 * (x - 128) - 0.28 * (y - 128)) / (0.8 * M_SQRT2));
}

cv::Mat image_of_edge() {
  cv::Mat image(kSide, kSide, CV_32FC1);
  for (int y = 0; y < kSide; ++y)
    for (int x = 0; x < kSide; ++x) image.at<float>(y, x) = static_cast<float>(edge(x, y));
  return image;
}

/// Places (x + shift, y) for the pixels 4 … 251.
ImageLookup shifted(double shift) {
  cv::Mat u(kSide - 8, kSide - 8, CV_64FC1), v(kSide - 8, kSide - 8, CV_64FC1);
  for (int y = 0; y < u.rows; ++y)
    for (int x = 0; x < u.cols; ++x) {
      u.at<double>(y, x) = x + 4 + shift;
      v.at<double>(y, x) = y + 4;
    }
  return {u, v, kSide, kSide};
}

TEST(ImageLookup, MovesAnEdgeByThousandthsOfAPixel) {
  for (const double shift : {0.1, 0.2, -0.3, 0.4, 0.65, 0.9}) {
    const cv::Mat moved = shifted(shift)(image_of_edge());
    double numerator = 0, denominator = 0;
    for (int y = 0; y < moved.rows; ++y)
      for (int x = 0; x < moved.cols; ++x) {
        const double slope = edge(x + 4.5, y + 4) - edge(x + 3.5, y + 4);
        // Against an exactly moved image: the remaining difference is a shift along the slope.
        numerator += slope * (moved.at<float>(y, x) - edge(x + 4 + shift, y + 4));
        denominator += slope * slope;
      }
    EXPECT_NEAR(numerator / denominator, 0, 0.003) << shift;
  }
}

TEST(ImageLookup, OfThePixelsThemselvesIsTheImage) {
  const cv::Mat image = image_of_edge();
  const cv::Mat same = shifted(0)(image);
  for (int y = 0; y < same.rows; ++y)
    for (int x = 0; x < same.cols; ++x)
      ASSERT_NEAR(same.at<float>(y, x), image.at<float>(y + 4, x + 4), 1e-4);
}

TEST(ImageLookup, RefusesAPlaceOutsideOfTheImage) {
  EXPECT_THROW(shifted(2.5), std::invalid_argument);
  EXPECT_THROW(shifted(NAN), std::invalid_argument);
  EXPECT_TRUE(ImageLookup().empty());
}

}  // namespace
}  // namespace bodyschema
