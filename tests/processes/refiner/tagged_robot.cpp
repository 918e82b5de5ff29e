#include "tests/processes/refiner/tagged_robot.h"

#include <cmath>
#include <map>

#include "common/config/calibration_id.h"
#include "processes/refiner/calibrated_lens.h"

namespace bodyschema::test {
namespace {

/// Tilts beyond which a tag is not read: as the estimator.
constexpr double kMostTilt_rad = 1.2;

Vector6d deviations_of(const TagCalibration& tags) {
  Vector6d sd;
  sd << Eigen::Vector3d::Constant(tags.position_m), Eigen::Vector3d::Constant(tags.rotation_rad);
  return sd;
}

}  // namespace

TaggedRobot tagged(const SyntheticRobot& robot, int tags_a_part, Rng& rng) {
  TaggedRobot result{robot, {}};
  for (const int part : robot.visible_parts()) {
    for (int n = 0; n < tags_a_part; ++n) {
      TagPlacement& tag = result.truth.markers.tags.emplace_back();
      tag.id = static_cast<int>(result.truth.markers.tags.size()) - 1;
      tag.size_m = 0.06;
      tag.part = part;
      tag.X_BM = random_pose(rng, 0.05, 0.05);
    }
  }
  CameraCalibration& camera = result.truth.camera;
  camera.width = 1280;
  camera.height = 960;
  camera.fx = camera.fy = 1100;
  camera.cx = 640;
  camera.cy = 480;
  camera.distortion = {-0.1, 0.02, 0.0005, -0.0005};
  return result;
}

RigCalibration claimed(const TaggedRobot& robot, const RigError& error, Rng& rng) {
  RigCalibration rig = robot.truth;
  bool is_first = true;
  for (TagPlacement& tag : rig.markers.tags) {
    const Vector6d step = deviations_of(error.tags).cwiseProduct(gaussian6(rng));
    if (!is_first) tag.X_BM = *tag.X_BM * exp(step);
    is_first = false;
    tag.size_m *= 1 + error.tags.size_share * gaussian(rng);
  }
  rig.camera.fx *= 1 + error.focal_length_share * gaussian(rng);
  rig.camera.fy *= 1 + error.focal_length_share * gaussian(rng);
  rig.camera.cx += error.centre_px * gaussian(rng);
  rig.camera.cy += error.centre_px * gaussian(rng);
  for (double& coefficient : rig.camera.distortion) coefficient += error.distortion * gaussian(rng);
  return rig;
}

std::vector<RefinerSample> seen_corners(const TaggedRobot& robot, const RigCalibration& rig,
                                        int num_samples, double noise_px, Rng& rng) {
  const Lens lens = lens_of(robot.truth.camera);
  const std::int64_t id = calibration_id(rig.markers, rig.camera);
  std::vector<RefinerSample> samples;
  for (int n = 0; n < num_samples; ++n) {
    RefinerSample& seen = samples.emplace_back();
    seen.sample.sample_index = n;
    seen.sample.utime = 1'000'000 * n;
    seen.sample.calibration_id = id;
    seen.sample.purpose = n % 5 == 4 ? Purpose::kTest : Purpose::kTrain;
    seen.sample.action = robot.robot.random_action(rng);
    const std::map<int, Pose> X_CB = robot.robot.poses_in_camera(seen.sample.action);
    std::map<int, PartObservation> observations;
    for (const TagPlacement& tag : robot.truth.markers.tags) {
      const Pose X_CM = X_CB.at(tag.part) * *tag.X_BM;
      const double cosine = X_CM.linear().col(2).dot(X_CM.translation().normalized());
      if (cosine < std::cos(kMostTilt_rad)) continue;
      TagSight& sight = seen.tags.emplace_back();
      sight.tag = tag.id;
      sight.covariance_px2 = std::pow(std::max(noise_px, 1e-3), 2) * Matrix8d::Identity();
      const auto corners = tag_corners(tag.size_m);
      for (int c = 0; c < 4; ++c) {
        const Eigen::Vector3d p_C = X_CM * corners[c];
        const double du = noise_px * gaussian(rng), dv = noise_px * gaussian(rng);
        sight.corners_px.segment<2>(2 * c) =
            lens.project(p_C.head<2>() / p_C.z()) + Eigen::Vector2d(du, dv);
      }
      PartObservation& observation = observations[tag.part];
      observation.part = tag.part;
      observation.X_CB = X_CM * rig.markers.find(tag.id)->X_BM->inverse();
      observation.covariance = isotropic({0.001, 0.005});
      observation.tags.push_back(tag.id);
    }
    for (const auto& [part, observation] : observations) seen.sample.parts.push_back(observation);
  }
  return samples;
}

}  // namespace bodyschema::test
