#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <opencv2/core/mat.hpp>
#include <optional>
#include <vector>

#include "common/camera/fit_pose.h"
#include "common/camera/lens.h"

namespace bodyschema {

/// A tag as it is printed: `width` × `width` cells with the white margin of one cell around the
/// black square of `border` × `border` cells.
struct TagCells {
  int width = 0;
  int border = 0;
  std::vector<std::uint8_t> is_white;  ///< row by row, the first is the tag's upper edge
};

/// Corners of the black square, fitted to the grey values of the whole tag.
struct RefinedCorners {
  /// Pixel-centre convention, order (−,+) (+,+) (+,−) (−,−) in the marker's frame M, as AprilTag's.
  std::vector<Eigen::Vector2d> corners_px;
  /// Covariance of (x0, y0, x1, y1, …) [px²]. Corners that share an edge are correlated.
  Matrix8d covariance_px2 = Matrix8d::Zero();
  double noise_sd = 0;  ///< of a pixel's residual [grey levels]
  double contrast = 0;  ///< white − black [grey levels]
  /// Covariance of the blur (lens, focus, motion) without the pixel's own square [px²].
  Eigen::Matrix2d blur_px2 = Eigen::Matrix2d::Zero();
};

enum class CornerRefusal {
  kNone,
  kNoTag,        ///< the corners are no convex quadrangle inside the image and the lens model
  kTooSmall,     ///< cells below 1.3 px, or pixels too few
  kLowContrast,  ///< a corner's standard deviation would exceed 0.15 px
  kSaturated,    ///< most of the white, or of the black, is cut off by the range of grey values
  kBlurred,      ///< a blur wider than half a cell, or by a motion of about a cell
  kCovered,      ///< part of the tag, or of one of its edges, is not as printed
  kNotFound      ///< the fit does not settle near the given corners
};

/// For counters and people.
const char* name_of(CornerRefusal refusal);

struct CornerRefinement {
  std::optional<RefinedCorners> corners;  ///< nothing if refused
  CornerRefusal refusal = CornerRefusal::kNone;
  // Of the last iteration, 0 if there was none:
  double blur_cells = 0;  ///< standard deviation along the side where it is larger [cells]
  double misfit = 0;      ///< mean amount of a residual, share of the contrast
  std::int64_t num_evaluations = 0;  ///< of the model at a pixel, over all iterations: the work
};

/// Fits the corners of a tag to its grey values: 15 parameters by Gauss–Newton, namely the 8 of the
/// homography from the tag's plane to the camera's rays, black, white and the light's slope in two
/// directions, and the covariance of a Gaussian blur in the image. All edges of the tag's code take
/// part, not the outline alone. The lens is part of the map, so that edges are straight in rays,
/// not in pixels.
///
/// The noise is that of the residuals. The covariance is σ²(JᵀJ)⁻¹, widened if the residuals of
/// neighbouring pixels (blocks of 8 × 8, as JPEG's) are correlated more than independent noise
/// would be (the cluster-robust covariance of White, 1980, as one factor). Pixels that differ from
/// the print lose their weight; those cut off by the range of grey values have none.
///
/// The work for a tag that is refused for its blur is bounded whatever its size: no iteration
/// evaluates more than some 40 000 pixels of a blurred tag.
///
/// `corners_px`: AprilTag's, 4 of them, about a third of a pixel from the truth. `grey`: CV_8UC1.
/// @throws std::invalid_argument if the image is not of that type, or `cells` is no tag.
CornerRefinement refine_corners(const cv::Mat& grey, const Lens& lens, const TagCells& cells,
                                const std::vector<Eigen::Vector2d>& corners_px);

/// Covariance of AprilTag's own corners (x0, y0, …) [px²] of a tag that was refused, `noise` and
/// more: blur mixes the cells beside an edge and rounds its ends, which pulls AprilTag's lines by a
/// share of a cell that goes with its third power. What is no Gaussian blur, as a long motion,
/// shows in the misfit. Where the fit is refused as covered or does not settle, no measure tells
/// how far the lines are pulled: a constant share of a cell.
Matrix8d detected_covariance_px2(const CornerNoise& noise, const TagCells& cells,
                                 const std::vector<Eigen::Vector2d>& corners_px,
                                 const CornerRefinement& refused);

}  // namespace bodyschema
