#include "processes/marker_estimator/marker_estimator.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "common/bus/convert.h"
#include "common/camera/decode_image.h"
#include "common/config/yaml.h"
#include "common/geometry/angle.h"
#include "processes/marker_estimator/tag_pose.h"

namespace bodyschema {
namespace {

/// As many as a simulated action has frames (camera.yaml allows 100; more are detected again).
constexpr std::size_t kMaxAnswered = 16;

template <class Message>
std::vector<std::uint8_t> bytes_of(const Message& message) {
  std::vector<std::uint8_t> bytes(static_cast<std::size_t>(message.getEncodedSize()));
  message.encode(bytes.data(), 0, static_cast<int>(bytes.size()));
  return bytes;
}

bool is_same(const camera_image_t& a, const camera_image_t& b) {
  return a.utime == b.utime && a.image_seq == b.image_seq && a.width == b.width &&
         a.height == b.height && a.encoding == b.encoding && a.data == b.data;
}

}  // namespace

MarkerEstimatorConfig MarkerEstimatorConfig::load(const std::filesystem::path& file) {
  const Yaml yaml = Yaml::load(file);
  MarkerEstimatorConfig config;
  config.every_image = yaml.boolean("every_image");
  const RigNoise noise = load_noise(file.parent_path());
  config.noise = {noise.corner_noise_px, noise.small_tag_noise_px};
  config.max_hamming = static_cast<int>(yaml.integer("max_hamming", 0, 2));
  config.min_decision_margin = yaml.number("min_decision_margin", 0, 255);
  config.min_white_black_difference =
      static_cast<int>(yaml.integer("min_white_black_difference", 1, 255));
  config.min_border_contrast = yaml.number("min_border_contrast", 0, 1);
  config.min_side_px = yaml.number("min_side_px", 0, 10000);
  config.max_reprojection_error_px = yaml.number("max_reprojection_error_px", 1e-3, 100);
  config.max_tilt_rad = yaml.number("max_tilt_deg", 0, 90) * kDegree;
  yaml.finish();
  return config;
}

MarkerEstimator::MarkerEstimator(const MarkerEstimatorConfig& config, Markers markers,
                                 std::int64_t calibration_id)
    : config_(config),
      markers_(std::move(markers)),
      calibration_id_(calibration_id),
      detector_(markers_.family, config.max_hamming, config.min_white_black_difference) {}

void MarkerEstimator::on_camera_info(const camera_info_t& info) {
  // It is repeated at 1 Hz; only its time differs then.
  camera_info_t timeless = info;
  timeless.utime = 0;
  if (lens_ && bytes_of(timeless) == bytes_of(info_)) return;
  try {
    lens_ = Lens(info);
    info_ = timeless;
    answered_.clear();
  } catch (const std::invalid_argument&) {
    ++counters_["refused CAMERA_INFO"];
  }
}

std::optional<cv::Mat> MarkerEstimator::decode(const camera_image_t& image) {
  const cv::Mat grey = decode_image(image);
  if (grey.empty()) {
    ++counters_["image unreadable"];
    refused_ = "the image cannot be decoded";
    return std::nullopt;
  }
  if (grey.cols != lens_->width() || grey.rows != lens_->height()) {
    ++counters_["image not of the calibrated size"];
    refused_ = "the image is " + std::to_string(grey.cols) + "×" + std::to_string(grey.rows) +
               " px but the calibration holds for " + std::to_string(lens_->width()) + "×" +
               std::to_string(lens_->height());
    return std::nullopt;
  }
  if (std::min(grey.cols, grey.rows) < TagDetector::kMinSide_px) {
    ++counters_["image too small"];
    refused_ = "the image is too small for a tag";
    return std::nullopt;
  }
  refused_.clear();
  return grey;
}

std::optional<marker_poses_t> MarkerEstimator::on_camera_image(const camera_image_t& image) {
  if (!lens_) {
    ++counters_["image before CAMERA_INFO"];
    return std::nullopt;
  }
  if (image.camera_name != info_.camera_name) {
    ++counters_["image of another camera"];
    return std::nullopt;
  }
  for (const auto& [answered, poses] : answered_) {
    if (!is_same(answered, image)) continue;
    ++counters_["image repeated"];
    refused_.clear();
    num_seen_ = poses.num_markers;
    return poses;
  }
  const auto grey = decode(image);
  if (!grey) return std::nullopt;
  ++num_images_;
  std::vector<marker_pose_t> markers;
  for (const TagDetection& detection : detector_.detect(*grey)) {
    const std::optional<double> size_m = markers_.size_m(detection.id);
    if (!size_m) {
      ++counters_["tag not in markers.yaml"];
      continue;
    }
    if (!markers.empty() && markers.back().marker_id == detection.id) {
      ++counters_["tag seen twice"];
      continue;
    }
    if (const auto marker = estimate(*grey, detection, *size_m)) markers.push_back(*marker);
  }
  marker_poses_t poses;
  poses.utime = image.utime;
  poses.image_seq = image.image_seq;
  poses.camera_name = image.camera_name;
  poses.calibration_id = calibration_id_;
  set_array(poses.num_markers, poses.markers, std::move(markers));
  num_seen_ = poses.num_markers;
  if (answered_.size() < kMaxAnswered) {
    answered_.emplace_back(image, poses);
  } else {
    // The memory of the oldest is used again: an image is megabytes.
    std::rotate(answered_.begin(), answered_.begin() + 1, answered_.end());
    answered_.back().first = image;
    answered_.back().second = poses;
  }
  return poses;
}

namespace {

/// What is known of a marker before its pose.
marker_pose_t marker_seen(const TagDetection& detection, double size_m,
                          const std::vector<Eigen::Vector2d>& corners_px,
                          const Matrix8d& covariance_px2) {
  marker_pose_t marker;
  marker.marker_id = detection.id;
  marker.size_m = size_m;
  for (int i = 0; i < 4; ++i) {
    marker.corner_px[i][0] = corners_px[i].x();
    marker.corner_px[i][1] = corners_px[i].y();
  }
  to_message(covariance_px2, marker.corner_covariance);
  marker.decision_margin = detection.decision_margin;
  marker.hamming = static_cast<std::int8_t>(detection.hamming);
  return marker;
}

}  // namespace

std::optional<marker_pose_t> MarkerEstimator::estimate(const cv::Mat& grey,
                                                       const TagDetection& detection,
                                                       double size_m) {
  const auto refuse = [&](const char* why) {
    ++counters_[why];
    return std::nullopt;
  };
  if (detection.decision_margin < config_.min_decision_margin) return refuse("tag unclear");
  if (detection.border_contrast < config_.min_border_contrast) return refuse("tag half covered");
  std::vector<ImagePoint> corners;
  if (shortest_side_px(detection.corners_px) < config_.min_side_px) return refuse("tag too small");
  std::vector<Eigen::Vector2d> corners_px = detection.corners_px;
  Matrix8d covariance_px2;
  const TagCells& cells = detector_.cells(detection.id);
  const CornerRefinement refinement = refine_corners(grey, *lens_, cells, corners_px);
  if (refinement.corners) {
    corners_px = refinement.corners->corners_px;
    covariance_px2 = refinement.corners->covariance_px2;
  } else {
    covariance_px2 = detected_covariance_px2(config_.noise, cells, corners_px, refinement);
    ++counters_[std::string("corners not refined: ") + name_of(refinement.refusal)];
  }
  const double sigma = sigma_px(covariance_px2);
  const Eigen::MatrixXd whitener = whitener_of(covariance_px2);
  for (const Eigen::Vector2d& p_px : corners_px) {
    const auto corner = lens_->straighten(p_px);
    if (!corner) return refuse("tag outside of the lens model");
    corners.push_back(*corner);
    corners.back().sigma_px = sigma;
  }
  const std::vector<PoseFit> minima = solve_tag_pose(size_m, corners, &whitener);
  if (minima.empty()) return refuse("tag without a pose");
  // In pixels, whatever weights the poses had.
  const auto error_px = [&](const PoseFit& fit) {
    const auto residual = reprojection_residual(fit.X_CB, tag_corners(size_m), corners, nullptr);
    return residual ? sigma * residual->norm() / std::sqrt(8.0)
                    : std::numeric_limits<double>::infinity();
  };
  const double least_error_px = error_px(minima[0]);
  if (!(least_error_px <= config_.max_reprojection_error_px)) return refuse("tag not square");
  if (tilt_rad(minima[0].X_CB) > config_.max_tilt_rad) return refuse("tag too steep");
  const auto covariance = covariance_from(minima[0].information);
  if (!covariance) return refuse("tag without a pose");

  marker_pose_t marker = marker_seen(detection, size_m, corners_px, covariance_px2);
  marker.num_hypotheses = static_cast<std::int8_t>(minima.size());
  for (int h = 0; h < 2; ++h) {
    const PoseFit& fit = minima[std::min<std::size_t>(h, minima.size() - 1)];
    marker.X_CM[h] = to_message(fit.X_CB);
    // The likelier pose is the first, though correlated corners may lie nearer to the other.
    marker.reprojection_error_px[h] =
        h == 0 ? least_error_px : std::max(least_error_px, error_px(fit));
  }
  to_message(*covariance, marker.covariance);
  return marker;
}

std::string MarkerEstimator::activity() const {
  if (!lens_) return "waits for CAMERA_INFO";
  if (!refused_.empty()) return "refuses images: " + refused_;
  if (num_images_ == 0) return "waits for CAMERA_IMAGE";
  return std::to_string(num_seen_) + " tags in image " + std::to_string(num_images_);
}

}  // namespace bodyschema
