#include "processes/marker_estimator/corner_refinement.h"

#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <opencv2/imgproc.hpp>
#include <random>

#include "common/bus/convert.h"
#include "common/geometry/angle.h"
#include "processes/marker_estimator/tag_detector.h"
#include "tests/support/tag_view.h"

namespace bodyschema::test {
namespace {

constexpr double kSize_m = 0.08;
using Vector8d = Eigen::Matrix<double, 8, 1>;

TagDetector& detector() {
  static TagDetector detector("tag36h11", 1, 20);
  return detector;
}

camera_info_t distorted_camera() {
  camera_info_t camera = pinhole_camera();
  camera.distortion_model = camera_info_t::MODEL_PLUMB_BOB;
  set_array(camera.num_coefficients, camera.distortion, {-0.35, 0.12, 1e-3, -1e-3, -0.01});
  return camera;
}

/// One tag as a camera sees it, `side_px` long if it faced the camera.
struct Sight {
  Sight(double side_px, double tilt_deg, const TagViewOptions& options, int i = 0,
        const camera_info_t& whole = pinhole_camera(), double off_axis = 0.1)
      : plate{5 + i, kSize_m,
              marker_pose(whole.fx * kSize_m / side_px, tilt_deg * kDegree, 0.8 + 1.3 * i,
                          0.4 + 2.1 * i, off_axis + 0.0013 * i, 0.7 * off_axis + 0.0007 * i)},
        camera(camera_around(plate, whole)),
        view(plate, camera, options) {}

  Plate plate;
  camera_info_t camera;
  TagView view;

  /// Corners to begin with, about as wrong as AprilTag's.
  std::vector<Eigen::Vector2d> about(std::uint64_t seed = 1) const {
    std::mt19937_64 random(seed);
    std::normal_distribution<double> error(0, 0.1);
    std::vector<Eigen::Vector2d> corners = view.corners_px();
    for (auto& p : corners) p += Eigen::Vector2d(error(random), error(random));
    return corners;
  }
  CornerRefinement refine(const cv::Mat& image, std::uint64_t seed = 1) const {
    return refine_corners(image, Lens(camera), detector().cells(plate.id), about(seed));
  }
  Vector8d error(const RefinedCorners& corners) const {
    Vector8d e;
    for (int k = 0; k < 4; ++k) e.segment<2>(2 * k) = corners.corners_px[k] - view.corners_px()[k];
    return e;
  }
};

/// Errors over some views, each with some frames.
struct Errors {
  double bias_px = 0, rms_px = 0, over_bound = 0, mean_d2 = 0;
  int refused = 0;
};

Errors measure(double side_px, double tilt_deg, const TagViewOptions& options, double noise_sd,
               int jpeg_quality = 0, const camera_info_t& whole = pinhole_camera(),
               double off_axis = 0.1) {
  constexpr int kViews = 4, kFrames = 10;
  Errors errors;
  double bias2 = 0, squares = 0, squares_over_bound = 0, d2 = 0;
  int num = 0;
  for (int i = 0; i < kViews; ++i) {
    const Sight sight(side_px, tilt_deg, options, i, whole, off_axis);
    const double bound2 = sight.view.cramer_rao_px2(std::hypot(noise_sd, 0.29)).trace();
    Vector8d sum = Vector8d::Zero();
    double own = 0;
    int n = 0;
    for (int f = 0; f < kFrames; ++f) {
      const auto fit = sight.refine(sight.view.taken(noise_sd, 100 * i + f, jpeg_quality), f);
      if (!fit.corners) {
        ++errors.refused;
        continue;
      }
      const Vector8d e = sight.error(*fit.corners);
      sum += e;
      own += e.squaredNorm();
      d2 += e.dot(fit.corners->covariance_px2.ldlt().solve(e));
      squares_over_bound += e.squaredNorm() / bound2;
      ++n;
    }
    if (n < 2) continue;
    const double mean2 = (sum / n).squaredNorm();
    bias2 += (mean2 - (own - n * mean2) / (n - 1) / n) / 8 / kViews;
    squares += own;
    num += n;
  }
  errors.bias_px = std::sqrt(std::max(0.0, bias2));
  errors.rms_px = std::sqrt(squares / (8 * num));
  errors.over_bound = std::sqrt(squares_over_bound / num);
  errors.mean_d2 = d2 / num;
  return errors;
}

TEST(TagView, PutsTheCentreOfTheUpperLeftPixelAtZero) {
  // A square from −0.5 of pixel 20 to +0.5 of pixel 99: no pixel is cut by its edges.
  camera_info_t camera = pinhole_camera();
  camera.image_width = camera.image_height = 120;
  camera.fx = camera.fy = 1000;
  camera.cx = camera.cy = 59.5;
  Plate plate{0, kSize_m, Pose::Identity()};
  plate.X_CM.translation() = Eigen::Vector3d(0, 0, 1);
  const TagView view(plate, camera);
  EXPECT_NEAR(view.corners_px()[3].x(), 19.5, 1e-9);
  EXPECT_NEAR(view.corners_px()[1].y(), 99.5, 1e-9);
  for (const int v : {30, 60, 90}) {
    EXPECT_NEAR(view.exact().at<double>(v, 19), 220, 1e-6);
    EXPECT_NEAR(view.exact().at<double>(v, 20), 25, 1e-6);
    EXPECT_NEAR(view.exact().at<double>(99, v), 25, 1e-6);
    EXPECT_NEAR(view.exact().at<double>(100, v), 220, 1e-6);
  }
  // And the result of the fit, from a sharp and from a soft picture.
  for (const double blur_px : {0.0, 0.7}) {
    const TagView soft(plate, camera, {.blur_px = blur_px});
    auto corners = soft.corners_px();
    for (auto& p : corners) p += Eigen::Vector2d(0.1, -0.1);
    const auto fit = refine_corners(soft.taken(1, 1), Lens(camera), detector().cells(0), corners);
    ASSERT_TRUE(fit.corners) << name_of(fit.refusal);
    for (int k = 0; k < 4; ++k) {
      EXPECT_LT((fit.corners->corners_px[k] - soft.corners_px()[k]).norm(), 0.02);
    }
  }
}

TEST(TagView, HasTheGreyOfTheAreaThatIsCovered) {
  camera_info_t camera = pinhole_camera();
  camera.image_width = camera.image_height = 120;
  camera.fx = camera.fy = 1000;
  camera.cx = camera.cy = 59.5 + 0.3;
  Plate plate{0, kSize_m, Pose::Identity()};
  plate.X_CM.translation() = Eigen::Vector3d(0, 0, 1);
  const TagView view(plate, camera);
  // 0.3 of pixel 20 are white.
  EXPECT_NEAR(view.exact().at<double>(60, 20), 25 + 0.3 * 195, 0.3);
  EXPECT_NEAR(view.exact().at<double>(20, 60), 25 + 0.3 * 195, 0.3);
}

TEST(TagView, HasTheBoundOfAStraightEdge) {
  // The bound falls with the noise, and with the root of the length.
  const Sight small(50, 20, {.blur_px = 0.7}), large(100, 20, {.blur_px = 0.7, .rays_per_px = 4});
  const double bound = std::sqrt(small.view.cramer_rao_px2(2).trace() / 8);
  EXPECT_NEAR(std::sqrt(small.view.cramer_rao_px2(4).trace() / 8), 2 * bound, 1e-9);
  const double bound_large = std::sqrt(large.view.cramer_rao_px2(2).trace() / 8);
  EXPECT_GT(bound / bound_large, 1.2);
  EXPECT_LT(bound / bound_large, 1.8);
}

TEST(RefineCorners, HasNoBiasAndComesNearTheCramerRaoBound) {
  const TagViewOptions typical{.blur_px = 0.7}, sharp{};
  struct Cell {
    const char* name;
    Errors errors;
  };
  for (const auto& [name, e] :
       {Cell{"25 px, facing", measure(25, 0, typical, 2)},
        Cell{"25 px, 45°, sharp", measure(25, 45, sharp, 2)},
        Cell{"50 px, 60°", measure(50, 60, typical, 2)},
        Cell{"50 px, 35°, dim and noisy", measure(50, 35, {.blur_px = 0.7, .white = 100}, 6)},
        Cell{"60 px, distorted", measure(60, 30, typical, 2, 0, distorted_camera(), 0.33)}}) {
    EXPECT_EQ(e.refused, 0) << name;
    EXPECT_LE(e.bias_px, 0.01) << name;
    EXPECT_LE(e.over_bound, 1.3) << name;
  }
}

TEST(RefineCorners, SaysTrulyHowWellItKnowsThem) {
  struct Cell {
    const char* name;
    Errors errors;
  };
  const TagViewOptions typical{.blur_px = 0.7};
  // Mean of chi²₈ is 8; over 4 views of 10 frames its standard deviation is 0.6.
  for (const auto& [name, e] :
       {Cell{"noise 1", measure(40, 30, typical, 1)}, Cell{"noise 6", measure(40, 30, typical, 6)},
        Cell{"blur 1.2 px", measure(50, 30, {.blur_px = 1.2}, 2)},
        Cell{"JPEG 90", measure(40, 30, typical, 2, 90)},
        Cell{"JPEG 80, 25 px", measure(25, 30, typical, 2, 80)},
        Cell{"JPEG 60", measure(50, 30, typical, 2, 60)},
        Cell{"motion of 2 px", measure(50, 30, {.blur_px = 0.7, .motion_px = {1.6, 1.2}}, 2)},
        Cell{"uneven light",
             measure(50, 30, {.blur_px = 0.7, .white = 160, .light_gradient = {0.004, 0.003}}, 2)},
        Cell{"distorted", measure(50, 30, typical, 2, 0, distorted_camera(), 0.33)}}) {
    EXPECT_EQ(e.refused, 0) << name;
    EXPECT_GT(e.mean_d2, 4) << name;
    EXPECT_LT(e.mean_d2, 12) << name;
    EXPECT_LE(e.bias_px, 0.012) << name;
  }
}

TEST(RefineCorners, HasASymmetricPositiveCovarianceInWhichNeighboursAreCorrelated) {
  const Sight sight(50, 30, {.blur_px = 0.7});
  const auto fit = sight.refine(sight.view.taken(2, 1));
  ASSERT_TRUE(fit.corners);
  const Matrix8d& S = fit.corners->covariance_px2;
  EXPECT_TRUE(S.isApprox(S.transpose(), 0));
  EXPECT_EQ(S.ldlt().info(), Eigen::Success);
  EXPECT_GT(S.ldlt().vectorD().minCoeff(), 0);
  double largest = 0;
  for (int i = 0; i < 2; ++i) {
    for (int j = 2; j < 8; ++j) {
      largest = std::max(largest, std::abs(S(i, j)) / std::sqrt(S(i, i) * S(j, j)));
    }
  }
  EXPECT_GT(largest, 0.05);
  EXPECT_NEAR(fit.corners->noise_sd, 2, 0.4);
  EXPECT_NEAR(fit.corners->contrast, 195, 3);
  EXPECT_NEAR(fit.corners->blur_px2(0, 0), 0.49, 0.05);
}

TEST(RefineCorners, IsSurerOfATagAtRestThanOfOneThatMoves) {
  const auto variance = [](const Eigen::Vector2d& motion_px) {
    const Sight sight(60, 20, {.blur_px = 0.7, .motion_px = motion_px});
    const auto fit = sight.refine(sight.view.taken(2, 1));
    return fit.corners ? fit.corners->covariance_px2.trace() : NAN;
  };
  const double at_rest = variance({0, 0});
  EXPECT_GT(variance({3, 0}), 1.05 * at_rest);
  EXPECT_GT(variance({0, 3}), 1.05 * at_rest);
}

TEST(RefineCorners, DoesNotCareForWhatLiesBeyondTheWhiteMargin) {
  std::vector<RefinedCorners> found;
  for (const double background : {0.0, 90.0, 255.0}) {
    const Sight sight(30, 30, {.blur_px = 0.7, .background = background});
    const auto fit = sight.refine(sight.view.taken(0.1, 1));
    ASSERT_TRUE(fit.corners) << background;
    EXPECT_LT(sight.error(*fit.corners).cwiseAbs().maxCoeff(), 0.006) << background;
  }
}

TEST(RefineCorners, RefusesATagThatIsPartlyCovered) {
  const Sight sight(60, 20, {.blur_px = 0.7});
  const auto& p = sight.view.corners_px();
  const Eigen::Vector2d centre = (p[0] + p[1] + p[2] + p[3]) / 4;
  for (int k = 0; k < 4; ++k) {
    for (const double grey : {0.0, 25.0, 120.0, 255.0}) {
      cv::Mat image = sight.view.taken(2, 1);
      const Eigen::Vector2d at = k % 2 ? p[k] : Eigen::Vector2d(0.5 * (p[k] + p[(k + 1) % 4]));
      const Eigen::Vector2d q = at + 0.05 * (centre - at);
      cv::circle(image, {static_cast<int>(q.x()), static_cast<int>(q.y())}, 12, cv::Scalar(grey),
                 -1);
      cv::GaussianBlur(image, image, {0, 0}, 0.5);
      const auto fit = sight.refine(image);
      // An accepted fit has to be right.
      if (fit.corners) {
        EXPECT_LT(sight.error(*fit.corners).cwiseAbs().maxCoeff(), 0.03) << k << " " << grey;
      }
      EXPECT_FALSE(fit.corners) << k << " " << grey;
    }
  }
}

TEST(RefineCorners, SaysWhyItRefuses) {
  const auto refusal = [](double side_px, const TagViewOptions& options, double noise_sd = 2) {
    const Sight sight(side_px, 20, options);
    return sight.refine(sight.view.taken(noise_sd, 1)).refusal;
  };
  EXPECT_EQ(refusal(9, {.blur_px = 0.7}), CornerRefusal::kTooSmall);
  EXPECT_EQ(refusal(40, {.blur_px = 0.7, .white = 31}), CornerRefusal::kLowContrast);
  EXPECT_EQ(refusal(20, {.blur_px = 0.7, .white = 40}, 8), CornerRefusal::kLowContrast);
  EXPECT_EQ(refusal(40, {.blur_px = 0.7, .white = 300}), CornerRefusal::kSaturated);
  EXPECT_EQ(refusal(40, {.blur_px = 0.7, .black = -30}), CornerRefusal::kSaturated);
  EXPECT_EQ(refusal(50, {.blur_px = 0.7, .motion_px = {7, 2}}), CornerRefusal::kBlurred);
  for (const double blur_px : {3.0, 4.0, 6.0}) {
    EXPECT_NE(refusal(40, {.blur_px = blur_px}), CornerRefusal::kNone) << blur_px;
  }
}

/// A tag that faces the camera, in cells of `cell_px`, blurred.
struct BlurredTag {
  BlurredTag(int cell_px, const Eigen::Vector2d& blur_cells) : cells(detector().cells(5)) {
    cv::Mat pattern(cells.width, cells.width, CV_8UC1);
    for (int i = 0; i < cells.width * cells.width; ++i) {
      pattern.data[i] = cells.is_white[i] ? 220 : 25;
    }
    const int pad = 3 * cell_px;
    cv::resize(pattern, image, {}, cell_px, cell_px, cv::INTER_NEAREST);
    cv::copyMakeBorder(image, image, pad, pad, pad, pad, cv::BORDER_CONSTANT, cv::Scalar(90));
    cv::GaussianBlur(image, image, {0, 0}, blur_cells.x() * cell_px, blur_cells.y() * cell_px);
    camera = pinhole_camera();
    camera.image_width = image.cols;
    camera.image_height = image.rows;
    camera.cx = image.cols / 2.0;
    camera.cy = image.rows / 2.0;
    const double low = pad + cell_px - 0.5, high = low + cells.border * cell_px;
    corners_px = {{low, high}, {high, high}, {high, low}, {low, low}};
  }
  CornerRefinement refine() const { return refine_corners(image, Lens(camera), cells, corners_px); }

  const TagCells& cells;
  cv::Mat image;
  camera_info_t camera;
  std::vector<Eigen::Vector2d> corners_px;
};

TEST(RefineCorners, SpendsNoMoreOnALargeBlurredTagThanOnASmallOne) {
  // Eight iterations, each with 40 000 pixels at most.
  constexpr std::int64_t kMost = 320'000;
  for (const Eigen::Vector2d& blur_cells :
       {Eigen::Vector2d(0.8, 0.8), Eigen::Vector2d(0.5, 0.05)}) {
    for (const int cell_px : {8, 20, 40, 110}) {
      const CornerRefinement fit = BlurredTag(cell_px, blur_cells).refine();
      EXPECT_FALSE(fit.corners) << cell_px;
      EXPECT_LT(fit.num_evaluations, kMost) << cell_px << " " << blur_cells.transpose();
    }
  }
}

TEST(RefineCorners, FindsLargeTagsSharpAndBlurred) {
  for (const double blur_px : {0.7, 6.0}) {
    for (const int cell_px : {20, 40, 110}) {
      const BlurredTag tag(cell_px, Eigen::Vector2d::Constant(blur_px / cell_px));
      const CornerRefinement fit = tag.refine();
      ASSERT_TRUE(fit.corners) << cell_px << " " << blur_px << " " << name_of(fit.refusal);
      for (int k = 0; k < 4; ++k) {
        EXPECT_LT((fit.corners->corners_px[k] - tag.corners_px[k]).norm(), 0.03)
            << cell_px << " " << blur_px;
      }
    }
  }
}

TEST(RefineCorners, RefusesAPictureOfAnythingElse) {
  const Sight sight(50, 20, {.blur_px = 0.7});
  cv::Mat image = sight.view.taken(2, 1);
  cv::RNG random(7);
  cv::Mat noise(image.size(), CV_8UC1), ramp(image.size(), CV_8UC1);
  random.fill(noise, cv::RNG::UNIFORM, 0, 256);
  for (int v = 0; v < ramp.rows; ++v) ramp.row(v).setTo(v % 256);
  EXPECT_FALSE(sight.refine(noise).corners);
  EXPECT_FALSE(sight.refine(ramp).corners);
  EXPECT_FALSE(sight.refine(cv::Mat(image.size(), CV_8UC1, cv::Scalar(128))).corners);
  // Another tag.
  EXPECT_FALSE(refine_corners(image, Lens(sight.camera), detector().cells(sight.plate.id + 1),
                              sight.view.corners_px())
                   .corners);
  // Corners of another place.
  auto far = sight.view.corners_px();
  for (auto& p : far) p.x() += 5;
  EXPECT_FALSE(
      refine_corners(image, Lens(sight.camera), detector().cells(sight.plate.id), far).corners);
}

TEST(RefineCorners, SurvivesSenselessCorners) {
  const Sight sight(50, 20, {.blur_px = 0.7});
  const cv::Mat image = sight.view.taken(2, 1);
  const Lens lens(sight.camera);
  const TagCells& cells = detector().cells(sight.plate.id);
  const auto refused = [&](const std::vector<Eigen::Vector2d>& corners) {
    const auto fit = refine_corners(image, lens, cells, corners);
    return !fit.corners && fit.refusal != CornerRefusal::kNone;
  };
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const double infinite = std::numeric_limits<double>::infinity();
  const auto good = sight.view.corners_px();
  EXPECT_TRUE(refused({}));
  EXPECT_TRUE(refused({good[0], good[1], good[2]}));
  for (const double bad : {nan, infinite, -infinite, 1e300, -1.0, 1e6}) {
    for (int k = 0; k < 4; ++k) {
      auto corners = good;
      corners[k].x() = bad;
      EXPECT_TRUE(refused(corners)) << bad;
    }
  }
  EXPECT_TRUE(refused({good[0], good[0], good[0], good[0]}));
  EXPECT_TRUE(refused({good[0], good[1], good[0], good[1]}));
  EXPECT_TRUE(refused({good[3], good[2], good[1], good[0]}));  // the mirror image
  EXPECT_TRUE(refused({good[0], good[2], good[1], good[3]}));  // crossed
  EXPECT_TRUE(refused({{10, 10}, {30, 30}, {50, 50}, {70, 70}}));
  EXPECT_TRUE(refused({{10, 10.001}, {30, 30}, {50, 50}, {30, 29.999}}));
  std::mt19937_64 random(3);
  std::uniform_real_distribution<double> anywhere(0, image.cols - 1);
  for (int i = 0; i < 500; ++i) {
    std::vector<Eigen::Vector2d> corners;
    for (int k = 0; k < 4; ++k) corners.emplace_back(anywhere(random), anywhere(random));
    EXPECT_TRUE(refused(corners));
  }
}

TEST(RefineCorners, SurvivesImagesOfAnySize) {
  const TagCells& cells = detector().cells(3);
  const Lens lens(pinhole_camera());
  const std::vector<Eigen::Vector2d> corners = {{0, 40}, {40, 40}, {40, 0}, {0, 0}};
  for (const cv::Size size : {cv::Size(0, 0), cv::Size(1, 1), cv::Size(2, 300), cv::Size(41, 41)}) {
    EXPECT_FALSE(
        refine_corners(cv::Mat(size, CV_8UC1, cv::Scalar(77)), lens, cells, corners).corners);
  }
  cv::Mat huge(3000, 4000, CV_8UC1);
  cv::randu(huge, 0, 256);
  camera_info_t camera = pinhole_camera();
  camera.image_width = 4000;
  camera.image_height = 3000;
  EXPECT_FALSE(refine_corners(huge, Lens(camera), cells,
                              {{500, 2500}, {3000, 2500}, {3000, 500}, {500, 500}})
                   .corners);
  EXPECT_THROW(refine_corners(cv::Mat(100, 100, CV_8UC3), lens, cells, corners),
               std::invalid_argument);
  EXPECT_THROW(refine_corners(cv::Mat(100, 100, CV_8UC1), lens, TagCells{}, corners),
               std::invalid_argument);
}

TEST(RefineCorners, GivesTheSameBitsForTheSameImage) {
  const Sight sight(45, 40, {.blur_px = 0.7});
  const cv::Mat image = sight.view.taken(2, 1, 90);
  const auto first = sight.refine(image), second = sight.refine(image);
  ASSERT_TRUE(first.corners && second.corners);
  for (int k = 0; k < 4; ++k) {
    EXPECT_EQ(first.corners->corners_px[k], second.corners->corners_px[k]);
  }
  EXPECT_EQ(first.corners->covariance_px2, second.corners->covariance_px2);
}

TEST(TagDetector, TellsHowItsTagsArePrinted) {
  TagDetector small("tag25h9", 1, 20);
  EXPECT_EQ(small.cells(0).width, 9);
  EXPECT_EQ(small.cells(0).border, 7);
  const TagCells& cells = detector().cells(7);
  ASSERT_EQ(cells.width, 10);
  for (int i = 0; i < 10; ++i) EXPECT_TRUE(cells.is_white[i]);       // the margin
  for (int i = 1; i < 9; ++i) EXPECT_FALSE(cells.is_white[10 + i]);  // the border
  EXPECT_THROW(detector().cells(-1), std::out_of_range);
  EXPECT_THROW(detector().cells(587), std::out_of_range);
}

}  // namespace
}  // namespace bodyschema::test
