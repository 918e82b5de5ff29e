#include "common/config/calibration_id.h"

#include <gtest/gtest.h>

#include <filesystem>
#include <functional>
#include <set>

namespace bodyschema {
namespace {

struct Calibration {
  Markers markers;
  CameraCalibration camera;
  std::int64_t id() const { return calibration_id(markers, camera); }
};

Calibration example() {
  Calibration c;
  const Pose X_BM =
      Eigen::Translation3d(0.01, -0.02, 0.3) * Eigen::AngleAxisd(0.7, Eigen::Vector3d::UnitY());
  c.markers = {"tag36h11", {{3, 0.08, 1, std::nullopt}, {7, 0.05, 2, X_BM}}};
  c.camera = {"ceiling", 1280, 960, 1104.6, 1104.6, 639.5, 479.5, {}, {}};
  return c;
}

TEST(CalibrationId, IsStable) {
  // By the definition in calibration_id.h: changing it invalidates the calibration of recordings.
  EXPECT_EQ(static_cast<std::uint64_t>(example().id()), 0x99707F5C098858E0ULL);
}

TEST(CalibrationId, EveryValueCounts) {
  std::set<std::int64_t> ids = {example().id()};
  const std::function<void(Calibration&)> changes[] = {
      [](auto& c) { c.markers.tags[0].id = 2; },
      [](auto& c) { c.markers.tags[0].part = 5; },
      [](auto& c) { c.markers.tags[0].size_m += 1e-6; },
      [](auto& c) { c.markers.tags[0].X_BM = Pose::Identity(); },
      [](auto& c) { c.markers.tags[1].X_BM.reset(); },
      [](auto& c) { c.markers.tags[1].X_BM->translation().z() += 1e-6; },
      [](auto& c) {
        c.markers.tags[1].X_BM->rotate(Eigen::AngleAxisd(1e-6, Eigen::Vector3d::UnitX()));
      },
      [](auto& c) { c.markers.tags.pop_back(); },
      [](auto& c) { c.camera.width = 640; },
      [](auto& c) { c.camera.height = 480; },
      [](auto& c) { c.camera.fx += 0.001; },
      [](auto& c) { c.camera.fy += 0.001; },
      [](auto& c) { c.camera.cx += 0.001; },
      [](auto& c) { c.camera.cy += 0.001; },
      [](auto& c) { c.camera.distortion = {0.1}; },
      [](auto& c) {
        c.camera.distortion = {0, 0.1};
      },
      [](auto& c) { c.camera.model = CameraCalibration::Model::kFisheye; }};
  for (const auto& change : changes) {
    Calibration other = example();
    change(other);
    EXPECT_TRUE(ids.insert(other.id()).second);
  }
  EXPECT_FALSE(ids.contains(0));
}

TEST(CalibrationId, WhatSaysTheSameDoesNot) {
  const std::function<void(Calibration&)> changes[] = {
      [](auto& c) { c.camera.camera_name = "webcam"; },
      [](auto& c) {
        c.camera.distortion = {0, 0, 0, 0, 0};
      },
      [](auto& c) { c.camera.model = CameraCalibration::Model::kRational; },
      [](auto& c) { c.camera.fx *= 1 + 1e-15; },
      [](auto& c) {
        Pose& X = *c.markers.tags[1].X_BM;
        X.linear() = Eigen::AngleAxisd(0.7 - 2 * M_PI, Eigen::Vector3d::UnitY()).toRotationMatrix();
      }};
  for (const auto& change : changes) {
    Calibration other = example();
    change(other);
    EXPECT_EQ(other.id(), example().id());
  }
}

TEST(CalibrationId, EveryRigHasItsOwn) {
  std::set<std::int64_t> ids;
  for (const char* rig : {"arm2", "arm4", "arm6_ends", "arm7"})
    EXPECT_TRUE(ids.insert(calibration_id(std::filesystem::path(CONFIG) / rig)).second);
}

// A quaternion's sign says nothing, and at 120° rounding decides which one comes of a matrix.
TEST(CalibrationId, DoesNotDependOnTheSignOfAQuaternion) {
  std::set<std::int64_t> ids;
  for (const double angle : {-2 * M_PI / 3 - 1e-13, -2 * M_PI / 3 + 1e-13}) {
    Calibration c = example();
    c.markers.tags[1].X_BM = Pose(Eigen::AngleAxisd(angle, Eigen::Vector3d::UnitX()));
    ids.insert(c.id());
  }
  EXPECT_EQ(ids.size(), 1U);
}

}  // namespace
}  // namespace bodyschema
