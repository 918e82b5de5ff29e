#include "processes/marker_estimator/tag_detector.h"

#include <apriltag/apriltag.h>
#include <apriltag/tag25h9.h>
#include <apriltag/tag36h11.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <limits>
#include <opencv2/imgproc.hpp>
#include <optional>
#include <stdexcept>

namespace bodyschema {
namespace {

using FamilyPtr = std::unique_ptr<apriltag_family_t, void (*)(apriltag_family_t*)>;
using DetectorPtr = std::unique_ptr<apriltag_detector_t, void (*)(apriltag_detector_t*)>;
using DetectionsPtr = std::unique_ptr<zarray_t, void (*)(zarray_t*)>;

FamilyPtr make_family(const std::string& name) {
  if (name == "tag36h11") return {tag36h11_create(), tag36h11_destroy};
  if (name == "tag25h9") return {tag25h9_create(), tag25h9_destroy};
  throw std::invalid_argument("AprilTag family '" + name + "' is none of: tag36h11, tag25h9");
}

double grey_at(const cv::Mat& image, double x, double y) {
  const int x0 = static_cast<int>(std::floor(x)), y0 = static_cast<int>(std::floor(y));
  const double a = x - x0, b = y - y0;
  const uchar* upper = image.ptr<uchar>(y0) + x0;
  const uchar* lower = image.ptr<uchar>(y0 + 1) + x0;
  return (1 - b) * ((1 - a) * upper[0] + a * upper[1]) + b * ((1 - a) * lower[0] + a * lower[1]);
}

/// See TagDetection::border_contrast. `cell`: width of a cell where the black square is [−1, 1]².
double border_contrast(const cv::Mat& image, const std::vector<Eigen::Vector2d>& corners_px,
                       double cell) {
  const cv::Point2f square[4] = {{-1, 1}, {1, 1}, {1, -1}, {-1, -1}};
  cv::Point2f corners[4];
  for (int i = 0; i < 4; ++i) {
    corners[i] =
        cv::Point2f(static_cast<float>(corners_px[i].x()), static_cast<float>(corners_px[i].y()));
  }
  const cv::Matx33d H(cv::getPerspectiveTransform(square, corners));
  const auto grey = [&](double x, double y) -> std::optional<double> {
    const cv::Vec3d p = H * cv::Vec3d(x, y, 1);
    const double u = p[0] / p[2], v = p[1] / p[2];
    if (!(u >= 0 && v >= 0 && u < image.cols - 1 && v < image.rows - 1)) return std::nullopt;
    return grey_at(image, u, v);
  };
  constexpr int kPlaces = 20;
  std::vector<double> all;
  double worst = std::numeric_limits<double>::max();
  for (int side = 0; side < 4; ++side) {
    std::vector<double> contrasts;
    for (int i = 0; i < kPlaces; ++i) {
      const double along = (i + 0.5) / kPlaces * 2 - 1;
      const double out = 1 + cell / 2, in = 1 - cell / 2;
      const double sign = side < 2 ? 1 : -1;
      const auto white = side % 2 ? grey(sign * out, along) : grey(along, sign * out);
      const auto black = side % 2 ? grey(sign * in, along) : grey(along, sign * in);
      if (!white || !black) return -1;
      contrasts.push_back(*white - *black);
    }
    all.insert(all.end(), contrasts.begin(), contrasts.end());
    const auto quantile = contrasts.begin() + kPlaces / 20;
    std::nth_element(contrasts.begin(), quantile, contrasts.end());
    worst = std::min(worst, *quantile);
  }
  const auto median = all.begin() + static_cast<std::ptrdiff_t>(all.size() / 2);
  std::nth_element(all.begin(), median, all.end());
  return *median > 0 ? std::clamp(worst / *median, -1.0, 1.0) : -1;
}

}  // namespace

struct TagDetector::AprilTag {
  FamilyPtr family;
  DetectorPtr detector;  // after the family: it refers to it, so it goes first
};

TagDetector::TagDetector(const std::string& family, int max_hamming,
                         int min_white_black_difference) {
  april_tag_ = std::make_unique<AprilTag>(AprilTag{
      make_family(family), DetectorPtr(apriltag_detector_create(), apriltag_detector_destroy)});
  apriltag_detector_t& detector = *april_tag_->detector;
  apriltag_detector_add_family_bits(&detector, april_tag_->family.get(), max_hamming);
  // One thread: with more, the order of detections varies and the worker pool may crash. Full
  // resolution: decimation costs corner accuracy. A blur (quad_sigma) would overwrite our image.
  detector.nthreads = 1;
  detector.quad_decimate = 1;
  detector.quad_sigma = 0;
  detector.refine_edges = true;
  detector.qtp.min_white_black_diff = min_white_black_difference;
}

TagDetector::~TagDetector() = default;

std::vector<TagDetection> TagDetector::detect(const cv::Mat& grey) {
  if (grey.type() != CV_8UC1 || grey.cols < kMinSide_px || grey.rows < kMinSide_px) {
    throw std::invalid_argument("AprilTag needs an 8-bit grey image of at least 32 × 32 px");
  }
  // With decimation 1 and no blur the detector only reads.
  image_u8_t image{grey.cols, grey.rows, static_cast<int32_t>(grey.step), grey.data};
  const DetectionsPtr found(apriltag_detector_detect(april_tag_->detector.get(), &image),
                            apriltag_detections_destroy);
  std::vector<TagDetection> detections;
  for (int i = 0; i < zarray_size(found.get()); ++i) {
    apriltag_detection_t* raw = nullptr;
    zarray_get(found.get(), i, &raw);
    TagDetection detection{raw->id, {}, raw->decision_margin, raw->hamming, 0};
    for (int c = 0; c < 4; ++c) {
      // AprilTag's origin is the corner of the upper left pixel, ours its centre.
      detection.corners_px.emplace_back(raw->p[c][0] - 0.5, raw->p[c][1] - 0.5);
    }
    const double cell = 2.0 / april_tag_->family->width_at_border;
    detection.border_contrast = border_contrast(grey, detection.corners_px, cell);
    detections.push_back(detection);
  }
  std::sort(detections.begin(), detections.end(), [](const auto& a, const auto& b) {
    return a.id != b.id ? a.id < b.id : a.decision_margin > b.decision_margin;
  });
  return detections;
}

const TagCells& TagDetector::cells(int id) {
  const auto known = cells_.find(id);
  if (known != cells_.end()) return known->second;
  apriltag_family_t* family = april_tag_->family.get();
  if (id < 0 || id >= static_cast<int>(family->ncodes)) {
    throw std::out_of_range("the family has no tag " + std::to_string(id));
  }
  // image_u8_destroy is in another library; the buffer was made by calloc.
  image_u8_t* picture = apriltag_to_image(family, id);
  TagCells cells{picture->width, family->width_at_border, {}};
  for (int row = 0; row < picture->height; ++row) {
    for (int column = 0; column < picture->width; ++column) {
      cells.is_white.push_back(picture->buf[row * picture->stride + column] > 127);
    }
  }
  free(picture->buf);
  free(picture);
  return cells_.emplace(id, std::move(cells)).first->second;
}

}  // namespace bodyschema
