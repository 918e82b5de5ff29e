#include "common/scene/scene_renderer.h"

#include <apriltag/apriltag.h>
#include <apriltag/tag36h11.h>
#include <gtest/gtest.h>

#include <array>
#include <cmath>
#include <map>
#include <opencv2/calib3d.hpp>
#include <opencv2/imgproc.hpp>

#include "common/bus/convert.h"
#include "common/geometry/angle.h"
#include "common/scene/faults.h"
#include "common/scene/scene.h"
#include "tests/support/target_rig.h"

namespace bodyschema {
namespace {

const std::filesystem::path kConfig = BODYSCHEMA_CONFIG_FOLDER;

using Corners = std::array<Eigen::Vector2d, 4>;

/// Corners of all tags, pixel-centre convention.
std::map<int, Corners> detect(const cv::Mat& image) {
  apriltag_family_t* family = tag36h11_create();
  apriltag_detector_t* detector = apriltag_detector_create();
  apriltag_detector_add_family_bits(detector, family, 1);
  detector->quad_decimate = 1;
  detector->refine_edges = 1;
  detector->nthreads = 1;
  detector->qtp.min_white_black_diff = 20;
  image_u8_t view{image.cols, image.rows, static_cast<int>(image.step), image.data};
  zarray_t* found = apriltag_detector_detect(detector, &view);
  std::map<int, Corners> result;
  for (int i = 0; i < zarray_size(found); ++i) {
    apriltag_detection_t* detection;
    zarray_get(found, i, &detection);
    for (int k = 0; k < 4; ++k) {
      // AprilTag's origin is the corner of the first pixel, OpenCV's its centre.
      result[detection->id][k] = {detection->p[k][0] - 0.5, detection->p[k][1] - 0.5};
    }
  }
  apriltag_detections_destroy(found);
  apriltag_detector_destroy(detector);
  tag36h11_destroy(family);
  return result;
}

/// Expected corners of a tag, in marker_pose_t's order.
Corners project(const CameraCalibration& c, const Pose& X_CM, double size_m) {
  const double h = size_m / 2;
  std::vector<cv::Point3d> points;
  for (const auto& [x, y] : {std::pair{-h, h}, {h, h}, {h, -h}, {-h, -h}}) {
    const Eigen::Vector3d p = X_CM * Eigen::Vector3d(x, y, 0);
    points.emplace_back(p.x(), p.y(), p.z());
  }
  const cv::Matx33d K(c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1);
  std::vector<cv::Point2d> pixels;
  cv::projectPoints(points, cv::Vec3d(), cv::Vec3d(), K, c.distortion, pixels);
  Corners corners;
  for (int k = 0; k < 4; ++k) corners[k] = {pixels[k].x, pixels[k].y};
  return corners;
}

struct Comparison {
  int num_tags = 0;
  double worst_px = 0;
  double mean_px = 0;
  Eigen::Vector2d bias_px = Eigen::Vector2d::Zero();
};

/// Detected against projected corners of the tags that are no more tilted than `max_tilt_deg`.
Comparison compare(const Scene& scene, const CameraCalibration& calibration,
                   const sim_state_t& state, const cv::Mat& image, double max_tilt_deg) {
  Comparison result;
  const Pose X_CW = from_message(state.X_WC).inverse();
  for (const auto& [id, corners] : detect(image)) {
    const std::optional<double> size_m = scene.markers().size_m(id);
    if (!size_m) {
      ADD_FAILURE() << "tag " << id << " is not in the scene";
      continue;
    }
    const Pose X_CM = X_CW * from_message(state.X_WG[scene.tag_geom(id)]) *
                      Eigen::Translation3d(0, 0, -kSheetThickness_m / 2);
    const double cosine = X_CM.translation().normalized().dot(X_CM.linear().col(2));
    if (cosine < std::cos(max_tilt_deg * kDegree)) continue;
    const Corners expected = project(calibration, X_CM, *size_m);
    for (int k = 0; k < 4; ++k) {
      const Eigen::Vector2d error = corners[k] - expected[k];
      result.worst_px = std::max(result.worst_px, error.norm());
      result.mean_px += error.norm();
      result.bias_px += error;
    }
    ++result.num_tags;
  }
  result.mean_px /= std::max(1, 4 * result.num_tags);
  result.bias_px /= std::max(1, 4 * result.num_tags);
  return result;
}

/// A camera `distance_m` in front of tag `id`, turned so that it sees it tilted and rotated.
void look_at(const Scene& scene, int id, double distance_m, double tilt_deg, double roll_deg,
             sim_state_t& state) {
  const Pose X_WM = from_message(state.X_WG[scene.tag_geom(id)]) *
                    Eigen::Translation3d(0, 0, -kSheetThickness_m / 2);
  Pose X_CM = Pose::Identity();
  X_CM.translation() = Eigen::Vector3d(0.03, -0.02, distance_m);
  X_CM.linear() = (Eigen::AngleAxisd(roll_deg * kDegree, Eigen::Vector3d::UnitZ()) *
                   Eigen::AngleAxisd(tilt_deg * kDegree, Eigen::Vector3d(0.6, 0.8, 0)))
                      .toRotationMatrix();
  state.X_WC = to_message(Pose(X_WM * X_CM.inverse()));
}

ImageEffects no_noise() {
  ImageEffects effects;
  effects.noise_sd = 0;
  return effects;
}

TEST(SceneRenderer, ShowsTheTagsCornersWherePinholeProjectionPutsThem) {
  const Scene scene(kConfig / "arm2");
  // Pixels that are far from square, and the centre far from the middle.
  CameraCalibration calibration{"test", 1280, 960, 1100, 1040, 590.3, 521.7, {}, {}};
  SceneRenderer renderer(kConfig / "arm2", calibration, no_noise());
  sim_state_t state = scene.state_at(scene.robot().home, 1, 0);
  for (const double tilt_deg : {0.0, 20.0, 40.0}) {
    for (const double roll_deg : {10.0, 75.0, 160.0, -100.0}) {
      look_at(scene, 12, 0.7, tilt_deg, roll_deg, state);
      const cv::Mat image = renderer.render(state, 0);
      const std::map<int, Corners> found = detect(image);
      ASSERT_TRUE(found.contains(12)) << tilt_deg << " " << roll_deg;
      const Pose X_CM = from_message(state.X_WC).inverse() *
                        from_message(state.X_WG[scene.tag_geom(12)]) *
                        Eigen::Translation3d(0, 0, -kSheetThickness_m / 2);
      const Corners expected = project(calibration, X_CM, scene.markers().find(12)->size_m);
      for (int k = 0; k < 4; ++k) {
        EXPECT_LT((found.at(12)[k] - expected[k]).norm(), 0.2)
            << "corner " << k << ", tilt " << tilt_deg << ", roll " << roll_deg << ": "
            << (found.at(12)[k] - expected[k]).transpose();
      }
    }
  }
}

// Sampled before it is blurred, an edge along the pixels' columns would look different wherever it
// lies between them, and be fitted 0.02 px off.
TEST(SceneRenderer, AnEdgeAlongThePixelsIsBlurredBeforeItIsSampled) {
  const Scene scene(kConfig / "arm2");
  const CameraCalibration calibration{"test", 640, 480, 1100, 1100, 319.5, 239.5, {}, {}};
  ImageEffects effects = no_noise();
  effects.pixel_samples = 2;
  SceneRenderer renderer(kConfig / "arm2", calibration, effects);
  sim_state_t state = scene.state_at(scene.robot().home, 1, 0);
  for (const double phase_px : {0.0, 0.2, 0.4, 0.6, 0.8}) {
    constexpr double kDistance_m = 0.7;
    look_at(scene, 12, kDistance_m, 0, 0, state);
    Pose X_WC = from_message(state.X_WC);
    X_WC = X_WC * Eigen::Translation3d(-phase_px / calibration.fx * kDistance_m, 0, 0);
    state.X_WC = to_message(X_WC);
    const cv::Mat image = renderer.render(state, 0);
    const Pose X_CM = X_WC.inverse() * from_message(state.X_WG[scene.tag_geom(12)]) *
                      Eigen::Translation3d(0, 0, -kSheetThickness_m / 2);
    const Corners corners = project(calibration, X_CM, scene.markers().find(12)->size_m);
    // The middle of the left side: paper, then the black border, a cell wide.
    const double edge_px = corners[0].x();
    const int row = static_cast<int>(std::lround(0.5 * (corners[0].y() + corners[3].y())));
    const int middle = static_cast<int>(std::lround(edge_px));
    const auto grey = [&](int u) { return static_cast<double>(image.at<std::uint8_t>(row, u)); };
    const double white = grey(middle - 5), black = grey(middle + 5);
    ASSERT_GT(white - black, 100);
    for (int u = middle - 4; u <= middle + 4; ++u) {
      double light = 0;
      constexpr int kSteps = 100;
      for (int i = 0; i < kSteps; ++i) {
        const double x = u - 0.5 + (i + 0.5) / kSteps;
        light += std::erfc((x - edge_px) / (effects.blur_sd_px * M_SQRT2)) / 2 / kSteps;
      }
      EXPECT_NEAR(grey(u), black + (white - black) * light, 4) << phase_px << " px, column " << u;
    }
  }
}

// The blur is computed only where the robot is: nothing of it may be cut off, at the image's border
// either, where the robot is half in view or not at all.
TEST(SceneRenderer, TheBlurIsThatOfTheWholeImage) {
  const Scene scene(kConfig / "arm2");
  const CameraCalibration calibration{"test", 640, 480, 600, 600, 319.5, 239.5, {}, {}};
  sim_state_t state = scene.state_at(scene.robot().home, 1, 0);
  const Pose X_WC = from_message(state.X_WC);
  for (const double blur_sd_px : {0.7, 4.0}) {
    ImageEffects sharp = no_noise(), blurred = no_noise();
    sharp.blur_sd_px = 0;
    blurred.blur_sd_px = blur_sd_px;
    SceneRenderer without(kConfig / "arm2", calibration, sharp);
    SceneRenderer with(kConfig / "arm2", calibration, blurred);
    for (const double pan_deg : {0.0, 25.0, -25.0, 90.0}) {
      state.X_WC =
          to_message(Pose(X_WC * Eigen::AngleAxisd(pan_deg * kDegree, Eigen::Vector3d::UnitY())));
      cv::Mat expected;
      without.render(state, 0).convertTo(expected, CV_32F);
      cv::GaussianBlur(expected, expected, {}, blur_sd_px);
      cv::Mat image;
      with.render(state, 0).convertTo(image, CV_32F);
      EXPECT_LT(cv::norm(image, expected, cv::NORM_INF), 1) << blur_sd_px << " px, " << pan_deg;
    }
  }
}

class RenderedRig : public testing::TestWithParam<const char*> {};

INSTANTIATE_TEST_SUITE_P(SceneRenderer, RenderedRig,
                         testing::Values("arm2", "arm4", "arm6_ends", "arm7"),
                         [](const auto& info) { return std::string(info.param); });

TEST_P(RenderedRig, ShowsItsTagsToTheDetectorWithoutBias) {
  const Scene scene(kConfig / GetParam());
  SceneRenderer renderer(kConfig / GetParam());
  const sim_state_t state = scene.state_at(scene.robot().home, 1, 0);
  const cv::Mat image = renderer.render(state, 0);
  ASSERT_EQ(image.cols, renderer.calibration().width);
  ASSERT_EQ(image.rows, renderer.calibration().height);
  ASSERT_EQ(image.type(), CV_8UC1);
  const Comparison result = compare(scene, renderer.calibration(), state, image, 60);
  RecordProperty("mean_px", std::to_string(result.mean_px));
  EXPECT_GE(result.num_tags, static_cast<int>(scene.markers().parts().size()) - 1);
  EXPECT_LT(result.mean_px, 0.25);
  EXPECT_LT(result.bias_px.norm(), 0.1) << result.bias_px.transpose();
}

TEST_P(RenderedRig, ShowsTheTagsAndTheLensOfTheRobotWithCalibrationErrors) {
  const SceneDescription drawn = SceneDescription::load(kConfig / GetParam(), 3);
  const Scene scene(drawn);
  SceneRenderer renderer(drawn, no_noise());
  const sim_state_t state = scene.state_at(scene.robot().home, 3, 0);
  const cv::Mat image = renderer.render(state, 0);
  const Comparison result = compare(scene, renderer.calibration(), state, image, 60);
  EXPECT_GE(result.num_tags, static_cast<int>(scene.markers().parts().size()) - 1);
  EXPECT_LT(result.mean_px, 0.25);
  EXPECT_LT(result.bias_px.norm(), 0.1) << result.bias_px.transpose();
  // Through the lens of camera_info.yaml the same tags are elsewhere.
  const CameraCalibration claimed =
      load_camera_calibration(kConfig / GetParam() / "camera_info.yaml");
  EXPECT_GT(compare(scene, claimed, state, image, 60).mean_px, 2 * result.mean_px);
}

TEST(SceneRenderer, DistortsAsOpenCvProjects) {
  const Scene scene(kConfig / "arm2");
  using Model = CameraCalibration::Model;
  for (const auto& [model, coefficients] :
       {std::pair{Model::kPlumbBob, std::vector<double>{-0.22, 0.1, 0.001, -0.0015, -0.02}},
        std::pair{Model::kRational,
                  std::vector<double>{0.1, -0.05, 0.0008, 0.0005, 0.01, 0.3, -0.02, 0.004}}}) {
    const CameraCalibration calibration{"test", 1280,  960,   1104.6,      1090.9,
                                        655.2,  470.8, model, coefficients};
    SceneRenderer renderer(kConfig / "arm2", calibration, no_noise());
    sim_state_t state = scene.state_at(scene.robot().home, 1, 0);
    int num_tags = 0;
    // Tags all over the image, also in strong distortion; small ones, since the detector fits
    // straight lines to curves.
    for (const double right : {-0.45, -0.25, 0.0, 0.25, 0.45}) {
      look_at(scene, 12, 1.3, 25, 15, state);
      const Pose X_WC = from_message(state.X_WC) * Eigen::Translation3d(right, right / 2, 0);
      state.X_WC = to_message(Pose(X_WC));
      const Comparison result = compare(scene, calibration, state, renderer.render(state, 0), 45);
      EXPECT_LT(result.worst_px, 0.3) << right;
      EXPECT_LT(result.bias_px.norm(), 0.1) << right;
      num_tags += result.num_tags;
    }
    EXPECT_GE(num_tags, 5);
  }
}

TEST(SceneRenderer, GivesTheSameBytesForTheSameStateAndFrame) {
  const Scene scene(kConfig / "arm2");
  SceneRenderer one(kConfig / "arm2");
  SceneRenderer other(kConfig / "arm2");
  const sim_state_t state = scene.state_at(scene.robot().home, 5, 9);
  const cv::Mat first = one.render(state, 0);
  // Another state in between must leave no trace.
  one.render(scene.state_at(Eigen::Vector2d(0.5, 20), 5, 10), 3);
  EXPECT_EQ(cv::norm(first, one.render(state, 0), cv::NORM_INF), 0);
  EXPECT_EQ(cv::norm(first, other.render(state, 0), cv::NORM_INF), 0);
}

TEST(SceneRenderer, DrawsNoiseOfItsOwnForEveryFrameActionAndSeed) {
  const Scene scene(kConfig / "arm2");
  SceneRenderer renderer(kConfig / "arm2");
  SceneRenderer clean(kConfig / "arm2", no_noise());
  const Eigen::VectorXd home = scene.robot().home;
  const cv::Mat image = renderer.render(scene.state_at(home, 5, 9), 0);
  EXPECT_NE(cv::norm(image, renderer.render(scene.state_at(home, 5, 9), 1), cv::NORM_INF), 0);
  EXPECT_NE(cv::norm(image, renderer.render(scene.state_at(home, 5, 8), 0), cv::NORM_INF), 0);
  EXPECT_NE(cv::norm(image, renderer.render(scene.state_at(home, 6, 9), 0), cv::NORM_INF), 0);

  cv::Mat difference;
  cv::subtract(image, clean.render(scene.state_at(home, 5, 9), 0), difference, cv::noArray(),
               CV_64F);
  cv::Scalar mean, sd;
  cv::meanStdDev(difference, mean, sd);
  EXPECT_NEAR(mean[0], 0, 0.02);
  EXPECT_NEAR(sd[0], std::sqrt(2 * 2 + 1 / 12.0), 0.02);
}

TEST(SceneRenderer, DoesNotShowWhatHasAlphaZero) {
  const Scene scene(kConfig / "arm2");
  SceneRenderer renderer(kConfig / "arm2");
  sim_state_t state = scene.state_at(scene.robot().home, 1, 0);
  ASSERT_TRUE(detect(renderer.render(state, 0)).contains(4));
  for (const int geom : scene.plate_geoms(2)) state.geom_alpha[geom] = 0;
  const auto found = detect(renderer.render(state, 0));
  EXPECT_FALSE(found.contains(4));
  EXPECT_FALSE(found.contains(5));
  EXPECT_TRUE(found.contains(0));
}

/// SIM_STATE of a broken arm at the start pose. Its camera knows the rig alone.
sim_state_t broken_state(const std::string& rig, const std::vector<Fault>& faults) {
  const SceneDescription as_built = SceneDescription::load(kConfig / rig);
  const Eigen::VectorXd joints = as_built.robot.joint_positions(as_built.robot.home);
  const Scene scene(broken(as_built, faults, joints, 1));
  return scene.state_at(as_built.robot.home, 1, 0);
}

std::vector<Fault> one_fault(std::int8_t kind, const std::string& place, int number,
                             double amount_deg = 0, double bent_deg = 0) {
  Fault fault;
  fault.kind = kind;
  fault.place = place;
  fault.number = number;
  fault.amount_deg = amount_deg;
  fault.bent_deg = bent_deg;
  return {fault};
}

TEST(SceneRenderer, ShowsEveryFaultBySimStateAlone) {
  using Command = fault_command_t;
  const Scene whole(kConfig / "arm7");
  SceneRenderer renderer(kConfig / "arm7");
  const auto before = detect(renderer.render(broken_state("arm7", {}), 0));
  ASSERT_TRUE(before.contains(12) && before.contains(15) && before.contains(28));
  const std::vector<std::vector<Fault>> cases = {
      one_fault(Command::FAULT_BEND, "upper_arm", -1, 6),
      one_fault(Command::FAULT_DRIFT, "forearm", -1, 0.1, -7),
      one_fault(Command::FAULT_TOOL, "", 1),
      one_fault(Command::FAULT_MARKER_MOVED, "", 12),
      one_fault(Command::FAULT_CAMERA_BUMP, "", -1),
  };
  for (const std::vector<Fault>& faults : cases) {
    const sim_state_t state = broken_state("arm7", faults);
    const cv::Mat image = renderer.render(state, 0);
    // The detector finds the tags at the places of the state …
    const Comparison result = compare(whole, renderer.calibration(), state, image, 60);
    const std::string what = describe(faults[0], whole.description());
    EXPECT_GE(result.num_tags, 8) << what;
    EXPECT_LT(result.mean_px, 0.25) << what;
    EXPECT_LT(result.bias_px.norm(), 0.1) << what;
    // … and some of these have changed.
    double farthest_px = 0;
    for (const auto& [id, corners] : detect(image)) {
      if (!before.contains(id)) continue;
      for (int k = 0; k < 4; ++k) {
        farthest_px = std::max(farthest_px, (corners[k] - before.at(id)[k]).norm());
      }
    }
    EXPECT_GT(farthest_px, 5) << what;
  }
}

TEST(SceneRenderer, ShowsAFallenMarkerOnTheFloor) {
  const Scene whole(kConfig / "arm7");
  SceneRenderer renderer(kConfig / "arm7", no_noise());
  sim_state_t state = broken_state("arm7", {});
  ASSERT_TRUE(detect(renderer.render(state, 0)).contains(15));
  std::vector<Fault> faults = one_fault(fault_command_t::FAULT_MARKER_LOST, "", 15);
  faults[0].fallen = {0.5, 0.1, 0.4};
  state = broken_state("arm7", faults);
  const auto found = detect(renderer.render(state, 0));
  EXPECT_TRUE(found.contains(12));
  if (found.contains(15)) {
    // Seen at a flat angle, below the base's tags.
    EXPECT_GT(found.at(15)[0].y(), found.begin()->second[0].y());
  }
  // From above it is plain.
  look_at(whole, 15, 0.6, 30, 20, state);
  const Comparison from_above =
      compare(whole, renderer.calibration(), state, renderer.render(state, 0), 45);
  EXPECT_TRUE(detect(renderer.render(state, 0)).contains(15));
  EXPECT_LT(from_above.worst_px, 0.5);
}

TEST(SceneRenderer, ShowsATargetTagWhereItFloatsAndWhereItIsPut) {
  const test::TargetRig rig(kConfig / "arm2", "0.4, -0.2, 1.7");
  const SceneDescription as_built = SceneDescription::load(rig.folder());
  const Scene scene(as_built);
  SceneRenderer renderer(rig.folder());
  const auto corner_px = [&](const std::vector<Fault>& faults) {
    const Scene now(
        broken(as_built, faults, as_built.robot.joint_positions(as_built.robot.home), 1));
    const sim_state_t state = now.state_at(as_built.robot.home, 1, 0);
    const cv::Mat image = renderer.render(state, 0);
    EXPECT_LT(compare(scene, renderer.calibration(), state, image, 60).mean_px, 0.25);
    const auto found = detect(image);
    EXPECT_TRUE(found.contains(0) && found.contains(40));
    return found.at(40)[0];
  };
  const Eigen::Vector2d before = corner_px({});
  Fault put;
  put.kind = fault_command_t::FAULT_TARGET;
  put.number = 40;
  put.target_m = Eigen::Vector3d(0.3, -0.1, 1.7);
  const Eigen::Vector2d shift = corner_px({put}) - before;
  EXPECT_NEAR(shift.x(), -0.1 / 1.7 * 1104.6, 1);
  EXPECT_NEAR(shift.y(), 0.1 / 1.7 * 1098.9, 1);
}

TEST(SceneRenderer, RefusesTheStateOfAnotherRig) {
  const Scene other(kConfig / "arm4");
  SceneRenderer renderer(kConfig / "arm2");
  EXPECT_THROW(renderer.render(other.state_at(other.robot().home, 1, 0), 0), std::invalid_argument);
}

}  // namespace
}  // namespace bodyschema
