#include "common/scene/tag_bitmap.h"

#include <apriltag/apriltag.h>
#include <apriltag/tag36h11.h>

#include <memory>
#include <opencv2/imgproc.hpp>
#include <stdexcept>
#include <string>

namespace bodyschema {

cv::Mat tag_bitmap(int tag_id, int texels_per_cell) {
  const std::unique_ptr<apriltag_family_t, decltype(&tag36h11_destroy)> family(tag36h11_create(),
                                                                               tag36h11_destroy);
  if (tag_id < 0 || tag_id >= static_cast<int>(family->ncodes)) {
    throw std::out_of_range("tag36h11 has no tag " + std::to_string(tag_id));
  }
  // image_u8_destroy is in another library; the buffer was made by calloc.
  image_u8_t* cells = apriltag_to_image(family.get(), tag_id);
  cv::Mat bitmap;
  cv::resize(cv::Mat(cells->height, cells->width, CV_8UC1, cells->buf, cells->stride), bitmap, {},
             texels_per_cell, texels_per_cell, cv::INTER_NEAREST);
  free(cells->buf);
  free(cells);
  return bitmap;
}

}  // namespace bodyschema
