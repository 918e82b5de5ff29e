#include <algorithm>
#include <cmath>

#include "common/geometry/angle.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema::test {

const char* name_of(Regime regime) {
  switch (regime) {
    case Regime::kFree:
      return "free";
    case Regime::kChapter:
      return "chapter";
    case Regime::kTag:
      return "tag";
    case Regime::kTagIso:
      return "tag_iso";
  }
  return "";
}

Noise nominal_noise(Regime regime) {
  switch (regime) {
    case Regime::kFree:
      return {1e-4, 0.02 * kDegree};
    case Regime::kChapter:
      return {0.0254, 6.1 * kDegree};
    case Regime::kTag:
      return {std::sqrt((2 * 0.0008 * 0.0008 + 0.0028 * 0.0028) / 3),
              std::sqrt((2 * 0.67 * 0.67 + 0.3 * 0.3) / 3) * kDegree};
    case Regime::kTagIso:
      return {0.003, 1 * kDegree};
  }
  return {};
}

std::set<int> facing_parts(const SyntheticRobot& robot, const Eigen::VectorXd& action,
                           double max_view_angle_rad) {
  const std::vector<int> visible = robot.visible_parts();
  if (max_view_angle_rad >= M_PI) return {visible.begin(), visible.end()};
  Eigen::VectorXd middle(robot.signals.size());
  for (std::size_t s = 0; s < robot.signals.size(); ++s)
    middle(s) = 0.5 * (robot.signals[s].lower + robot.signals[s].upper);
  // From the part to the camera, in the part's frame.
  const auto to_camera = [](const Pose& X_CB) { return X_CB.inverse().translation().normalized(); };
  const auto before = robot.poses_in_camera(middle), now = robot.poses_in_camera(action);
  std::set<int> result;
  for (const int part : visible) {
    const double cosine = to_camera(before.at(part)).dot(to_camera(now.at(part)));
    if (cosine >= std::cos(max_view_angle_rad)) result.insert(part);
  }
  return result;
}

/// A planar marker read in its other way: tilted about an axis in its plane.
static Pose flipped(const Pose& X, Rng& rng) {
  const double direction = uniform(rng, 0, 2 * M_PI);
  const Eigen::Vector3d axis(std::cos(direction), std::sin(direction), 0);
  Pose result = X;
  result.linear() = X.linear() * exp_so3(uniform(rng, 10, 60) * kDegree * axis);
  return result;
}

/// A root of the noise's covariance, root · rootᵀ.
static Matrix6d noise_root(Regime regime, const Pose& X_CB) {
  Matrix6d root = Matrix6d::Zero();
  if (regime == Regime::kTag) {
    const Eigen::Vector3d sight = X_CB.translation().normalized();
    Eigen::Matrix3d R_CS;  // line of sight along z
    R_CS.col(2) = sight;
    R_CS.col(0) = sight.unitOrthogonal();
    R_CS.col(1) = sight.cross(R_CS.col(0));
    root.topLeftCorner<3, 3>() =
        X_CB.linear().transpose() * R_CS * Eigen::Vector3d(0.0008, 0.0008, 0.0028).asDiagonal();
    root.diagonal().tail<3>() << 0.67 * kDegree, 0.67 * kDegree, 0.3 * kDegree;
  } else {
    const Noise noise = nominal_noise(regime);
    root.diagonal().head<3>().setConstant(noise.position_m);
    root.diagonal().tail<3>().setConstant(noise.rotation_rad);
  }
  return root;
}

ActionPoseSample observe(const SyntheticRobot& robot, const Eigen::VectorXd& action,
                         const ObservationOptions& options, std::int64_t sample_index, Rng& rng) {
  ActionPoseSample sample;
  sample.sample_index = sample_index;
  sample.utime = 1000000 * sample_index;
  sample.action = action;
  const bool tags = options.regime == Regime::kTag;
  const auto poses = robot.poses_in_camera(action);
  const std::set<int> facing = facing_parts(robot, action, options.max_view_angle_rad);
  for (const TrueLink& link : robot.links) {
    if (!facing.contains(link.part)) continue;
    if (tags && uniform(rng, 0, 1) < 0.15) continue;
    const Pose& X_true = poses.at(link.part);
    const Matrix6d root = noise_root(options.regime, X_true);
    PartObservation o;
    o.part = link.part;
    o.X_CB = X_true;
    if (options.regime != Regime::kFree) o.X_CB = X_true * exp(root * gaussian6(rng));
    if (options.with_covariances) o.covariance = root * root.transpose();
    bool flip = false;
    if (tags) flip = uniform(rng, 0, 1) < 0.03;
    if (options.regime == Regime::kTagIso && uniform(rng, 0, 1) < 0.03) {
      if (uniform(rng, 0, 1) < 0.7) {
        flip = true;
      } else {
        o.X_CB = random_pose(rng, 0, 1);
        o.X_CB.translation().z() += 2;
      }
    }
    const Pose other = flipped(o.X_CB, rng);
    if (options.with_other_hypothesis) {
      o.X_CB_other = flip ? o.X_CB : other;
      o.error_ratio = uniform(rng, 1, 4);
    }
    if (flip) o.X_CB = other;
    sample.parts.push_back(o);
  }
  std::sort(sample.parts.begin(), sample.parts.end(),
            [](const auto& x, const auto& y) { return x.part < y.part; });
  return sample;
}

PartObservation seen_at(int part, const Pose& X_CB, const Noise& noise, Rng& rng) {
  Vector6d error = gaussian6(rng);
  error.head<3>() *= noise.position_m;
  error.tail<3>() *= noise.rotation_rad;
  PartObservation seen;
  seen.part = part;
  seen.X_CB = X_CB * exp(error);
  return seen;
}

std::vector<ActionPoseSample> with_positions_alone(std::vector<ActionPoseSample> samples,
                                                   const std::set<int>& parts) {
  for (ActionPoseSample& sample : samples)
    for (PartObservation& o : sample.parts) {
      if (!parts.contains(o.part)) continue;
      const Eigen::Matrix3d R = o.X_CB.linear();
      const Eigen::Matrix3d covariance = R * o.covariance.topLeftCorner<3, 3>() * R.transpose();
      o.has_rotation = false;
      o.X_CB.linear().setIdentity();
      o.covariance.setZero();
      o.covariance.topLeftCorner<3, 3>() = covariance;
      o.X_CB_other.reset();
      o.error_ratio = 0;
    }
  return samples;
}

std::vector<ActionPoseSample> babble(const SyntheticRobot& robot, int num_samples,
                                     const ObservationOptions& options, Rng& rng) {
  std::vector<ActionPoseSample> samples;
  for (int t = 0; t < num_samples; ++t)
    samples.push_back(observe(robot, robot.random_action(rng), options, t, rng));
  return samples;
}

}  // namespace bodyschema::test
