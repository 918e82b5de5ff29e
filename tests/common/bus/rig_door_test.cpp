#include "common/bus/rig_door.h"

#include <gtest/gtest.h>

#include "common/bus/convert.h"

namespace bodyschema {
namespace {

const std::filesystem::path kConfig = BODYSCHEMA_CONFIG;

/// A sample of the rig: all parts, the first tag of each.
sample_t sample_of(const std::filesystem::path& rig) {
  sample_t sample{};
  set_array(sample.num_signals, sample.action,
            std::vector<double>(load_signals(rig).signals.size(), 0.1));
  const Markers markers = load_markers(rig);
  std::vector<part_observation_t> parts;
  for (const int part : markers.parts()) {
    part_observation_t& observation = parts.emplace_back();
    observation.part_id = part;
    for (const TagPlacement& tag : markers.tags) {
      if (tag.part != part) continue;
      tag_corners_t corners{};
      corners.tag_id = tag.id;
      set_array(observation.num_tags, observation.tags, {corners});
      break;
    }
  }
  set_array(sample.num_parts, sample.parts, std::move(parts));
  return sample;
}

body_schema_t schema_of(const std::filesystem::path& rig) {
  body_schema_t schema{};
  std::vector<signal_t> signals;
  for (const Signal& signal : load_signals(rig).signals) {
    signal_t& message = signals.emplace_back();
    message.signal_name = signal.name;
    message.lower_limit = message.covered_lower = signal.lower;
    message.upper_limit = message.covered_upper = signal.upper;
  }
  set_array(schema.num_signals, schema.signals, std::move(signals));
  set_array(schema.num_parts, schema.part_ids, load_markers(rig).parts());
  return schema;
}

marker_poses_t poses_of(const std::filesystem::path& rig) {
  marker_poses_t poses{};
  poses.camera_name = rig.filename().string() + "_camera";
  std::vector<marker_pose_t> markers;
  for (const TagPlacement& tag : load_markers(rig).tags) {
    marker_pose_t& marker = markers.emplace_back();
    marker.marker_id = tag.id;
    marker.size_m = tag.size_m;
  }
  set_array(poses.num_markers, poses.markers, std::move(markers));
  return poses;
}

motion_status_t status_with(std::size_t num_signals) {
  motion_status_t status{};
  set_array(status.num_signals, status.commanded, std::vector<double>(num_signals));
  return status;
}

TEST(RigDoor, EveryRigsOwnMessagesComeInAndNoOthers) {
  const std::vector<std::string> rigs = {"arm2", "arm4", "arm6_ends", "arm7"};
  for (const std::string& host : rigs) {
    const RigDoor door(kConfig / host);
    for (const std::string& guest : rigs) {
      const auto rig = kConfig / guest;
      const bool is_own = host == guest;
      EXPECT_EQ(door.objection(sample_of(rig)).empty(), is_own) << host << " " << guest;
      EXPECT_EQ(door.objection(schema_of(rig)).empty(), is_own) << host << " " << guest;
      EXPECT_EQ(door.objection(poses_of(rig)).empty(), is_own) << host << " " << guest;
      EXPECT_EQ(door.objection(status_with(load_signals(rig).signals.size())).empty(), is_own)
          << host << " " << guest;
    }
  }
}

TEST(RigDoor, ASmallDifferenceIsEnough) {
  const auto rig = kConfig / "arm2";
  const RigDoor door(rig);
  sample_t sample = sample_of(rig);
  sample.parts[1].tags[0].tag_id = sample.parts[0].tags[0].tag_id;
  EXPECT_NE(door.objection(sample).find("does not belong to part"), std::string::npos);
  sample = sample_of(rig);
  sample.parts.back().part_id = 99;
  EXPECT_NE(door.objection(sample).find("part 99"), std::string::npos);

  body_schema_t schema = schema_of(rig);
  schema.signals[0].signal_name += "x";
  EXPECT_NE(door.objection(schema), "");
  schema = schema_of(rig);
  schema.signals[1].upper_limit += 0.001;
  EXPECT_NE(door.objection(schema), "");
  schema = schema_of(rig);
  schema.part_ids.back() = 99;
  EXPECT_NE(door.objection(schema), "");

  marker_poses_t poses = poses_of(rig);
  poses.markers[0].size_m *= 1.01;
  EXPECT_NE(door.objection(poses), "");
  poses = poses_of(rig);
  poses.camera_name = "webcam";
  EXPECT_NE(door.objection(poses), "");

  model_health_t health{};
  part_health_t part{};
  part.health_part = 6;
  set_array(health.num_parts, health.part_health, {part});
  EXPECT_NE(door.objection(health), "");
}

// A markers.yaml edited between two processes' starts.
TEST(RigDoor, AnotherCalibrationOfTheTagsOrLensIsRefused) {
  const auto rig = kConfig / "arm2";
  const RigDoor door(rig);
  EXPECT_EQ(door.calibration_id(), calibration_id(rig));
  sample_t sample = sample_of(rig);
  body_schema_t schema = schema_of(rig);
  marker_poses_t poses = poses_of(rig);
  const auto objections = [&](std::int64_t id) {
    sample.calibration_id = schema.calibration_id = poses.calibration_id = id;
    return std::vector{door.objection(sample), door.objection(schema), door.objection(poses)};
  };
  for (const std::string& why : objections(0)) EXPECT_EQ(why, "") << "not told";
  for (const std::string& why : objections(door.calibration_id())) EXPECT_EQ(why, "");
  for (const std::string& why : objections(door.calibration_id() + 1)) {
    EXPECT_TRUE(why.starts_with("of another calibration of the tags or lens: ")) << why;
    EXPECT_NE(why.find("start"), std::string::npos) << "what to do: " << why;
  }
}

/// As the camera of the rig sends it.
camera_info_t info_of(const std::filesystem::path& rig) {
  const CameraCalibration calibration = load_camera_calibration(rig / "camera_info.yaml");
  camera_info_t info{};
  info.camera_name = calibration.camera_name;
  info.image_width = calibration.width;
  info.image_height = calibration.height;
  info.fx = calibration.fx;
  info.fy = calibration.fy;
  info.cx = calibration.cx;
  info.cy = calibration.cy;
  info.distortion_model = static_cast<std::int8_t>(calibration.model);
  set_array(info.num_coefficients, info.distortion, calibration.distortion);
  return info;
}

// Intrinsics that differed by a sixth gave an error of 20 mm and a reported one of 0.9 mm.
TEST(RigDoor, ACalibrationMustBeTheRigsOwnToTheLastNumber) {
  for (const char* rig : {"arm2", "arm4", "arm6_ends", "arm7"}) {
    const RigDoor door(kConfig / rig);
    EXPECT_EQ(door.objection(info_of(kConfig / rig)), "") << rig;
  }
  const RigDoor door(kConfig / "arm2");
  const camera_info_t own = info_of(kConfig / "arm2");
  camera_info_t info = own;
  info.fx = 1159.1;
  EXPECT_EQ(door.objection(info), "fx 1159.1 px, the rig's camera_info.yaml says 1104.6");
  for (double camera_info_t::*number :
       {&camera_info_t::fx, &camera_info_t::fy, &camera_info_t::cx, &camera_info_t::cy}) {
    info = own;
    info.*number += 0.001;
    EXPECT_NE(door.objection(info), "");
    info.*number = own.*number * (1 + 1e-12);  // written as text and read again
    EXPECT_EQ(door.objection(info), "");
  }
  info = own;
  info.image_height = 720;
  EXPECT_NE(door.objection(info), "");
  info = own;
  info.camera_name = "webcam";
  EXPECT_NE(door.objection(info), "");

  info = own;
  set_array(info.num_coefficients, info.distortion, {0.1, 0, 0, 0, 0});
  EXPECT_EQ(door.objection(info),
            "distortion plumb_bob [0.1, 0, 0, 0, 0], the rig's camera_info.yaml says plumb_bob []");
  info.distortion[0] = 0;  // no distortion, said in another way
  EXPECT_EQ(door.objection(info), "");
  info.distortion_model = camera_info_t::MODEL_RATIONAL;
  EXPECT_EQ(door.objection(info), "");
  info.distortion_model = camera_info_t::MODEL_FISHEYE;
  set_array(info.num_coefficients, info.distortion, {0, 0, 0, 0});
  EXPECT_NE(door.objection(info), "") << "a fisheye lens bends without any coefficient";
}

TEST(RigDoor, AnAnswerToAHoldEchoesNoAction) {
  const RigDoor door(kConfig / "arm2");
  motion_status_t status = status_with(0);
  status.action_id = 3;
  status.kind = action_command_t::KIND_HOLD;
  EXPECT_EQ(door.objection(status), "");
  status.kind = action_command_t::KIND_MOVE;
  EXPECT_NE(door.objection(status), "");
  status.action_id = -1;  // nothing was asked of the driver yet
  EXPECT_EQ(door.objection(status), "");
}

}  // namespace
}  // namespace bodyschema
