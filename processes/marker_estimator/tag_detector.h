#pragma once

#include <Eigen/Core>
#include <map>
#include <memory>
#include <opencv2/core.hpp>
#include <string>
#include <vector>

#include "processes/marker_estimator/corner_refinement.h"

namespace bodyschema {

/// A tag that was found in an image.
struct TagDetection {
  int id = 0;
  /// Pixel-centre convention (OpenCV), order (−,+) (+,+) (+,−) (−,−) in the marker's frame M.
  std::vector<Eigen::Vector2d> corners_px;
  double decision_margin = 0;
  int hamming = 0;
  /// Contrast of the black border to the white margin at the worst of its four sides: that side's
  /// 5 % quantile of white − black, relative to the median over the whole border. Near
  /// 1 for a free tag; low or negative if something covers the border or the margin, and −1
  /// if the margin is cut off by the image's edge.
  double border_contrast = 0;
};

/// AprilTag's detector and its memory. One object per thread; detect() is deterministic.
class TagDetector {
 public:
  /// `max_hamming`: bits corrected, 0 … 2. `min_white_black_difference`: [grey levels], below it a
  /// region has no edges; 20 keeps sensor noise from becoming thousands of candidate quads.
  /// @throws std::invalid_argument if the family is unknown.
  TagDetector(const std::string& family, int max_hamming, int min_white_black_difference);
  ~TagDetector();
  TagDetector(const TagDetector&) = delete;
  TagDetector& operator=(const TagDetector&) = delete;

  /// Tags in an 8-bit grey image, by ascending id, those with one id by descending decision margin.
  /// @throws std::invalid_argument if the image is not 8-bit grey or a side is
  /// shorter than kMinSide_px (AprilTag reads outside of smaller images).
  std::vector<TagDetection> detect(const cv::Mat& grey);

  /// The tag as it is printed. @throws std::out_of_range if the family has no such tag.
  const TagCells& cells(int id);

  static constexpr int kMinSide_px = 32;

 private:
  struct AprilTag;
  std::unique_ptr<AprilTag> april_tag_;
  std::map<int, TagCells> cells_;  ///< those asked for so far
};

}  // namespace bodyschema
