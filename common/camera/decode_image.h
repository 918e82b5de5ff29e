#pragma once

#include <opencv2/core.hpp>

#include "bodyschema/camera_image_t.hpp"

namespace bodyschema {

/// The frame as 8-bit grey pixels, image.height rows of image.width; where it travels uncompressed
/// they are the message's own memory. Empty if the bytes are no such image.
cv::Mat decode_image(const camera_image_t& image);

}  // namespace bodyschema
