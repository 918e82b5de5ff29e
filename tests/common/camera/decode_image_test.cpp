#include "common/camera/decode_image.h"

#include <gtest/gtest.h>

#include <opencv2/imgcodecs.hpp>

namespace bodyschema {
namespace {

camera_image_t ramp() {
  camera_image_t image{};
  image.width = 40;
  image.height = 30;
  image.encoding = camera_image_t::ENCODING_GREY;
  for (int i = 0; i < 40 * 30; ++i) image.data.push_back(static_cast<std::uint8_t>(i % 40 * 6));
  image.num_bytes = 40 * 30;
  return image;
}

camera_image_t encoded(std::int8_t encoding, const char* extension) {
  camera_image_t image = ramp();
  const cv::Mat grey(30, 40, CV_8U, image.data.data());
  std::vector<std::uint8_t> bytes;
  EXPECT_TRUE(cv::imencode(extension, grey, bytes));
  image.encoding = encoding;
  image.data = bytes;
  image.num_bytes = static_cast<std::int32_t>(bytes.size());
  return image;
}

TEST(DecodeImage, GreyAndPngGiveThePixelsAndJpegGivesThemNearly) {
  const camera_image_t image = ramp();
  const cv::Mat grey = decode_image(image);
  ASSERT_EQ(grey.size(), cv::Size(40, 30));
  EXPECT_EQ(grey.at<std::uint8_t>(7, 20), 120);
  const cv::Mat png = decode_image(encoded(camera_image_t::ENCODING_PNG, ".png"));
  EXPECT_EQ(cv::norm(grey, png, cv::NORM_INF), 0);
  const cv::Mat jpeg = decode_image(encoded(camera_image_t::ENCODING_JPEG, ".jpg"));
  EXPECT_LT(cv::norm(grey, jpeg, cv::NORM_INF), 10);
}

TEST(DecodeImage, BytesThatAreNoImageOfThatSizeGiveNone) {
  camera_image_t image = ramp();
  image.height = 29;
  EXPECT_TRUE(decode_image(image).empty());
  image = encoded(camera_image_t::ENCODING_PNG, ".png");
  image.width = 41;
  EXPECT_TRUE(decode_image(image).empty());
  image = encoded(camera_image_t::ENCODING_JPEG, ".jpg");
  image.data.assign(image.data.size(), 7);
  EXPECT_TRUE(decode_image(image).empty());
  image.data.clear();
  image.num_bytes = 0;
  EXPECT_TRUE(decode_image(image).empty());
}

}  // namespace
}  // namespace bodyschema
