#pragma once

#include <Eigen/Core>
#include <opencv2/core/mat.hpp>
#include <optional>
#include <vector>

#include "common/camera/lens.h"
#include "processes/marker_estimator/corner_refinement.h"

namespace bodyschema::test {

/// Another corner detector, for comparison: centroids of the grey values' gradient across
/// the four edges of the black square, one line per edge through them in rays (robust by Huber's
/// weights, scatter as measured), corners at the intersections. `border`: cells across the black
/// square. Nothing if an edge has fewer than 6 usable places.
std::optional<RefinedCorners> edge_corners(const cv::Mat& grey, const Lens& lens, int border,
                                           const std::vector<Eigen::Vector2d>& corners_px);

}  // namespace bodyschema::test
