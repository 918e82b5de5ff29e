#pragma once

#include <cstdint>
#include <deque>
#include <filesystem>
#include <map>
#include <optional>
#include <string>
#include <utility>

#include "bodyschema/camera_image_t.hpp"
#include "bodyschema/camera_info_t.hpp"
#include "bodyschema/marker_poses_t.hpp"
#include "common/camera/fit_pose.h"
#include "common/config/rig.h"
#include "processes/marker_estimator/tag_detector.h"

namespace bodyschema {

struct MarkerEstimatorConfig {
  bool every_image = true;  ///< false: only the newest image waiting (a live camera faster than we)
  CornerNoise noise;        ///< of AprilTag's corners, where they cannot be refined
  int max_hamming = 0;      ///< corrected bits
  double min_decision_margin = 0;        ///< AprilTag's, grey levels
  int min_white_black_difference = 0;    ///< grey levels
  double min_border_contrast = 0;        ///< see TagDetection::border_contrast
  double min_side_px = 0;                ///< shortest side of the black square in the image
  double max_reprojection_error_px = 0;  ///< rms of the better hypothesis
  double max_tilt_rad = 0;               ///< between the line of sight and the marker's normal

  /// Reads marker_estimator.yaml. @throws ConfigError.
  static MarkerEstimatorConfig load(const std::filesystem::path& file);
};

/// Finds the rig's tags in an image and estimates their poses X_CM in the camera's frame: both
/// hypotheses of a planar marker, each refined to its local minimum, and the covariance of the
/// better one. Corners are fitted to the grey values of the tag (refine_corners()), whose residuals
/// give their noise; if that is refused, AprilTag's corners replace them, with the configured noise
/// and what blur or a cover adds. It knows ids and sizes, not the parts that carry the markers. If
/// several tags have one id, the one with the largest decision margin counts among those that pass
/// all gates.
///
/// Before the first CAMERA_INFO it answers nothing, since pixels mean no poses yet. Afterwards it
/// answers every readable image of the calibrated size, with an empty list if no marker is seen. An
/// image that cannot be read, has another size or is another camera's is refused and counted. A
/// repeated image gets the same answer again without detection. When images stop, so do the
/// answers.
class MarkerEstimator {
 public:
  /// `calibration_id`: of the rig; 0: unknown.
  MarkerEstimator(const MarkerEstimatorConfig& config, Markers markers,
                  std::int64_t calibration_id = 0);

  /// A senseless calibration is refused and counted; the last good one stays.
  void on_camera_info(const camera_info_t& info);
  std::optional<marker_poses_t> on_camera_image(const camera_image_t& image);

  /// False while it waits for the calibration or the first image, or refuses what it gets.
  bool is_working() const { return lens_ && num_images_ > 0 && refused_.empty(); }
  /// Activity for people.
  std::string activity() const;
  /// Reason → number of refused images and tags since the start.
  const std::map<std::string, std::int64_t>& counters() const { return counters_; }

 private:
  std::optional<cv::Mat> decode(const camera_image_t& image);
  std::optional<marker_pose_t> estimate(const cv::Mat& grey, const TagDetection& detection,
                                        double size_m);

  const MarkerEstimatorConfig config_;
  const Markers markers_;
  const std::int64_t calibration_id_;
  TagDetector detector_;
  std::optional<Lens> lens_;
  camera_info_t info_{};                                            ///< lens_ is made of it
  std::deque<std::pair<camera_image_t, marker_poses_t>> answered_;  ///< the newest, under info_
  std::map<std::string, std::int64_t> counters_;
  std::string refused_;  ///< why the newest image was refused; empty: it was not
  std::int64_t num_images_ = 0;
  int num_seen_ = 0;  ///< markers in the newest image
};

}  // namespace bodyschema
