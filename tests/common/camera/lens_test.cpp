#include "common/camera/lens.h"

#include <gtest/gtest.h>

#include <opencv2/calib3d.hpp>
#include <random>
#include <stdexcept>

#include "common/bus/convert.h"
#include "tests/support/tag_image.h"

namespace bodyschema {
namespace {

camera_info_t camera_with(std::int8_t model, std::vector<double> coefficients) {
  camera_info_t info = pinhole_camera();
  info.distortion_model = model;
  set_array(info.num_coefficients, info.distortion, std::move(coefficients));
  return info;
}

const std::vector<camera_info_t> kCameras = {
    pinhole_camera(),
    camera_with(camera_info_t::MODEL_PLUMB_BOB, {-0.25, 0.06, 1e-3, -2e-3}),
    camera_with(camera_info_t::MODEL_PLUMB_BOB, {-0.35, 0.12, 1e-3, -2e-3, -0.02}),
    camera_with(camera_info_t::MODEL_RATIONAL, {0.3, -0.1, 1e-3, 2e-3, 0.01, 0.5, -0.05, 0.01}),
    camera_with(camera_info_t::MODEL_FISHEYE, {-0.02, 0.01, -0.004, 0.001}),
};

TEST(Lens, ProjectsAsOpenCvDoes) {
  std::mt19937 random(1);
  std::uniform_real_distribution<double> ray(-0.5, 0.5);
  for (const camera_info_t& info : kCameras) {
    const Lens lens(info);
    const cv::Matx33d K(info.fx, 0, info.cx, 0, info.fy, info.cy, 0, 0, 1);
    for (int i = 0; i < 100; ++i) {
      const Eigen::Vector2d r(ray(random), ray(random));
      const std::vector<cv::Point3d> point{{2 * r.x(), 2 * r.y(), 2}};
      std::vector<cv::Point2d> expected;
      const cv::Vec3d zero(0, 0, 0);
      if (info.distortion_model == camera_info_t::MODEL_FISHEYE) {
        cv::fisheye::projectPoints(point, expected, zero, zero, K, info.distortion);
      } else {
        cv::projectPoints(point, zero, zero, K, info.distortion, expected);
      }
      EXPECT_NEAR(lens.project(r).x(), expected[0].x, 1e-9);
      EXPECT_NEAR(lens.project(r).y(), expected[0].y, 1e-9);
    }
  }
}

TEST(Lens, StraightensWhatItProjected) {
  std::mt19937 random(2);
  std::uniform_real_distribution<double> ray(-0.5, 0.5);
  for (const camera_info_t& info : kCameras) {
    const Lens lens(info);
    for (int i = 0; i < 100; ++i) {
      const Eigen::Vector2d r(ray(random), ray(random));
      const auto point = lens.straighten(lens.project(r));
      ASSERT_TRUE(point);
      EXPECT_LT((point->ray - r).norm(), 1e-9);
    }
  }
}

TEST(Lens, KnowsHowPixelsMoveWithTheRay) {
  for (const camera_info_t& info : kCameras) {
    const Lens lens(info);
    const Eigen::Vector2d r(0.3, -0.2), step(1e-4, -2e-4);
    const auto point = lens.straighten(lens.project(r));
    ASSERT_TRUE(point);
    const Eigen::Vector2d moved = lens.project(r + step) - lens.project(r - step);
    EXPECT_LT((point->px_per_ray * (2 * step) - moved).norm(), 1e-5);
  }
}

TEST(Lens, WithTheParametersOfAnotherIsThatOne) {
  for (const camera_info_t& info : kCameras) {
    const Lens lens(info);
    camera_info_t other = info;
    other.fx *= 1.02;
    other.cy += 3;
    for (double& coefficient : other.distortion) coefficient += 0.01;
    const Eigen::VectorXd parameters = Lens(other).parameters();
    ASSERT_EQ(parameters.size(), 4 + info.num_coefficients);
    EXPECT_EQ(parameters(0), other.fx);
    const Eigen::Vector2d ray(0.2, -0.3);
    EXPECT_EQ(lens.with(parameters).project(ray), Lens(other).project(ray));
    EXPECT_EQ(lens.with(lens.parameters()).project(ray), lens.project(ray));
  }
}

TEST(Lens, RefusesPixelsThatNoRayLeadsTo) {
  // Distortion folds the image back at r² = 1/(3·0.4): farther out nothing is seen.
  const Lens lens(camera_with(camera_info_t::MODEL_PLUMB_BOB, {-0.4, 0, 0, 0}));
  EXPECT_FALSE(lens.straighten({643.2 + 1159 * 0.7, 477.9}));
  EXPECT_TRUE(lens.straighten({643.2 + 1159 * 0.4, 477.9}));
  EXPECT_FALSE(lens.straighten({std::nan(""), 0}));
}

TEST(Lens, RefusesACalibrationWhoseCoefficientsDoNotFitItsModel) {
  EXPECT_THROW(Lens(camera_with(camera_info_t::MODEL_PLUMB_BOB, {1, 2, 3})), std::invalid_argument);
  EXPECT_THROW(Lens(camera_with(camera_info_t::MODEL_FISHEYE, {1, 2, 3, 4, 5})),
               std::invalid_argument);
}

}  // namespace
}  // namespace bodyschema
