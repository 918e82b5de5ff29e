#pragma once

#include <Eigen/Core>
#include <vector>

#include "bodyschema/sample_t.hpp"
#include "common/camera/fit_pose.h"

namespace bodyschema {

/// The corners of one tag as they were seen, mean over the frames of a sample.
struct TagSight {
  int tag = 0;
  /// (x0, y0, …, x3, y3) [px], centre convention, AprilTag's order.
  Eigen::Matrix<double, 8, 1> corners_px = Eigen::Matrix<double, 8, 1>::Zero();
  /// Of their measurement; zero: not told.
  Matrix8d covariance_px2 = Matrix8d::Zero();
};

/// Of its corners [px²]; where none is told, as such corners are known.
Matrix8d covariance_of(const TagSight& sight, const CornerNoise& corner_noise);

/// All that a sample shows, ascending tag; also tags that contradict the others of their part: a
/// tag that was misplaced by hand does.
std::vector<TagSight> tag_sights(const sample_t& message);

}  // namespace bodyschema
