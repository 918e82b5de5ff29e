#include "processes/marker_estimator/tag_pose.h"

#include <algorithm>
#include <cmath>
#include <opencv2/calib3d.hpp>

namespace bodyschema {
namespace {

Pose pose_from_opencv(const cv::Mat& rotation_vector, const cv::Mat& translation) {
  const Eigen::Vector3d w(rotation_vector.ptr<double>());
  Pose X = Pose::Identity();
  X.linear() = exp_so3(w);
  X.translation() = Eigen::Vector3d(translation.ptr<double>());
  return X;
}

/// The pose of a tag that faces the camera and has about these corners.
Pose frontal(double size_m, const std::vector<ImagePoint>& corners) {
  Eigen::Vector2d centre = Eigen::Vector2d::Zero();
  double perimeter = 0;
  for (int i = 0; i < 4; ++i) {
    centre += corners[i].ray / 4;
    perimeter += (corners[(i + 1) % 4].ray - corners[i].ray).norm();
  }
  // x runs along the sides 0→1 and 3→2.
  const Eigen::Vector2d x = corners[1].ray - corners[0].ray + corners[2].ray - corners[3].ray;
  const Eigen::Vector3d sight = centre.homogeneous().normalized();
  Pose X = Pose::Identity();
  X.linear() =
      rotation_of_z_to(sight) * exp_so3(std::atan2(x.y(), x.x()) * Eigen::Vector3d::UnitZ());
  X.translation() = 4 * size_m / perimeter * centre.homogeneous();
  return X;
}

}  // namespace

std::vector<PoseFit> solve_tag_pose(double size_m, const std::vector<ImagePoint>& corners,
                                    const Eigen::MatrixXd* whitener) {
  const std::vector<Eigen::Vector3d> p_MP = tag_corners(size_m);
  std::vector<cv::Point3d> object;
  std::vector<cv::Point2d> rays;
  for (int i = 0; i < 4; ++i) {
    object.emplace_back(p_MP[i].x(), p_MP[i].y(), p_MP[i].z());
    rays.emplace_back(corners[i].ray.x(), corners[i].ray.y());
  }
  std::vector<cv::Mat> rotations, translations;
  try {
    // On rays the camera matrix is the identity and the lens is gone.
    cv::solvePnPGeneric(object, rays, cv::Matx33d::eye(), cv::noArray(), rotations, translations,
                        false, cv::SOLVEPNP_IPPE_SQUARE);
  } catch (const cv::Exception&) {
    return {};  // collinear or coincident corners
  }
  std::vector<Pose> starts;
  for (std::size_t i = 0; i < rotations.size(); ++i) {
    starts.push_back(pose_from_opencv(rotations[i], translations[i]));
  }
  std::vector<PoseFit> minima;
  const auto descend = [&](const Pose& start) {
    if (!start.matrix().allFinite()) return;  // IPPE's closed form is NaN for some exact views
    const auto fit = fit_pose(start, p_MP, corners, whitener);
    if (!fit || tilt_rad(fit->X_CB) >= M_PI / 2) return;
    const auto is_known = [&](const PoseFit& m) { return is_same_minimum(m.X_CB, fit->X_CB); };
    if (std::none_of(minima.begin(), minima.end(), is_known)) minima.push_back(*fit);
  };
  for (const Pose& start : starts) descend(start);
  if (minima.empty()) descend(frontal(size_m, corners));
  std::stable_sort(minima.begin(), minima.end(),
                   [](const PoseFit& a, const PoseFit& b) { return a.rms_sigma < b.rms_sigma; });
  if (minima.size() > 2) minima.resize(2);
  return minima;
}

double tilt_rad(const Pose& X_CM) {
  const double cosine = X_CM.linear().col(2).dot(X_CM.translation().normalized());
  return std::acos(std::clamp(cosine, -1.0, 1.0));
}

}  // namespace bodyschema
