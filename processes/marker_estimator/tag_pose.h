#pragma once

#include <array>
#include <vector>

#include "common/camera/fit_pose.h"

namespace bodyschema {

/// The poses X_CM under which a tag of side `size_m` looks as `corners` do (tag_corners() order):
/// the one or two local minima of the reprojection error, ascending. A planar target seen from afar
/// has two, its tilt mirrored about the line of sight; which one is true only shows in perspective,
/// so both are kept. Empty if the corners are no view of a square. `whitener`: see fit_pose().
std::vector<PoseFit> solve_tag_pose(double size_m, const std::vector<ImagePoint>& corners,
                                    const Eigen::MatrixXd* whitener = nullptr);

/// Angle between the marker's normal and the line of sight to its centre [rad]: 0 is frontal. Above
/// π/2 the camera would see the marker's back.
double tilt_rad(const Pose& X_CM);

}  // namespace bodyschema
