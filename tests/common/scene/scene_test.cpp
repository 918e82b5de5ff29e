#include "common/scene/scene.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <filesystem>
#include <fstream>

#include "common/bus/convert.h"
#include "common/config/camera_calibration.h"
#include "common/config/yaml.h"
#include "tests/support/text_of.h"

namespace bodyschema {
namespace {

const std::filesystem::path kConfig = BODYSCHEMA_CONFIG_FOLDER;

class ShippedRig : public testing::TestWithParam<const char*> {};

INSTANTIATE_TEST_SUITE_P(Scene, ShippedRig, testing::Values("arm2", "arm4", "arm6_ends", "arm7"),
                         [](const auto& info) { return std::string(info.param); });

TEST_P(ShippedRig, Loads) {
  const Scene scene(kConfig / GetParam());
  EXPECT_EQ(scene.robot().name, GetParam());
  EXPECT_LE(scene.model().ntex, 100);
  EXPECT_NO_THROW(load_camera_calibration(kConfig / GetParam() / "camera_info.yaml"));
}

TEST_P(ShippedRig, AcceptsEveryCornerOfItsSignalRanges) {
  const Scene scene(kConfig / GetParam());
  const auto& signals = scene.signals().signals;
  for (unsigned corner = 0; corner < 1U << signals.size(); ++corner) {
    Eigen::VectorXd action(signals.size());
    for (std::size_t i = 0; i < signals.size(); ++i) {
      action[i] = corner >> i & 1 ? signals[i].upper : signals[i].lower;
    }
    EXPECT_EQ(scene.robot().beyond_range(scene.robot().joint_positions(action)), std::nullopt);
  }
}

TEST_P(ShippedRig, PutsEveryPlateWhereItsPartIs) {
  const Scene scene(kConfig / GetParam());
  Eigen::VectorXd action = scene.robot().home;
  for (int i = 0; i < action.size(); ++i) action[i] += 0.1 * (i + 1);
  const sim_state_t state = scene.state_at(action, 7, 3);
  ASSERT_EQ(state.num_geoms, scene.model().ngeom);
  ASSERT_EQ(state.true_part, scene.markers().parts());
  EXPECT_EQ(state.seed, 7);
  EXPECT_EQ(state.action_id, 3);
  for (int i = 0; i < state.num_parts; ++i) {
    const Pose X_WB = from_message(state.X_WB[i]);
    for (const TagPlacement& tag : scene.markers().tags) {
      if (tag.part != state.true_part[i]) continue;
      // The sheet's geom is centred half its thickness behind the marker's plane.
      const Pose X_WM = from_message(state.X_WG[scene.tag_geom(tag.id)]) *
                        Eigen::Translation3d(0, 0, -kSheetThickness_m / 2);
      EXPECT_TRUE(X_WM.isApprox(X_WB * tag.X_BM.value_or(Pose::Identity()), 1e-9))
          << "tag " << tag.id;
    }
  }
}

TEST(Scene, TurnsAJointByGainTimesCommandPlusOffset) {
  const Scene scene(kConfig / "arm2");
  const RobotJoint& joint = scene.robot().joints[0];
  EXPECT_NE(joint.gain, 1);
  EXPECT_NE(joint.offset, 0);
  const sim_state_t zero = scene.state_at(Eigen::Vector2d(0, 0), 0, 0);
  const sim_state_t moved = scene.state_at(Eigen::Vector2d(0.3, 0), 0, 0);
  // Part 3 sits on the first moving link.
  const Pose X_33 = from_message(zero.X_WB[2]).inverse() * from_message(moved.X_WB[2]);
  EXPECT_NEAR(rotation_angle(X_33), std::abs(joint.gain) * 0.3, 1e-9);
  EXPECT_EQ(scene.robot().joint_positions(Eigen::Vector2d(0.3, 0))[0],
            joint.gain * 0.3 + joint.offset);
}

TEST(Scene, TurnsBothFingersOppositelyWithOneSignal) {
  const Scene scene(kConfig / "arm7");
  Eigen::VectorXd action = scene.robot().home;
  const Eigen::VectorXd before = scene.robot().joint_positions(action);
  action[6] += 10;
  const Eigen::VectorXd change = scene.robot().joint_positions(action) - before;
  EXPECT_TRUE(change.head(6).isZero());
  EXPECT_NE(change[6], 0);
  EXPECT_EQ(change[6], -change[7]);
}

TEST(Scene, NamesTheLinksThatCollide) {
  const Scene scene(kConfig / "arm7");
  const MjDataPtr data = scene.make_data();
  Eigen::VectorXd positions = Eigen::VectorXd::Zero(scene.robot().joints.size());
  EXPECT_EQ(scene.collision(*data), std::nullopt);
  positions[1] = positions[3] = positions[5] = 1.8;
  scene.set_joint_positions(*data, positions);
  ASSERT_TRUE(scene.collision(*data).has_value());
  EXPECT_NE(scene.collision(*data)->find("self-collision between link"), std::string::npos);
}

// A copy of arm2 in which one file differs.
std::filesystem::path changed_rig(const std::string& name, const std::string& file,
                                  const std::string& from, const std::string& to) {
  const std::filesystem::path folder =
      std::filesystem::path(testing::TempDir()) / ("bodyschema_" + name);
  std::filesystem::remove_all(folder);
  std::filesystem::copy(kConfig / "arm2", folder, std::filesystem::copy_options::recursive);
  std::string content = test::text_of(folder / file);
  const std::size_t at = content.find(from);
  EXPECT_NE(at, std::string::npos) << from;
  content.replace(at, from.size(), to);
  std::ofstream(folder / file) << content;
  return folder;
}

TEST(Scene, RefusesAnUnknownKeyOfRobotYaml) {
  const auto rig = changed_rig("unknown_key", "robot.yaml", "mass_kg:", "mass_g:");
  EXPECT_THROW(Scene{rig}, ConfigError);
}

TEST(Scene, RefusesAToolOnALinkThatIsNotThere) {
  const auto rig =
      changed_rig("unknown_tool_link", "robot.yaml", "tools:\n  link: arm", "tools:\n  link: leg");
  EXPECT_THROW(Scene{rig}, ConfigError);
}

TEST(Scene, AToolThatIsNotMountedHasNoMassAndIsNotSeen) {
  const Scene with(kConfig / "arm2");
  const auto rig = std::filesystem::path(testing::TempDir()) / "bodyschema_no_tools";
  std::filesystem::remove_all(rig);
  std::filesystem::copy(kConfig / "arm2", rig, std::filesystem::copy_options::recursive);
  const std::string whole = test::text_of(rig / "robot.yaml");
  std::ofstream(rig / "robot.yaml") << whole.substr(0, whole.find("tools:"));
  const Scene without(rig);
  ASSERT_EQ(with.model().ngeom, without.model().ngeom + 1);
  ASSERT_EQ(with.model().nbody, without.model().nbody);
  for (int i = 0; i < with.model().nbody; ++i) {
    EXPECT_EQ(with.model().body_mass[i], without.model().body_mass[i]);
  }
  const sim_state_t state = with.state_at(with.robot().home, 1, 0);
  EXPECT_EQ(std::count(state.geom_alpha.begin(), state.geom_alpha.end(), 0.0F), 1);
}

TEST(SceneDeathTest, AFatalErrorOfMujocoEndsTheProcessWithOneLine) {
  testing::FLAGS_gtest_death_test_style = "threadsafe";
  EXPECT_EXIT(
      {
        install_mujoco_handlers();
        mju_error("out of memory");
      },
      testing::ExitedWithCode(1), "MuJoCo cannot go on and ends the process: out of memory");
}

TEST(Scene, RefusesPartsThatMarkersYamlDoesNotKnow) {
  const auto rig = changed_rig("unknown_part", "robot.yaml", "part: 5", "part: 6");
  EXPECT_THROW(Scene{rig}, ConfigError);
}

TEST(Scene, RefusesATagOnAPartThatIsNotThere) {
  const auto rig =
      changed_rig("unknown_tag_part", "robot.yaml", "part: 1, placement", "part: 6, placement");
  EXPECT_THROW(Scene{rig}, ConfigError);
}

TEST(Scene, RefusesAStartPoseOutsideTheSignalLimits) {
  const auto rig = changed_rig("bad_home", "robot.yaml", "home: [0, 0]", "home: [0, 99]");
  EXPECT_THROW(Scene{rig}, ConfigError);
}

TEST(Scene, TakesTheTagItselfForThePartWherePlacementIsNone) {
  const auto rig = changed_rig("no_placement", "robot.yaml", "name: arm2", "name: arm2");
  // Leave one tag a part, without placement.
  const Scene scene(kConfig / "arm2");
  std::string content = test::text_of(rig / "robot.yaml");
  const std::size_t begin = content.find("tags:\n"), end = content.find("\n\n", begin);
  std::string tags = "tags:";
  for (const int part : scene.markers().parts()) {
    const std::string id = std::to_string(part);
    tags += "\n  - {id: " + id + ", size_m: 0.05, part: " + id + ", placement: none}";
  }
  std::ofstream(rig / "robot.yaml") << content.replace(begin, end - begin, tags);
  const Scene changed(rig);
  const sim_state_t state = changed.state_at(Eigen::Vector2d(0, 0), 0, 0);
  const Pose X_WM = from_message(state.X_WG[changed.tag_geom(5)]) *
                    Eigen::Translation3d(0, 0, -kSheetThickness_m / 2);
  EXPECT_TRUE(X_WM.isApprox(from_message(state.X_WB[4]), 1e-9));
}

}  // namespace
}  // namespace bodyschema
