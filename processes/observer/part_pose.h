#pragma once

#include <cstdint>
#include <optional>
#include <vector>

#include "common/camera/fit_pose.h"
#include "common/config/rig.h"

namespace bodyschema {

/// One tag of a body part B as it was seen while the arm was at rest.
struct SeenTag {
  int id = 0;
  double size_m = 0;
  Pose X_BM = Pose::Identity();
  std::vector<ImagePoint> corners;  ///< four, AprilTag's order
  /// Covariance of the corners' measurement; their sigma_px is sigma_px() of it.
  Matrix8d corner_covariance_px2 = Matrix8d::Identity();
  std::vector<Pose> X_CM;  ///< hypotheses of its pose: the starts of the fit
};

struct PartPoseOptions {
  TagCalibration calibration;         ///< adds to what the corners' covariances say of the tags
  double max_tag_error_px = 0;        ///< a tag with a larger rms in the common fit disagrees
  double min_other_rotation_rad = 0;  ///< a second minimum closer than this is the same pose
  double max_error_ratio = 0;         ///< a second minimum worse than this is no hypothesis
};

struct PartPose {
  Pose X_CB = Pose::Identity();
  Matrix6d covariance = Matrix6d::Zero();  ///< (translation [m], rotation [rad]), right, in B
  std::optional<Pose> X_CB_other;          ///< the best other minimum, if it is a hypothesis
  double error_ratio = 0;                  ///< its reprojection error over that of X_CB, ≥ 1
  std::vector<int> tags;                   ///< ids of those it rests on, ascending
};

/// What the tags of a part say of its pose.
struct PartPoses {
  std::optional<PartPose> agreed;        ///< by those that agree
  std::vector<PartPose> contradictions;  ///< by each of the others alone; ascending id
};

/// The pose of a part over all its tags at once: the minimum of the reprojection error of all
/// corners, searched from every hypothesis of every tag. Tags in different planes leave one
/// minimum; a single tag seen from afar has two. While a tag disagrees with the common pose the one
/// whose absence helps most is taken out. Where no two tags agree, though each fits a pose alone,
/// none is believed: a process that knows the body may decide.
/// `tags`: ascending id.
PartPoses solve_part_pose(std::vector<SeenTag> tags, const PartPoseOptions& options);

}  // namespace bodyschema
