#pragma once

#include <Eigen/Core>
#include <vector>

#include "bodyschema/sample_t.hpp"
#include "common/camera/fit_pose.h"
#include "common/schema/sample.h"

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

/// An action–pose sample with what the camera saw of each tag.
struct RefinerSample {
  ActionPoseSample sample;
  /// Ascending tag; empty where the recording has poses alone. Also tags that contradict the others
  /// of their part: a tag that was misplaced by hand does.
  std::vector<TagSight> tags;
};

inline std::int64_t index_of(const RefinerSample& seen) { return seen.sample.sample_index; }

RefinerSample refiner_sample(const sample_t& message);
/// Samples without corners.
std::vector<RefinerSample> refiner_samples(const std::vector<ActionPoseSample>& samples);
/// Those of a log: each index once, the first that was recorded.
std::vector<RefinerSample> refiner_samples(const std::vector<sample_t>& messages);

/// At most `most` of them, evenly spaced in their order, the first among them.
std::vector<RefinerSample> thinned(std::vector<RefinerSample> samples, std::size_t most);

}  // namespace bodyschema
