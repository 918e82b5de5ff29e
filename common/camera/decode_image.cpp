#include "common/camera/decode_image.h"

#include <cstdint>
#include <opencv2/imgcodecs.hpp>

namespace bodyschema {

cv::Mat decode_image(const camera_image_t& image) {
  cv::Mat grey;
  // The message holds bytes of no particular type; OpenCV does not write to what it decodes.
  auto* bytes = const_cast<std::uint8_t*>(image.data.data());
  if (image.encoding == camera_image_t::ENCODING_GREY) {
    if (image.num_bytes == static_cast<std::int64_t>(image.width) * image.height) {
      grey = cv::Mat(image.height, image.width, CV_8UC1, bytes);
    }
  } else if (image.num_bytes > 0) {
    try {
      grey = cv::imdecode(cv::Mat(1, image.num_bytes, CV_8UC1, bytes), cv::IMREAD_GRAYSCALE);
    } catch (const cv::Exception&) {
      return {};
    }
  }
  if (grey.cols != image.width || grey.rows != image.height) return {};
  return grey;
}

}  // namespace bodyschema
