#include "common/scene/calibration_error.h"

#include <gtest/gtest.h>

#include <cmath>
#include <fstream>
#include <vector>

#include "common/config/yaml.h"
#include "common/geometry/angle.h"
#include "common/scene/scene.h"
#include "tests/support/temporary_folder.h"
#include "tests/support/text_of.h"

namespace bodyschema {
namespace {

const std::filesystem::path kConfig = BODYSCHEMA_CONFIG_FOLDER;

Robot robot_of(const std::filesystem::path& rig, std::optional<std::int64_t> seed = std::nullopt) {
  return SceneDescription::load(rig, seed).robot;
}

/// Difference between a tag's place by the rig's files and its true one: translation [m], rotation
/// vector [rad].
Vector6d displacement(const TagPlacement& told, const TagPlacement& drawn) {
  const Pose X = told.X_BM.value().inverse() * drawn.X_BM.value();
  Vector6d result;
  result << X.translation(), log_so3(X.linear());
  return result;
}

bool is_same(const Robot& a, const Robot& b) {
  for (std::size_t i = 0; i < a.markers.tags.size(); ++i) {
    const TagPlacement &tag = a.markers.tags[i], &other = b.markers.tags[i];
    if (tag.size_m != other.size_m || tag.X_BM->matrix() != other.X_BM->matrix()) return false;
  }
  return a.lens.fx == b.lens.fx && a.lens.fy == b.lens.fy && a.lens.distortion == b.lens.distortion;
}

TEST(CalibrationError, IsTheSameForTheSameSeedAndAnotherForAnother) {
  EXPECT_TRUE(is_same(robot_of(kConfig / "arm4", 7), robot_of(kConfig / "arm4", 7)));
  EXPECT_FALSE(is_same(robot_of(kConfig / "arm4", 7), robot_of(kConfig / "arm4", 8)));
}

TEST(CalibrationError, IsNoneOfTheIdealRobotWhoseTablesAreTheRigsClaims) {
  for (const char* name : {"arm2", "arm4", "arm6_ends", "arm7"}) {
    const std::filesystem::path rig = kConfig / name;
    const Robot ideal = robot_of(rig);
    EXPECT_EQ(ideal.calibration_error, CalibrationError{});
    EXPECT_NE(robot_of(rig, 1).calibration_error, CalibrationError{});
    const Markers claimed = load_markers(rig);
    ASSERT_EQ(ideal.markers.tags.size(), claimed.tags.size());
    for (std::size_t i = 0; i < claimed.tags.size(); ++i) {
      const TagPlacement &tag = ideal.markers.tags[i], &claim = claimed.tags[i];
      EXPECT_EQ(tag.id, claim.id);
      EXPECT_EQ(tag.part, claim.part);
      EXPECT_EQ(tag.size_m, claim.size_m);
      EXPECT_EQ(tag.X_BM->matrix(), claim.X_BM->matrix());
    }
    const CameraCalibration calibration = load_camera_calibration(rig / "camera_info.yaml");
    EXPECT_EQ(ideal.lens.width, calibration.width);
    EXPECT_EQ(ideal.lens.height, calibration.height);
    EXPECT_EQ(ideal.lens.fx, calibration.fx);
    EXPECT_EQ(ideal.lens.fy, calibration.fy);
    EXPECT_EQ(ideal.lens.cx, calibration.cx);
    EXPECT_EQ(ideal.lens.cy, calibration.cy);
    std::vector<double> distortion = calibration.distortion;
    distortion.resize(ideal.lens.distortion.size());
    EXPECT_EQ(ideal.lens.distortion, distortion);
  }
}

TEST(CalibrationError, HasTheStandardDeviationsThatRobotYamlSays) {
  const Robot told = robot_of(kConfig / "arm7");
  const CalibrationError error = robot_of(kConfig / "arm7", 1).calibration_error;
  constexpr int kSeeds = 200;
  double position2 = 0, rotation2 = 0, size2 = 0, focal2 = 0, k1_2 = 0, mean_x = 0;
  const double count = kSeeds * static_cast<double>(told.markers.tags.size());
  Robot asked = told;
  asked.calibration_error = error;
  for (int seed = 0; seed < kSeeds; ++seed) {
    const Robot drawn = with_calibration_error(asked, seed);
    for (std::size_t i = 0; i < told.markers.tags.size(); ++i) {
      const Vector6d d = displacement(told.markers.tags[i], drawn.markers.tags[i]);
      position2 += d.head<3>().squaredNorm() / 3 / count;
      rotation2 += d.tail<3>().squaredNorm() / 3 / count;
      mean_x += d.x() / count;
      size2 += std::pow(drawn.markers.tags[i].size_m / told.markers.tags[i].size_m - 1, 2) / count;
    }
    EXPECT_NEAR(drawn.lens.fx / told.lens.fx, drawn.lens.fy / told.lens.fy, 1e-12);
    focal2 += std::pow(drawn.lens.fx / told.lens.fx - 1, 2) / kSeeds;
    k1_2 += std::pow(drawn.lens.distortion[0] - told.lens.distortion[0], 2) / kSeeds;
  }
  // 4 standard errors: 1/sqrt(2n) of a standard deviation.
  const auto expect_sd = [](double variance, double sd, double n) {
    EXPECT_NEAR(std::sqrt(variance) / sd, 1, 4 / std::sqrt(2 * n));
  };
  expect_sd(position2, error.tag_position_m, 3 * count);
  expect_sd(rotation2, error.tag_rotation_rad, 3 * count);
  expect_sd(size2, error.tag_size_share, count);
  expect_sd(focal2, error.focal_length_share, kSeeds);
  expect_sd(k1_2, error.distortion_k1, kSeeds);
  EXPECT_LT(std::abs(mean_x), 4 * error.tag_position_m / std::sqrt(count));
}

TEST(CalibrationError, OfOneTagHangsOnNoOther) {
  Robot robot = robot_of(kConfig / "arm4");
  robot.calibration_error.tag_position_m = 0.001;
  const Pose X_BM = *with_calibration_error(robot, 3).markers.tags.back().X_BM;
  robot.markers.tags.erase(robot.markers.tags.begin());
  EXPECT_EQ(with_calibration_error(robot, 3).markers.tags.back().X_BM->matrix(), X_BM.matrix());
}

// A lab's own files change only what the group assumes; the robot stays as it is.
TEST(CalibrationError, MovesWithNothingThatTheRigClaims) {
  const test::TemporaryFolder rig(kConfig / "arm4");
  const auto replace = [&](const std::string& file, const std::string& from,
                           const std::string& to) {
    std::string content = test::text_of(rig / file);
    ASSERT_NE(content.find(from), std::string::npos);
    content.replace(content.find(from), from.size(), to);
    std::ofstream(rig / file) << content;
  };
  replace("markers.yaml", "size_m: 0.08", "size_m: 0.081");
  replace("markers.yaml", "[0.056, 0, 0]", "[0.057, 0, 0]");
  replace("camera_info.yaml", "1092.4", "1095.4");
  EXPECT_TRUE(is_same(robot_of(rig.path()), robot_of(kConfig / "arm4")));
  EXPECT_TRUE(is_same(robot_of(rig.path(), 5), robot_of(kConfig / "arm4", 5)));
}

TEST(CalibrationError, PlayIsOnTheSideThatTheJointCameFrom) {
  const double width = 0.2;
  EXPECT_DOUBLE_EQ(play_after(1, 0, width), -0.1);
  EXPECT_DOUBLE_EQ(play_after(1, 2, width), 0.1);
  EXPECT_DOUBLE_EQ(play_after(1, 1.05, width), 1.05 - 1);  // moved within its play: the rest stays
  EXPECT_EQ(play_after(1, 2, 0), 0);
}

}  // namespace
}  // namespace bodyschema
