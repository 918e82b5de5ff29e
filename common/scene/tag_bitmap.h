#pragma once

#include <opencv2/core/mat.hpp>

namespace bodyschema {

/// Printed tag `tag_id` of family tag36h11 with its white margin: 10×10 cells of
/// `texels_per_cell`, upright (row 0 is the tag's upper edge), values 0 and 255.
/// @throws std::out_of_range if the family has no such tag.
cv::Mat tag_bitmap(int tag_id, int texels_per_cell);

}  // namespace bodyschema
