#pragma once

#include <Eigen/Cholesky>
#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <opencv2/core/mat.hpp>
#include <optional>
#include <vector>

#include "common/camera/lens.h"
#include "processes/marker_estimator/blurred_pattern.h"
#include "processes/marker_estimator/corner_refinement.h"

namespace bodyschema::corner_fit {

// Parameters of the fit, in this order: a change of the homography in the tag's plane, in
// coordinates (X, Y) in which the black square is [−1, 1]²; black and contrast in the centre, and
// the light's relative change with X and Y; covariance of the blur in the image (uu, uv, vv) [px²].
// The residual is the column behind them.
inline constexpr int kGeometry = 8, kLight = 4, kParameters = 15;
inline constexpr int kColumns = 16;  // with the residual, a multiple of 4
constexpr int kLanes = kColumns / 4;
using Row = std::array<Lane, kLanes>;
using Normal = Eigen::Matrix<double, kParameters, kParameters>;
using Parameters = Eigen::Matrix<double, kParameters, 1>;
using Full = Eigen::Matrix<float, kColumns, kColumns, Eigen::RowMajor>;

/// Σ rowᵀ row over a block of pixels: the 4 × 4 blocks on and above the diagonal.
struct BlockSums {
  Lane lines[kLanes * (kLanes + 1) / 2][4];

  /// The symmetric matrix.
  Full full() const {
    Full M;
    const auto* block = lines;
    for (int i = 0; i < kLanes; ++i) {
      for (int j = i; j < kLanes; ++j, ++block) {
        for (int k = 0; k < 4; ++k) {
          for (int l = 0; l < 4; ++l) {
            M(4 * i + k, 4 * j + l) = M(4 * j + l, 4 * i + k) = (*block)[k][l];
          }
        }
      }
    }
    return M;
  }
};

/// State of the fit.
struct Model {
  Eigen::Matrix3d H;  ///< (X, Y, 1) on the tag to the ray
  Eigen::Matrix<double, kLight, 1> light;
  Eigen::Matrix2d blur_px2;
};

/// Choice of pixels: all, half or a quarter of them on a regular grid, or those of a
/// Fibonacci lattice, (u + offset · v) mod spacing = 0, which lines up with no tag's cells.
struct Pixels {
  enum class Grid { kAll, kHalf, kQuarter, kLattice };
  Grid grid = Grid::kAll;
  int spacing = 1, offset = 0;  ///< of kLattice

  /// No more than `most` of `area_px`.
  static Pixels lattice(double area_px, double most) {
    int before = 5, spacing = 13;
    while (area_px > most * spacing) {
      const int next = 3 * spacing - before;  // every second Fibonacci number
      before = spacing;
      spacing = next;
    }
    return {Grid::kLattice, spacing, before};
  }
  double share() const {
    return grid == Grid::kAll       ? 1.0
           : grid == Grid::kHalf    ? 0.5
           : grid == Grid::kQuarter ? 0.25
                                    : 1.0 / spacing;
  }
};

// Number of pixels with which the fit of a large tag begins; and the most for one evaluation of a
// tag so blurred that every pixel has the whole sum: it bounds the cost of a tag, whatever its
// size. Chosen: tags of 160 px and above are found to 0.03 px with 6 px of blur.
inline constexpr double kFirstPixels = 10000, kBlurredPixels = 40000;

/// Sums of one evaluation over the pixels.
struct Sums {
  Normal H = Normal::Zero();
  Parameters g = Parameters::Zero();  ///< Jᵀr
  double squares = 0;                 ///< of the residuals
  double absolute = 0;                ///< sum of their amounts, no more than the cut each
  double num_pixels = 0;              ///< by weight
  std::int64_t num_visited = 0;       ///< pixels at which the model was evaluated
  std::vector<BlockSums> blocks;      ///< JᵀJ with the residual as the last column
  int num_edge = 0, num_covered = 0;  ///< pixels near an edge; down-weighted ones
  std::array<int, 4> side_seen{};     ///< pixels within half a cell of the outline's sides
  std::array<int, 4> side_covered{};  ///< of these
  int num_white = 0, num_black = 0, num_saturated_white = 0, num_saturated_black = 0;
  float widest_blur = 0;  ///< standard deviation along an axis of the tag [cells]
};

/// The fit of one tag; see refine_corners().
class Refiner {
 public:
  Refiner(const cv::Mat& grey, const Lens& lens, const TagCells& cells)
      : grey_(grey),
        lens_(lens),
        cells_(cells),
        pattern_(cells),
        half_border_(0.5 * cells.border),
        half_width_(0.5 * cells.width) {}

  CornerRefinement run(const std::vector<Eigen::Vector2d>& corners_px);

 private:
  /// One Gauss–Newton step, and what it is worth.
  struct Step {
    Parameters delta;
    Parameters scale;  ///< of the unknowns, by which H was conditioned
    Eigen::LDLT<Normal> factor;
    Eigen::Matrix<double, 8, kGeometry> J;     ///< ∂(corners [px])/∂(geometry)
    Eigen::Matrix<double, 8, 1> change_px;     ///< of the corners
    double light_change = 0, blur_change = 0;  ///< shares
  };

  CornerRefusal begin(const std::vector<Eigen::Vector2d>& corners_px);
  void make_lattice(const cv::Rect& region, int block_px);
  /// Black and contrast from the pixels at the centres of the cells.
  bool guess_light();
  CornerRefinement fit(const std::vector<Eigen::Vector2d>& corners_px);
  /// The n-th look, and why the fit ends with it.
  CornerRefusal look_again(int n, bool is_coarse, Sums* sums);
  /// Pixels of a later look, by the blur known so far.
  Pixels all_looks() const;
  void look(double robust_cut, Pixels pixels, Sums& sums);
  /// Positions of a block's pixels on the tag, in cells from the corner of its margin: coefficients
  /// [power of t][power of s] of the quadratic through its 3 × 3 points of the lattice, s and t −1
  /// … 1 over the block. Nothing if the tag is not there.
  using BlockMap = std::array<std::array<Eigen::Vector2d, 3>, 3>;
  std::optional<BlockMap> map_of_block(int bu, int bv, const Eigen::Matrix3d& to_tag) const;
  void look_at_block(int bu, int bv, const Eigen::Matrix3d& to_tag, double robust_cut,
                     Pixels pixels, std::vector<Row>& rows, Sums& sums) const;
  std::optional<Step> solve(const Sums& sums) const;
  Eigen::Matrix<double, 8, kGeometry> corner_jacobian() const;
  void move(const Parameters& delta, double share_of_geometry);
  /// kBlurred, kCovered or kNone.
  CornerRefusal visible_damage(const Sums& sums,
                               const std::vector<Eigen::Vector2d>& corners_px) const;
  /// Motion of the image while the shutter was open, if it explains that the blur is wider in one
  /// direction: straight motion of length l has the variance l²/12. Along the tag's sides [cells].
  double motion_cells(const std::vector<Eigen::Vector2d>& corners_px) const;
  CornerRefinement conclude(const Sums& sums, const Step& step) const;
  /// Factor on the covariance of the corners for residuals that are alike within blocks beyond
  /// those of independent pixels; 0 if there are too few blocks to compare, nothing if `inverse` is
  /// not positive definite. `root`: of the covariance with noise of unit variance.
  std::optional<double> inflation(const Sums& sums, const Step& step, const Normal& inverse,
                                  const Eigen::LLT<Matrix8d>& root, double variance) const;

  const cv::Mat& grey_;
  const Lens& lens_;
  const TagCells& cells_;
  const Pattern pattern_;
  const double half_border_, half_width_;  // [cells]

  // Rays at the centres, corners and middles of sides of the blocks.
  int block_px_ = 8;
  cv::Point origin_;  // of the first block
  int num_u_ = 0, num_v_ = 0;
  std::vector<Eigen::Vector2d> lattice_;
  std::array<Eigen::Matrix2d, 4> px_per_ray_;

  double area_px_ = 0;        ///< of the tag's bounding box
  double least_cell_px_ = 0;  ///< side of a cell where it is shortest
  Pixels first_look_{Pixels::Grid::kHalf};
  Pixels all_looks_{Pixels::Grid::kAll};
  Model model_;
  double sharpest_px2_ = 0;  ///< least variance of its blur in any direction
  double blur_cells_ = 0;
  double misfit_ = 0;
  std::int64_t num_visited_ = 0;
};

}  // namespace bodyschema::corner_fit
