#include "processes/marker_estimator/marker_estimator.h"

#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <algorithm>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>

#include "common/bus/check.h"
#include "common/bus/convert.h"
#include "common/geometry/angle.h"
#include "processes/marker_estimator/tag_pose.h"
#include "tests/support/tag_view.h"

namespace bodyschema {
namespace {

MarkerEstimatorConfig config() {
  MarkerEstimatorConfig config;
  config.noise = {0.05, 0.15};
  config.max_hamming = 1;
  config.min_decision_margin = 25;
  config.min_white_black_difference = 20;
  config.min_border_contrast = 0.35;
  config.min_side_px = 12;
  config.max_reprojection_error_px = 1;
  config.max_tilt_rad = 70 * kDegree;
  return config;
}

Markers markers() {
  Markers markers;
  markers.family = "tag36h11";
  for (const int id : {3, 7, 11}) markers.tags.push_back({id, 0.08, id, std::nullopt});
  markers.target_tags = {{40, 0.12}};
  return markers;
}

struct Estimator : MarkerEstimator {
  explicit Estimator(const camera_info_t& info = pinhole_camera(),
                     const MarkerEstimatorConfig& c = config())
      : MarkerEstimator(c, markers(), 99) {
    on_camera_info(info);
  }
  marker_poses_t see(const std::vector<Plate>& plates, const camera_info_t& info,
                     std::uint64_t seed = 1) {
    return on_camera_image(grey_message(render_plates(plates, info, 0.7, 2, seed))).value();
  }
  std::int64_t counted(const std::string& name) const {
    const auto entry = counters().find(name);
    return entry == counters().end() ? 0 : entry->second;
  }
};

/// The hypothesis nearer to the truth.
double best_angle(const marker_pose_t& marker, const Pose& X_CM) {
  return std::min(rotation_angle(X_CM.inverse() * from_message(marker.X_CM[0])),
                  rotation_angle(X_CM.inverse() * from_message(marker.X_CM[1])));
}

/// Something between `low` and `high` of the tag's plane [m].
void cover(cv::Mat& image, const Plate& plate, const camera_info_t& camera,
           const Eigen::Vector2d& low, const Eigen::Vector2d& high, double grey) {
  const Lens lens(camera);
  std::vector<cv::Point> outline;
  for (const auto& [x, y] : {std::pair{low.x(), low.y()},
                             {high.x(), low.y()},
                             {high.x(), high.y()},
                             {low.x(), high.y()}}) {
    const Eigen::Vector3d p_C = plate.X_CM * Eigen::Vector3d(x, y, 0);
    const Eigen::Vector2d p_px = lens.project(p_C.head<2>() / p_C.z());
    outline.emplace_back(static_cast<int>(p_px.x()), static_cast<int>(p_px.y()));
  }
  cv::fillConvexPoly(image, outline, cv::Scalar(grey));
}

/// Something dark over half of the margin's left side: the code stays readable.
void cover_half_a_side(cv::Mat& image, const Plate& plate) {
  cover(image, plate, pinhole_camera(), {-0.06, -0.06}, {-0.042, 0.0}, 50);
  cv::GaussianBlur(image, image, {0, 0}, 0.7);
}

TEST(MarkerEstimator, PinsTheMarkerFrameXRightYDownZIntoTheMarker) {
  Estimator estimator;
  Plate plate{7, 0.08, Pose::Identity()};
  plate.X_CM.translation() = Eigen::Vector3d(0.05, -0.03, 0.5);
  const auto poses = estimator.see({plate}, pinhole_camera());
  ASSERT_EQ(poses.num_markers, 1);
  const marker_pose_t& marker = poses.markers[0];
  EXPECT_EQ(marker.marker_id, 7);
  // Upright and facing the camera: corner 0 is (−,+), that is, lower left in the image.
  EXPECT_LT(marker.corner_px[0][0], marker.corner_px[1][0]);
  EXPECT_GT(marker.corner_px[0][1], marker.corner_px[3][1]);
  // Edges along the pixel grid are AprilTag's worst case: 0.2 px. A wrong convention would be
  // 0.5.
  EXPECT_NEAR(marker.corner_px[0][0], 643.2 + 1159 * (0.05 - 0.04) / 0.5, 0.3);
  EXPECT_NEAR(marker.corner_px[0][1], 477.9 + 1159 * (-0.03 + 0.04) / 0.5, 0.3);
  EXPECT_LT((from_message(marker.X_CM[0]).translation() - plate.X_CM.translation()).norm(), 1e-3);
  EXPECT_LT(best_angle(marker, plate.X_CM), 2 * kDegree);
}

TEST(MarkerEstimator, MeasuresPosesOverTiltDistanceAndSpin) {
  Estimator estimator;
  for (const double tilt_deg : {0.0, 15.0, 30.0, 45.0, 60.0}) {
    double worst_position = 0, worst_angle = 0;
    for (const double distance_m : {0.6, 1.2}) {
      for (int i = 0; i < 6; ++i) {
        const Plate plate{
            3, 0.08, marker_pose(distance_m, tilt_deg * kDegree, i, 1.3 * i, 0.1 * (i - 3), 0.1)};
        const auto poses = estimator.see({plate}, pinhole_camera(), i);
        ASSERT_EQ(poses.num_markers, 1) << tilt_deg << " deg, " << distance_m << " m";
        ASSERT_EQ(check(poses), "");
        const marker_pose_t& marker = poses.markers[0];
        const double angle = best_angle(marker, plate.X_CM);
        const double position =
            (from_message(marker.X_CM[0]).translation() - plate.X_CM.translation()).norm();
        worst_position = std::max(worst_position, position / distance_m);
        worst_angle = std::max(worst_angle, angle);
      }
    }
    const std::string at = "_at_" + std::to_string(static_cast<int>(tilt_deg)) + "_deg";
    RecordProperty("worst_position_permille" + at, std::to_string(worst_position * 1e3));
    RecordProperty("worst_angle_deg" + at, std::to_string(worst_angle / kDegree));
    EXPECT_LT(worst_position, 6e-3) << tilt_deg;
    EXPECT_LT(worst_angle, (tilt_deg < 10 ? 6 : 1.5) * kDegree) << tilt_deg;
  }
}

constexpr std::size_t kNumViews = 24;

/// d² of published corners and poses from the truth, in ascending order.
struct Consistency {
  std::vector<double> corners, pose;
  std::int64_t num_refused = 0;  ///< by the fit of corners

  static double mean(const std::vector<double>& values) {
    return Eigen::Map<const Eigen::VectorXd>(values.data(), std::ssize(values)).mean();
  }
};

/// Of 24 views of a tag, its side 45 px if it faced the camera, tilted by 25 to 55°. If covered,
/// something white hides a quarter of its left edge.
Consistency consistency(double blur_px, double motion_px, bool is_covered = false) {
  Consistency d2;
  for (std::size_t i = 0; i < kNumViews; ++i) {
    const Plate plate{3, 0.08,
                      marker_pose(2.06, (25 + 1.25 * i) * kDegree, 0.9 * i, 2.3 * i, 0.05 * (i % 5),
                                  0.03 * (i % 7))};
    const camera_info_t camera = test::camera_around(plate, pinhole_camera());
    test::TagViewOptions options;
    options.rays_per_px = 4;
    options.blur_px = blur_px;
    options.motion_px = motion_px * Eigen::Vector2d(std::cos(1.7 * i), std::sin(1.7 * i));
    const test::TagView view(plate, camera, options);
    Estimator estimator(camera);
    cv::Mat image = view.taken(2, i);
    if (is_covered) cover(image, plate, camera, {-0.046, -0.03}, {-0.036, -0.01}, 220);
    const auto poses = estimator.on_camera_image(grey_message(image));
    if (!poses || poses->num_markers != 1) continue;
    for (const auto& [reason, count] : estimator.counters())
      if (reason.starts_with("corners not refined")) d2.num_refused += count;
    const marker_pose_t& marker = poses->markers[0];
    Eigen::Matrix<double, 8, 1> error;
    for (int c = 0; c < 8; ++c)
      error[c] = marker.corner_px[c / 2][c % 2] - view.corners_px()[c / 2][c % 2];
    const Matrix8d corner_covariance = from_message(marker.corner_covariance);
    d2.corners.push_back(error.dot(corner_covariance.ldlt().solve(error)));
    const Vector6d off = log(from_message(marker.X_CM[0]).inverse() * plate.X_CM);
    d2.pose.push_back(squared_mahalanobis(off, from_message(marker.covariance)));
  }
  for (auto* values : {&d2.corners, &d2.pose}) std::sort(values->begin(), values->end());
  return d2;
}

TEST(MarkerEstimator, TellsTrueCovariancesOfFittedCornersAndTheirPose) {
  const Consistency d2 = consistency(0.7, 0);
  ASSERT_EQ(d2.corners.size(), kNumViews);
  EXPECT_EQ(d2.num_refused, 0);
  EXPECT_GT(Consistency::mean(d2.corners), 5);  // chi^2_8
  EXPECT_LT(Consistency::mean(d2.corners), 12);
  EXPECT_GT(Consistency::mean(d2.pose), 4);  // chi^2_6
  EXPECT_LT(Consistency::mean(d2.pose), 9);
}

TEST(MarkerEstimator, TellsHowFarBlurMotionAndACoverPullCornersThatAreNotFitted) {
  for (const auto& d2 : {consistency(3, 0), consistency(0.7, 8), consistency(0.7, 0, true)}) {
    ASSERT_GT(d2.corners.size(), kNumViews / 2);
    EXPECT_EQ(d2.num_refused, std::ssize(d2.corners));
    const double median = d2.corners[d2.corners.size() / 2];
    EXPECT_GT(median, 2);
    EXPECT_LT(median, 30);
  }
}

TEST(MarkerEstimator, StraightensTheLens) {
  camera_info_t plumb = pinhole_camera();
  plumb.distortion_model = camera_info_t::MODEL_PLUMB_BOB;
  set_array(plumb.num_coefficients, plumb.distortion, {-0.3, 0.1, 1e-3, -1e-3, -0.01});
  camera_info_t rational = pinhole_camera();
  rational.distortion_model = camera_info_t::MODEL_RATIONAL;
  set_array(rational.num_coefficients, rational.distortion,
            {0.3, -0.1, 1e-3, 2e-3, 0.01, 0.5, -0.05, 0.01});
  camera_info_t fisheye = pinhole_camera();
  fisheye.distortion_model = camera_info_t::MODEL_FISHEYE;
  set_array(fisheye.num_coefficients, fisheye.distortion, {-0.02, 0.01, -0.004, 0.001});
  for (const camera_info_t& info : {plumb, rational, fisheye}) {
    Estimator estimator(info);
    const Plate plate{11, 0.08, marker_pose(0.8, 35 * kDegree, 1, 2, 0.35, -0.25)};
    const auto poses = estimator.see({plate}, info);
    ASSERT_EQ(poses.num_markers, 1);
    EXPECT_LT(
        (from_message(poses.markers[0].X_CM[0]).translation() - plate.X_CM.translation()).norm(),
        4e-3);
    EXPECT_LT(best_angle(poses.markers[0], plate.X_CM), 1.5 * kDegree);
  }
}

TEST(MarkerEstimator, SortsItsTagsAndIgnoresAndCountsThoseOfNobody) {
  Estimator estimator;
  const auto poses = estimator.see({{11, 0.08, marker_pose(0.8, 0.4, 0, 0, -0.2)},
                                    {3, 0.08, marker_pose(0.8, 0.4, 0, 0, 0.2)},
                                    {100, 0.08, marker_pose(0.8, 0.4, 0, 0, 0, 0.2)}},
                                   pinhole_camera());
  ASSERT_EQ(poses.num_markers, 2);
  EXPECT_EQ(poses.markers[0].marker_id, 3);
  EXPECT_EQ(poses.markers[1].marker_id, 11);
  EXPECT_EQ(estimator.counted("tag not in markers.yaml"), 1);
}

TEST(MarkerEstimator, TellsWhereATargetTagIsByItsOwnSize) {
  Estimator estimator;
  const Pose X_CM = marker_pose(0.8, 0.4, 0, 0, 0.2);
  const auto poses = estimator.see({{40, 0.12, X_CM}}, pinhole_camera());
  ASSERT_EQ(poses.num_markers, 1);
  EXPECT_EQ(poses.markers[0].marker_id, 40);
  EXPECT_EQ(poses.markers[0].size_m, 0.12);
  EXPECT_LT((from_message(poses.markers[0].X_CM[0]).translation() - X_CM.translation()).norm(),
            0.002);
  EXPECT_EQ(estimator.counted("tag not in markers.yaml"), 0);
}

TEST(MarkerEstimator, KeepsTheClearerOfTwoTagsWithOneId) {
  Estimator estimator;
  const auto poses = estimator.see(
      {{3, 0.08, marker_pose(0.8, 0.4, 0, 0, -0.2)}, {3, 0.08, marker_pose(0.8, 0.4, 0, 0, 0.2)}},
      pinhole_camera());
  EXPECT_EQ(poses.num_markers, 1);
  EXPECT_EQ(estimator.counted("tag seen twice"), 1);
}

TEST(MarkerEstimator, ARefusedTagHidesNoGoodOneWithItsId) {
  Estimator estimator;
  const Plate covered{3, 0.08, marker_pose(0.6, 0.5, 0.3, 0)};
  const Plate pale{3, 0.08, marker_pose(0.8, 0.4, 0, 0, 0.3)};
  cv::Mat image = render_plates({covered, pale}, pinhole_camera());
  cover_half_a_side(image, covered);
  cv::Mat right = image.colRange(800, image.cols);
  right.convertTo(right, -1, 0.4);
  const auto found = TagDetector("tag36h11", 1, 20).detect(image);
  ASSERT_FALSE(found.empty());
  ASSERT_LT(found[0].corners_px[0].x(), 800) << "the covered tag's margin is not the larger one";
  const auto poses = estimator.on_camera_image(grey_message(image));
  ASSERT_TRUE(poses);
  ASSERT_EQ(poses->num_markers, 1);
  EXPECT_LT(best_angle(poses->markers[0], pale.X_CM), 1 * kDegree);
  EXPECT_EQ(estimator.counted("tag half covered"), 1);
}

TEST(MarkerEstimator, AnswersABlankImageWithNoMarkers) {
  Estimator estimator;
  camera_image_t image = grey_message(cv::Mat(960, 1280, CV_8UC1, cv::Scalar(128)), 42, 7);
  const auto poses = estimator.on_camera_image(image);
  ASSERT_TRUE(poses);
  EXPECT_EQ(poses->utime, 42);
  EXPECT_EQ(poses->image_seq, 7);
  EXPECT_EQ(poses->num_markers, 0);
}

TEST(MarkerEstimator, AnswersNothingBeforeTheCalibration) {
  MarkerEstimator estimator(config(), markers());
  EXPECT_FALSE(estimator.on_camera_image(grey_message(cv::Mat::zeros(960, 1280, CV_8UC1))));
  EXPECT_EQ(estimator.activity(), "waits for CAMERA_INFO");
}

TEST(MarkerEstimator, RefusesAndCountsGarbage) {
  Estimator estimator;
  camera_image_t image = grey_message(cv::Mat::zeros(960, 1280, CV_8UC1));
  image.encoding = camera_image_t::ENCODING_JPEG;
  set_array(image.num_bytes, image.data, std::vector<std::uint8_t>{0xff, 0xd8, 1, 2, 3, 4});
  EXPECT_FALSE(estimator.on_camera_image(image));
  set_array(image.num_bytes, image.data, std::vector<std::uint8_t>{});
  EXPECT_FALSE(estimator.on_camera_image(image));
  image.encoding = camera_image_t::ENCODING_GREY;
  set_array(image.num_bytes, image.data, std::vector<std::uint8_t>(17));
  EXPECT_FALSE(estimator.on_camera_image(image));
  EXPECT_EQ(estimator.counted("image unreadable"), 3);
}

TEST(MarkerEstimator, RefusesAnImageOfAnotherSizeThanTheCalibrations) {
  Estimator estimator;
  EXPECT_FALSE(estimator.on_camera_image(grey_message(cv::Mat::zeros(480, 640, CV_8UC1))));
  EXPECT_EQ(estimator.counted("image not of the calibrated size"), 1);
  EXPECT_NE(estimator.activity().find("640×480"), std::string::npos);
}

TEST(MarkerEstimator, SurvivesAnImageTooSmallForAprilTag) {
  camera_info_t tiny = pinhole_camera();
  tiny.image_width = tiny.image_height = 20;
  Estimator estimator(tiny);
  EXPECT_FALSE(estimator.on_camera_image(grey_message(cv::Mat::zeros(20, 20, CV_8UC1))));
  EXPECT_EQ(estimator.counted("image too small"), 1);
}

TEST(MarkerEstimator, DoesNotTrustATagWhoseMarginIsHalfCovered) {
  Estimator estimator;
  const Plate plate{3, 0.08, marker_pose(0.6, 0.5, 0.3, 0)};
  cv::Mat image = render_plates({plate}, pinhole_camera());
  cover_half_a_side(image, plate);
  const auto poses = estimator.on_camera_image(grey_message(image));
  ASSERT_TRUE(poses);
  EXPECT_EQ(poses->num_markers, 0);
  EXPECT_EQ(estimator.counted("tag half covered"), 1);
}

TEST(MarkerEstimator, RefusesATagThatIsTooSteep) {
  Estimator estimator;
  const auto poses =
      estimator.see({{3, 0.08, marker_pose(0.4, 74 * kDegree, 0, 0)}}, pinhole_camera());
  EXPECT_EQ(poses.num_markers, 0);
  EXPECT_EQ(estimator.counted("tag too steep"), 1);
}

TEST(MarkerEstimator, GivesTheSameBytesForTheSameImage) {
  const cv::Mat image = render_plates({{3, 0.08, marker_pose(0.8, 0.1, 0, 0)}}, pinhole_camera());
  const auto bytes = [&] {
    Estimator estimator;
    const auto poses = estimator.on_camera_image(grey_message(image)).value();
    std::vector<std::uint8_t> data(static_cast<std::size_t>(poses.getEncodedSize()));
    poses.encode(data.data(), 0, static_cast<int>(data.size()));
    return data;
  };
  EXPECT_EQ(bytes(), bytes());
}

TEST(MarkerEstimator, ARepeatedImageIsAnsweredWithoutBeingLookedAt) {
  Estimator estimator;
  std::vector<camera_image_t> images;
  for (int n = 0; n < 3; ++n) {
    const Plate plate{3, 0.08, marker_pose(0.8, 0.1 * n, 0, 0)};
    images.push_back(grey_message(render_plates({plate}, pinhole_camera()), 100 * n, n));
  }
  std::vector<marker_poses_t> first;
  for (const auto& image : images) first.push_back(estimator.on_camera_image(image).value());
  EXPECT_EQ(estimator.counted("image repeated"), 0);
  camera_info_t later = pinhole_camera();
  later.utime = 77;  // the calibration is repeated too
  estimator.on_camera_info(later);
  for (int n = 2; n >= 0; --n) {
    const auto again = estimator.on_camera_image(images[n]).value();
    EXPECT_EQ(again.utime, first[n].utime);
    EXPECT_EQ(again.image_seq, n);
    ASSERT_EQ(again.num_markers, 1);
    EXPECT_EQ(again.markers[0].X_CM[0].position_m[2], first[n].markers[0].X_CM[0].position_m[2]);
  }
  EXPECT_EQ(estimator.counted("image repeated"), 3);
  // Another image under the same number is not the same image.
  camera_image_t dark = images[1];
  std::fill(dark.data.begin(), dark.data.end(), std::uint8_t{20});
  EXPECT_EQ(estimator.on_camera_image(dark).value().num_markers, 0);
  // Under another calibration the same pixels are another pose.
  camera_info_t longer = pinhole_camera();
  longer.fx *= 2;
  longer.fy *= 2;
  estimator.on_camera_info(longer);
  const auto far = estimator.on_camera_image(images[1]).value();
  ASSERT_EQ(far.num_markers, 1);
  EXPECT_GT(far.markers[0].X_CM[0].position_m[2], 1.8 * first[1].markers[0].X_CM[0].position_m[2]);
}

TEST(MarkerEstimator, RefusesAnotherCamerasImages) {
  Estimator estimator;
  camera_image_t image = grey_message(cv::Mat(960, 1280, CV_8UC1, cv::Scalar(128)));
  image.camera_name = "webcam";
  EXPECT_FALSE(estimator.on_camera_image(image));
  EXPECT_EQ(estimator.counted("image of another camera"), 1);
}

TEST(MarkerEstimator, FindsTheCornersInAJpegAsWellAsInTheRawImage) {
  Estimator estimator;
  const Plate plate{3, 0.08, marker_pose(0.9, 0.6, 1, 1)};
  const cv::Mat image = render_plates({plate}, pinhole_camera());
  const auto raw = estimator.on_camera_image(grey_message(image)).value();
  camera_image_t jpeg = grey_message(image);
  std::vector<std::uint8_t> bytes;
  cv::imencode(".jpg", image, bytes, {cv::IMWRITE_JPEG_QUALITY, 90});
  jpeg.encoding = camera_image_t::ENCODING_JPEG;
  set_array(jpeg.num_bytes, jpeg.data, bytes);
  const auto decoded = estimator.on_camera_image(jpeg).value();
  ASSERT_EQ(raw.num_markers, 1);
  ASSERT_EQ(decoded.num_markers, 1);
  for (int c = 0; c < 4; ++c) {
    for (int axis = 0; axis < 2; ++axis) {
      EXPECT_NEAR(decoded.markers[0].corner_px[c][axis], raw.markers[0].corner_px[c][axis], 0.1);
    }
  }
}

TEST(MarkerEstimatorConfig, OfEveryShippedRigIsReadable) {
  for (const char* rig : {"arm2", "arm4", "arm6_ends", "arm7"}) {
    EXPECT_NO_THROW(MarkerEstimatorConfig::load(std::filesystem::path(BODYSCHEMA_CONFIG) / rig /
                                                "marker_estimator.yaml"));
  }
}

}  // namespace
}  // namespace bodyschema
