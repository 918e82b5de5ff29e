#pragma once

#include <gtest/gtest.h>

#include <random>

#include "bodyschema/action_command_t.hpp"
#include "common/bus/convert.h"
#include "common/geometry/angle.h"
#include "processes/marker_estimator/tag_pose.h"
#include "processes/observer/observer.h"

// What the observer's tests have in common: a rig, the sights of its frames and a driver.

namespace bodyschema::test {

inline constexpr std::int64_t kRest_us = 2'000'000;

inline camera_info_t camera() {
  camera_info_t info{};
  info.camera_name = "test";
  info.image_width = 1280;
  info.image_height = 960;
  info.fx = info.fy = 1159;
  info.cx = 640;
  info.cy = 480;
  return info;
}

inline ObserverConfig config() {
  ObserverConfig config;
  config.frames_per_sample = 2;
  config.max_buffered_frames = 8;
  config.max_motion_px = 1;
  config.part_pose.max_tag_error_px = 1.5;
  config.part_pose.min_other_rotation_rad = 2 * kDegree;
  config.part_pose.max_error_ratio = 10;
  return config;
}

/// Part 1 carries tags 1 and 2 at a right angle and 3 beside 1; part 2 one tag of unknown
/// placement.
inline Markers markers() {
  Markers markers;
  markers.family = "tag36h11";
  Pose X_BM2 = Pose::Identity();
  X_BM2.linear() = exp_so3(Eigen::Vector3d(0, -M_PI / 2, 0));
  X_BM2.translation() = Eigen::Vector3d(0.05, 0, 0.05);
  Pose X_BM3 = Pose::Identity();
  X_BM3.translation() = Eigen::Vector3d(-0.1, 0, 0);
  markers.tags = {{1, 0.08, 1, Pose::Identity()},
                  {2, 0.08, 1, X_BM2},
                  {3, 0.08, 1, X_BM3},
                  {5, 0.08, 2, std::nullopt}};
  return markers;
}

/// Part 1 so that tags 1, 2 and 3 are seen at less than 60°.
inline Pose X_CB1() {
  Pose X = Pose::Identity();
  X.linear() = exp_so3(Eigen::Vector3d(0.3, 0, 0)) * exp_so3(Eigen::Vector3d(0, 0.75, 0));
  X.translation() = Eigen::Vector3d(0.05, -0.03, 0.9);
  return X;
}

inline Pose X_CB2() {
  Pose X = Pose::Identity();
  X.linear() = exp_so3(Eigen::Vector3d(0, 0.6, 0.2));
  X.translation() = Eigen::Vector3d(-0.2, 0.1, 1.1);
  return X;
}

inline marker_pose_t sight_of(int id, const Pose& X_CM, double noise_px, std::mt19937& random) {
  const Lens lens(camera());
  std::normal_distribution<double> noise(0, 1);
  marker_pose_t marker{};
  marker.marker_id = id;
  marker.size_m = 0.08;
  std::vector<ImagePoint> points;
  const auto corners = tag_corners(0.08);
  for (int c = 0; c < 4; ++c) {
    const Eigen::Vector3d p_C = X_CM * corners[c];
    const Eigen::Vector2d p_px = lens.project(p_C.head<2>() / p_C.z()) +
                                 noise_px * Eigen::Vector2d(noise(random), noise(random));
    marker.corner_px[c][0] = p_px.x();
    marker.corner_px[c][1] = p_px.y();
    points.push_back(*lens.straighten(p_px));
  }
  to_message(Matrix8d(0.1 * 0.1 * Matrix8d::Identity()), marker.corner_covariance);
  const auto minima = solve_tag_pose(0.08, points);
  marker.num_hypotheses = static_cast<std::int8_t>(minima.size());
  for (int h = 0; h < 2; ++h) {
    const PoseFit& fit = minima.at(std::min<std::size_t>(h, minima.size() - 1));
    marker.X_CM[h] = to_message(fit.X_CB);
    marker.reprojection_error_px[h] = fit.rms_sigma;
  }
  return marker;
}

struct Scene {
  std::vector<int> tags = {1, 2, 3, 5};
  double noise_px = 0;
  Pose X_CB1_true = X_CB1();
  std::mt19937 random{1};

  marker_poses_t frame(std::int64_t utime) {
    std::vector<marker_pose_t> seen;
    const Markers all = markers();
    for (const int id : tags) {
      const TagPlacement& tag = *all.find(id);
      const Pose X_CB = tag.part == 1 ? X_CB1_true : X_CB2();
      seen.push_back(sight_of(id, X_CB * tag.X_BM.value_or(Pose::Identity()), noise_px, random));
    }
    marker_poses_t poses{};
    poses.utime = utime;
    poses.image_seq = utime / 1000;
    set_array(poses.num_markers, poses.markers, std::move(seen));
    return poses;
  }
};

inline motion_status_t status(std::int64_t action_id, std::int8_t state, std::int64_t utime,
                              std::int64_t rest_since) {
  motion_status_t status{};
  status.utime = utime;
  status.source = "motor_babbler";
  status.epoch = 77;
  status.action_id = action_id;
  status.kind = action_command_t::KIND_MOVE;
  status.purpose = action_command_t::PURPOSE_TEST;
  status.state = state;
  status.rest_since_utime = rest_since;
  set_array(status.num_signals, status.commanded, std::vector<double>{0.1, 0.2});
  return status;
}

inline motion_status_t settled(std::int64_t action_id, std::int64_t rest_since = kRest_us) {
  return status(action_id, motion_status_t::STATE_SETTLED, rest_since + 50'000, rest_since);
}
inline motion_status_t moving(std::int64_t action_id, std::int64_t utime) {
  return status(action_id, motion_status_t::STATE_MOVING, utime, -1);
}

inline Observer calibrated(const ObserverConfig& c = config()) {
  Observer observer(c, markers(), 99);
  observer.on_camera_info(camera());
  return observer;
}

inline double position_error(const sample_t& sample, std::size_t part, const Pose& truth) {
  return (from_message(sample.parts.at(part).X_CB).translation() - truth.translation()).norm();
}

}  // namespace bodyschema::test
