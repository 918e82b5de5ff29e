#include "processes/marker_estimator/corner_refinement.h"

#include <Eigen/Cholesky>
#include <Eigen/Geometry>
#include <Eigen/LU>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <stdexcept>

namespace bodyschema {
namespace {

// Parameters of the fit, in this order: a change of the homography in the tag's plane, in
// coordinates (X, Y) in which the black square is [−1, 1]²; black and contrast in the centre, and
// the light's relative change with X and Y; covariance of the blur in the image (uu, uv, vv) [px²].
// The residual is the column behind them.
constexpr int kGeometry = 8, kLight = 4, kParameters = 15;
constexpr int kColumns = 16;              // with the residual, a multiple of 4
constexpr double kTypicalBlur_px2 = 0.5;  // where the fit begins
constexpr double kSharpest_px2 = 1e-3;
constexpr double kPixelVariance_px2 = 1.0 / 12;  // of the pixel's own square, per axis

using Lane = float __attribute__((vector_size(16)));
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

/// Φ and φ of the normal distribution by linear interpolation, good to 1e-5; beyond ±4 they are 0
/// and 1.
class NormalTable {
 public:
  struct Value {
    float cdf, density;
  };
  NormalTable() {
    for (int i = 0; i <= kSize; ++i) {
      const double t = i / kPerUnit - kRange;
      const auto cdf = static_cast<float>(0.5 * std::erfc(-t / std::sqrt(2.0)));
      const auto density = static_cast<float>(std::exp(-0.5 * t * t) / std::sqrt(2 * M_PI));
      if (i < kSize) table_[i] = {cdf, 0, density, 0};
      if (i == 0) continue;
      table_[i - 1].cdf_rise = cdf - table_[i - 1].cdf;
      table_[i - 1].density_rise = density - table_[i - 1].density;
    }
  }
  Value operator()(float t) const {
    if (!(t > -kRange)) return {0, 0};
    if (!(t < kRange)) return {1, 0};
    const float place = (t + kRange) * kPerUnit;
    const int i = std::min(static_cast<int>(place), kSize - 1);
    const float f = place - static_cast<float>(i);
    const Entry& e = table_[i];
    return {e.cdf + f * e.cdf_rise, e.density + f * e.density_rise};
  }

 private:
  static constexpr float kRange = 4, kPerUnit = 64;
  static constexpr int kSize = static_cast<int>(2 * kRange * kPerUnit);
  struct Entry {
    float cdf, cdf_rise, density, density_rise;
  };
  std::array<Entry, kSize> table_;
};

const NormalTable kNormal;

/// A step from 0 to 1, smoothed by a Gaussian and seen `distance` behind it: value and first three
/// derivatives.
[[gnu::always_inline]] inline Lane smoothed_step(float distance, float per_sd) {
  const float t = distance * per_sd;
  const NormalTable::Value v = kNormal(t);
  const float d1 = v.density * per_sd;
  const float d2 = -t * per_sd * d1;
  return Lane{v.cdf, d1, d2, (t * t - 1) * per_sd * per_sd * d1};
}

/// The printed pattern, 0 black and 1 white, in cells from the upper left corner of the margin.
class Pattern {
 public:
  enum class Crossing : std::uint8_t { kUniform, kAcrossX, kAcrossY, kBoth };

  explicit Pattern(const TagCells& cells) : width_(cells.width), stride_(cells.width + 2 * kPad) {
    white_.assign(static_cast<std::size_t>(stride_) * stride_, 1.0F);
    for (int r = 0; r < width_; ++r) {
      for (int c = 0; c < width_; ++c) {
        white_[(r + kPad) * stride_ + c + kPad] = cells.is_white[r * width_ + c] ? 1.0F : 0.0F;
      }
    }
    for (int y = 0; y <= width_; ++y) {
      for (int x = 0; x <= width_; ++x) {
        const bool across_x = cell(x - 1, y - 1) != cell(x, y - 1) || cell(x - 1, y) != cell(x, y);
        const bool across_y = cell(x - 1, y - 1) != cell(x - 1, y) || cell(x, y - 1) != cell(x, y);
        crossings_.push_back(static_cast<Crossing>((across_x ? 1 : 0) + (across_y ? 2 : 0)));
      }
    }
  }

  float cell(int column, int row) const { return white_[(row + kPad) * stride_ + column + kPad]; }
  /// Change of the pattern at the point where two lines between cells cross.
  Crossing crossing(int x_line, int y_line) const {
    return crossings_[y_line * (width_ + 1) + x_line];
  }
  int nearest_line(float x) const { return std::clamp(static_cast<int>(x + 0.5F), 0, width_); }

  /// The pattern smoothed by a Gaussian with these reciprocal standard deviations along the axes:
  /// out[l][k] is its derivative, k times by x and l times by y. Counted are the two lines around
  /// the point in each direction, or the nearest one and its neighbours.
  template <int lines>
  void smooth(float x, float y, const float per_sd[2], Lane out[4]) const {
    const int first_x = first_line<lines>(x), first_y = first_line<lines>(y);
    const float* cells = &white_[(first_y - 1 + kPad) * stride_ + first_x - 1 + kPad];
    Lane rows[lines + 1];
    for (int r = 0; r <= lines; ++r) rows[r] = Lane{cells[r * stride_], 0, 0, 0};
    for (int i = 0; i < lines; ++i) {
      const Lane a = smoothed_step(x - static_cast<float>(first_x + i), per_sd[0]);
      for (int r = 0; r <= lines; ++r) {
        rows[r] += (cells[r * stride_ + i + 1] - cells[r * stride_ + i]) * a;
      }
    }
    out[0] = rows[0];
    out[1] = out[2] = out[3] = Lane{};
    for (int i = 0; i < lines; ++i) {
      const Lane b = smoothed_step(y - static_cast<float>(first_y + i), per_sd[1]);
      const Lane rise = rows[i + 1] - rows[i];
      for (int l = 0; l < 4; ++l) out[l] += b[l] * rise;
    }
  }

  // [cells]: the line behind the last one that is counted is 2.6 standard deviations away or more.
  static constexpr float kNarrow = 0.19F, kMedium = 0.38F, kWide = 0.55F;

 private:
  static constexpr int kPad = 3;

  template <int lines>
  int first_line(float x) const {
    if constexpr (lines == 2) return std::clamp(static_cast<int>(x + 8) - 8, -1, width_);
    return nearest_line(x) - 1;
  }

  int width_, stride_;
  std::vector<float> white_;
  std::vector<Crossing> crossings_;
};

/// The pattern as a camera sees it, and its derivatives by the point on the tag [cells].
struct Smoothed {
  float m, x, y, xx, xy, yy;
};

/// A Gaussian of covariance S [cells²] in front of the pattern.
///
/// Across one straight line it is one error function. At a crossing of lines, axes first: the
/// Gaussian with the covariance diag(S), into which the series of the operator exp(S_xy ∂x ∂y) to
/// the third order (Mehler's) brings the correlation, good to 0.1 % of the contrast at a
/// correlation of 0.5. Larger correlations are a sum of shifted Gaussians, S = D + r rᵀ, by a
/// Gauss–Hermite rule along r. The pixel's square, if it is not much narrower than the blur and so
/// no Gaussian, is a grid of shifts as well.
class Smoothing {
 public:
  /// `A`: cells per pixel. `blur_px2`: without the pixel's square, `sharpest_px2` its least
  /// variance in any direction.
  Smoothing(const Eigen::Matrix2d& A, const Eigen::Matrix2d& blur_px2, double sharpest_px2) {
    const int grid = sharpest_px2 > 0.2    ? 1
                     : sharpest_px2 > 0.08 ? 2
                     : sharpest_px2 > 0.03 ? 3
                                           : kGrid;
    const Eigen::Matrix2d S =
        A * (blur_px2 + kPixelVariance_px2 / (grid * grid) * Eigen::Matrix2d::Identity()) *
        A.transpose();
    const double correlation = S(0, 1) / std::sqrt(S(0, 0) * S(1, 1));
    constexpr double kSeries = 0.5;  // of correlation
    const double shifted = std::max(0.0, (std::abs(correlation) - kSeries) / (1 - kSeries));
    const Rule& rule = shifted == 0 ? kRules[0]
                                    : kRules[shifted < 0.3    ? 1
                                             : shifted < 0.55 ? 2
                                                              : 3];
    const Eigen::Vector2d r(std::sqrt(shifted * S(0, 0)),
                            std::copysign(std::sqrt(shifted * S(1, 1)), correlation));
    covariance_ = static_cast<float>(S(0, 1) - r.x() * r.y());
    for (int i = 0; i < 2; ++i) {
      per_sd_[i] = static_cast<float>(1 / std::sqrt((1 - shifted) * S(i, i)));
      per_full_sd_[i] = static_cast<float>(1 / std::sqrt(S(i, i)));
      sd_[i] = static_cast<float>(std::sqrt(S(i, i)));
      const double half_grid = 0.5 * (1 - 1.0 / grid) * (std::abs(A(i, 0)) + std::abs(A(i, 1)));
      reach_[i] = static_cast<float>(3.2 * sd_[i] + half_grid);
      tail_[i] = static_cast<float>(2.65 * sd_[i] + half_grid);
    }
    for (int u = 0; u < grid; ++u) {
      for (int v = 0; v < grid; ++v) {
        const Eigen::Vector2d shift =
            A * Eigen::Vector2d((u + 0.5) / grid - 0.5, (v + 0.5) / grid - 0.5);
        const double weight = 1.0 / (grid * grid);
        grid_nodes_[num_grid_nodes_++] = node(shift, weight);
        for (int i = 0; i < rule.size; ++i) {
          nodes_[num_nodes_++] = node(shift + rule.at[i] * r, weight * rule.weight[i]);
        }
      }
    }
  }

  /// [cells]: a line farther away than this changes a pixel by less than 0.4 %.
  float tail(int axis) const { return tail_[axis]; }
  /// Standard deviation along the tag's axis where it is larger [cells].
  float widest() const { return std::max(sd_[0], sd_[1]); }

  /// False if the pattern is flat around (x, y); `s` is then its value alone.
  bool operator()(const Pattern& pattern, float x, float y, Smoothed& s) const {
    const int kx = pattern.nearest_line(x), ky = pattern.nearest_line(y);
    const float to_x = std::abs(x - static_cast<float>(kx));
    const float to_y = std::abs(y - static_cast<float>(ky));
    if (1 - to_x < tail_[0] || 1 - to_y < tail_[1]) {  // the lines behind count too
      if (widest() < Pattern::kMedium) {
        s = at_crossing<2>(pattern, x, y);
      } else {
        s = at_crossing<3>(pattern, x, y);
      }
      return true;
    }
    const Pattern::Crossing crossing = pattern.crossing(kx, ky);
    const bool varies_x =
        (crossing == Pattern::Crossing::kAcrossX || crossing == Pattern::Crossing::kBoth) &&
        to_x < reach_[0];
    const bool varies_y =
        (crossing == Pattern::Crossing::kAcrossY || crossing == Pattern::Crossing::kBoth) &&
        to_y < reach_[1];
    if (varies_x && varies_y) {
      s = at_crossing<2>(pattern, x, y);
      return true;
    }
    const int column = static_cast<int>(x), row = static_cast<int>(y);
    if (varies_x) {
      const float low = pattern.cell(kx - 1, row), rise = pattern.cell(kx, row) - low;
      s = {low, 0, 0, 0, 0, 0};
      for (int i = 0; i < num_grid_nodes_; ++i) {
        const Node& node = grid_nodes_[i];
        const Lane a = smoothed_step(x + node.x - static_cast<float>(kx), per_full_sd_[0]);
        const float part = rise * node.weight;
        s.m += part * a[0];
        s.x += part * a[1];
        s.xx += part * a[2];
      }
      return true;
    }
    if (varies_y) {
      const float low = pattern.cell(column, ky - 1), rise = pattern.cell(column, ky) - low;
      s = {low, 0, 0, 0, 0, 0};
      for (int i = 0; i < num_grid_nodes_; ++i) {
        const Node& node = grid_nodes_[i];
        const Lane b = smoothed_step(y + node.y - static_cast<float>(ky), per_full_sd_[1]);
        const float part = rise * node.weight;
        s.m += part * b[0];
        s.y += part * b[1];
        s.yy += part * b[2];
      }
      return true;
    }
    s = {pattern.cell(column, row), 0, 0, 0, 0, 0};
    return false;
  }

 private:
  struct Node {
    float x, y, weight;
  };
  /// Gauss–Hermite rules for the standard normal distribution.
  struct Rule {
    int size;
    double at[7], weight[7];
  };
  static constexpr Rule kRules[4] = {
      {1, {0}, {1}},
      {3, {-1.7320508, 0, 1.7320508}, {1.0 / 6, 2.0 / 3, 1.0 / 6}},
      {5,
       {-2.8569700, -1.3556262, 0, 1.3556262, 2.8569700},
       {0.0112574, 0.2220759, 0.5333334, 0.2220759, 0.0112574}},
      {7,
       {-3.7504397, -2.3667594, -1.1544054, 0, 1.1544054, 2.3667594, 3.7504397},
       {0.00054827, 0.0307571, 0.2401232, 0.4571427, 0.2401232, 0.0307571, 0.00054827}}};

  static Node node(const Eigen::Vector2d& shift, double weight) {
    return {static_cast<float>(shift.x()), static_cast<float>(shift.y()),
            static_cast<float>(weight)};
  }

  template <int lines>
  Smoothed at_crossing(const Pattern& pattern, float x, float y) const {
    Lane d[4];
    pattern.smooth<lines>(x + nodes_[0].x, y + nodes_[0].y, per_sd_, d);
    if (num_nodes_ > 1) {
      for (int l = 0; l < 4; ++l) d[l] *= nodes_[0].weight;
      for (int i = 1; i < num_nodes_; ++i) {
        Lane more[4];
        pattern.smooth<lines>(x + nodes_[i].x, y + nodes_[i].y, per_sd_, more);
        for (int l = 0; l < 4; ++l) d[l] += nodes_[i].weight * more[l];
      }
    }
    const float c1 = covariance_, c2 = 0.5F * c1 * c1, c3 = c1 * c2 / 3;
    return {d[0][0] + c1 * d[1][1] + c2 * d[2][2] + c3 * d[3][3],
            d[0][1] + c1 * d[1][2] + c2 * d[2][3],
            d[1][0] + c1 * d[2][1] + c2 * d[3][2],
            d[0][2] + c1 * d[1][3],
            d[1][1] + c1 * d[2][2] + c2 * d[3][3],
            d[2][0] + c1 * d[3][1]};
  }

  float per_sd_[2], per_full_sd_[2], sd_[2], reach_[2], tail_[2];
  float covariance_;  ///< what the shifts leave of S_xy
  static constexpr int kGrid = 5;
  std::array<Node, 7 * kGrid * kGrid> nodes_;
  int num_nodes_ = 0;
  std::array<Node, kGrid * kGrid> grid_nodes_;
  int num_grid_nodes_ = 0;
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
constexpr double kFirstPixels = 10000, kBlurredPixels = 40000;

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

Eigen::Matrix3d homography_from(const std::array<Eigen::Vector2d, 4>& rays) {
  static const Eigen::Vector2d kSquare[4] = {{-1, 1}, {1, 1}, {1, -1}, {-1, -1}};
  Matrix8d A = Matrix8d::Zero();
  Eigen::Matrix<double, 8, 1> b;
  for (int k = 0; k < 4; ++k) {
    const Eigen::Vector2d& p = kSquare[k];
    for (int i = 0; i < 2; ++i) {
      A.block<1, 3>(2 * k + i, 3 * i) << p.x(), p.y(), 1;
      A.block<1, 2>(2 * k + i, 6) = -rays[k][i] * p.transpose();
      b[2 * k + i] = rays[k][i];
    }
  }
  const Eigen::Matrix<double, 8, 1> h = A.partialPivLu().solve(b);
  Eigen::Matrix3d H;
  H << h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], 1;
  return H;
}

Eigen::Vector2d ray_of(const Eigen::Matrix3d& H, const Eigen::Vector2d& p) {
  return (H * p.homogeneous()).hnormalized();
}

/// ∂(X, Y displacement)/∂(geometry) at p.
Eigen::Matrix<double, 2, kGeometry> displacement(const Eigen::Vector2d& p) {
  Eigen::Matrix<double, 2, kGeometry> D;
  D << p.x(), p.y(), 1, 0, 0, 0, -p.x() * p.x(), -p.x() * p.y(),  //
      0, 0, 0, p.x(), p.y(), 1, -p.y() * p.x(), -p.y() * p.y();
  return D;
}

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
  CornerRefusal begin(const std::vector<Eigen::Vector2d>& corners_px);
  void make_lattice(const cv::Rect& region, int block_px);
  bool guess_light();
  void look(double robust_cut, Pixels pixels, Sums& sums);
  void look_at_block(int bu, int bv, const Eigen::Matrix3d& to_tag, double robust_cut,
                     Pixels pixels, std::vector<Row>& rows, Sums& sums) const;
  Eigen::Matrix<double, 8, kGeometry> corner_jacobian() const;
  double motion_cells(const std::vector<Eigen::Vector2d>& corners_px) const;
  Pixels all_looks() const;
  CornerRefinement fit(const std::vector<Eigen::Vector2d>& corners_px);

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

CornerRefusal Refiner::begin(const std::vector<Eigen::Vector2d>& corners_px) {
  if (corners_px.size() != 4) return CornerRefusal::kNoTag;
  std::array<Eigen::Vector2d, 4> rays;
  double shortest = std::numeric_limits<double>::infinity(), longest = 0;
  for (int k = 0; k < 4; ++k) {
    const Eigen::Vector2d& p = corners_px[k];
    if (!p.allFinite() || p.minCoeff() < 0 || p.x() > grey_.cols - 1 || p.y() > grey_.rows - 1) {
      return CornerRefusal::kNoTag;
    }
    const Eigen::Vector2d side = corners_px[(k + 1) % 4] - p;
    const Eigen::Vector2d next = corners_px[(k + 2) % 4] - corners_px[(k + 1) % 4];
    // Seen from its front the square is passed against the clock in an image whose y points down.
    if (!(side.x() * next.y() - side.y() * next.x() < 0)) return CornerRefusal::kNoTag;
    shortest = std::min(shortest, side.norm());
    longest = std::max(longest, side.norm());
    const auto point = lens_.straighten(p);
    if (!point) return CornerRefusal::kNoTag;
    rays[k] = point->ray;
    px_per_ray_[k] = point->px_per_ray;
  }
  constexpr double kMany_px = 22;     // of a side: a quarter are some 200 pixels
  constexpr double kPlenty_px = 300;  // corners are known to 2e-3 px from a quarter of the pixels
  least_cell_px_ = shortest / cells_.border;
  if (shortest > kMany_px) first_look_.grid = Pixels::Grid::kQuarter;
  if (shortest > kPlenty_px) all_looks_.grid = Pixels::Grid::kQuarter;
  if (shortest < 1.3 * cells_.border) return CornerRefusal::kTooSmall;
  model_.H = homography_from(rays);
  if (!model_.H.allFinite() || std::abs(model_.H.determinant()) < 1e-15) {
    return CornerRefusal::kNoTag;
  }
  Eigen::Vector2d low(1e9, 1e9), high(-1e9, -1e9);
  const double margin = half_width_ / half_border_;
  for (const auto& [x, y] : {std::pair{-1, -1}, {1, -1}, {1, 1}, {-1, 1}}) {
    const Eigen::Vector3d ray = model_.H * Eigen::Vector3d(margin * x, margin * y, 1);
    if (!(ray.z() > 0)) return CornerRefusal::kNoTag;
    const Eigen::Vector2d p_px = lens_.project(ray.hnormalized());
    if (!p_px.allFinite()) return CornerRefusal::kNoTag;
    low = low.cwiseMin(p_px);
    high = high.cwiseMax(p_px);
  }
  const Eigen::Vector2d last(grey_.cols - 1, grey_.rows - 1);
  low = low.cwiseMax(Eigen::Vector2d::Zero()).cwiseMin(last);
  high = high.cwiseMax(Eigen::Vector2d::Zero()).cwiseMin(last);
  area_px_ = (high - low).prod();
  if (area_px_ * first_look_.share() > kFirstPixels) {
    first_look_ = Pixels::lattice(area_px_, kFirstPixels);
  }
  // Blocks of large tags are larger, so that their number stays bounded.
  const int block_px = 8 * std::max(1, static_cast<int>(std::lround(longest / 128)));
  make_lattice(cv::Rect(cv::Point(low.x(), low.y()),
                        cv::Point(static_cast<int>(high.x()) + 2, static_cast<int>(high.y()) + 2)),
               block_px);
  model_.blur_px2 = kTypicalBlur_px2 * Eigen::Matrix2d::Identity();
  return guess_light() ? CornerRefusal::kNone : CornerRefusal::kLowContrast;
}

void Refiner::make_lattice(const cv::Rect& region, int block_px) {
  block_px_ = block_px;
  origin_ = {region.x / block_px * block_px, region.y / block_px * block_px};
  num_u_ = (region.x + region.width - origin_.x + block_px - 1) / block_px;
  num_v_ = (region.y + region.height - origin_.y + block_px - 1) / block_px;
  const int cols = 2 * num_u_ + 1, rows = 2 * num_v_ + 1;
  lattice_.resize(static_cast<std::size_t>(cols) * rows);
  const auto pixel = [&](double i, double j) {
    return Eigen::Vector2d(origin_.x - 0.5 + 0.5 * block_px * i,
                           origin_.y - 0.5 + 0.5 * block_px * j);
  };
  // Inverting a lens takes iterations, but over a tag it is smooth: a polynomial of the fifth
  // degree in either direction, through Chebyshev's points.
  constexpr int n = 6;
  Eigen::Matrix<double, n, n> x, y;
  std::array<double, n> share;
  for (int k = 0; k < n; ++k) share[k] = 1 - std::cos((k + 0.5) * M_PI / n);
  const auto node = [&](int k, int size) { return 0.5 * (size - 1) * share[k]; };
  bool is_smooth = true;
  for (int j = 0; j < n; ++j) {
    for (int i = 0; i < n; ++i) {
      const auto point = lens_.straighten(pixel(node(i, cols), node(j, rows)));
      is_smooth = is_smooth && point;
      if (point) {
        x(j, i) = point->ray.x();
        y(j, i) = point->ray.y();
      }
    }
  }
  // Row p: Lagrange's polynomials at the p-th point of the lattice.
  const auto weights = [&](int size) {
    Eigen::Matrix<double, Eigen::Dynamic, n> W(size, n);
    for (int p = 0; p < size; ++p) {
      for (int k = 0; k < n; ++k) {
        W(p, k) = 1;
        for (int m = 0; m < n; ++m) {
          if (m != k) W(p, k) *= (p - node(m, size)) / (node(k, size) - node(m, size));
        }
      }
    }
    return W;
  };
  if (is_smooth) {
    const Eigen::Matrix<double, Eigen::Dynamic, n> along_u = weights(cols), along_v = weights(rows);
    const Eigen::MatrixXd all_x = along_v * x * along_u.transpose();
    const Eigen::MatrixXd all_y = along_v * y * along_u.transpose();
    // In a corner of the lattice, where the error is largest.
    constexpr double kAccuracy_px = 2e-3;
    const Eigen::Vector2d corner(all_x(0, 0), all_y(0, 0));
    if ((lens_.project(corner) - pixel(0, 0)).norm() < kAccuracy_px) {
      for (int j = 0; j < rows; ++j) {
        for (int i = 0; i < cols; ++i) lattice_[j * cols + i] = {all_x(j, i), all_y(j, i)};
      }
      return;
    }
  }
  for (int j = 0; j < rows; ++j) {
    for (int i = 0; i < cols; ++i) {
      const auto point = lens_.straighten(pixel(i, j));
      lattice_[j * cols + i] = point ? point->ray : Eigen::Vector2d(NAN, NAN);
    }
  }
}

/// Black and contrast from the pixels at the centres of the cells.
bool Refiner::guess_light() {
  std::vector<uchar> black, white;
  for (int r = 0; r < cells_.width; ++r) {
    for (int c = 0; c < cells_.width; ++c) {
      const Eigen::Vector2d p((c + 0.5 - half_width_) / half_border_,
                              (r + 0.5 - half_width_) / half_border_);
      const Eigen::Vector2d p_px = lens_.project(ray_of(model_.H, p));
      if (!(p_px.minCoeff() >= 0 && p_px.x() < grey_.cols - 1 && p_px.y() < grey_.rows - 1))
        continue;
      const uchar value = grey_.at<uchar>(static_cast<int>(std::lround(p_px.y())),
                                          static_cast<int>(std::lround(p_px.x())));
      (cells_.is_white[r * cells_.width + c] ? white : black).push_back(value);
    }
  }
  if (black.empty() || white.empty()) return false;
  const auto median = [](std::vector<uchar>& values) {
    const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
    std::nth_element(values.begin(), middle, values.end());
    return static_cast<double>(*middle);
  };
  const double dark = median(black), bright = median(white);
  model_.light << dark, bright - dark, 0, 0;
  return bright - dark >= 10;
}

void sum_products(const std::vector<Row>& rows, BlockSums& sums) {
  static_assert(kLanes == 4);
  auto* block = sums.lines;
  for (int i = 0; i < kLanes; ++i) {
    // Two blocks at a time: as many sums as fit into registers.
    for (int j = i; j < kLanes; j += 2) {
      const int other = std::min(j + 1, kLanes - 1);
      Lane a0{}, a1{}, a2{}, a3{}, b0{}, b1{}, b2{}, b3{};
      for (const Row& row : rows) {
        const Lane left = row[i], first = row[j], second = row[other];
        a0 += left[0] * first;
        a1 += left[1] * first;
        a2 += left[2] * first;
        a3 += left[3] * first;
        b0 += left[0] * second;
        b1 += left[1] * second;
        b2 += left[2] * second;
        b3 += left[3] * second;
      }
      (*block)[0] = a0;
      (*block)[1] = a1;
      (*block)[2] = a2;
      (*block)[3] = a3;
      ++block;
      if (other == j) continue;
      (*block)[0] = b0;
      (*block)[1] = b1;
      (*block)[2] = b2;
      (*block)[3] = b3;
      ++block;
    }
  }
}

void Refiner::look_at_block(int bu, int bv, const Eigen::Matrix3d& to_tag, double robust_cut,
                            Pixels pixels, std::vector<Row>& rows, Sums& sums) const {
  // Positions of the pixels on the tag, in cells from the corner of its margin: a quadratic over
  // the block through its 3 × 3 points.
  Eigen::Vector2d p[3][3];
  for (int j = 0; j < 3; ++j) {
    for (int i = 0; i < 3; ++i) {
      const Eigen::Vector2d& ray = lattice_[(2 * bv + j) * (2 * num_u_ + 1) + 2 * bu + i];
      const Eigen::Vector3d q = to_tag * ray.homogeneous();
      p[j][i] = q.hnormalized() * half_border_ + Eigen::Vector2d::Constant(half_width_);
      if (!p[j][i].allFinite()) return;
    }
  }
  const double width = cells_.width;
  Eigen::Array2d low = p[0][0], high = p[0][0];
  for (const auto& points : p) {
    for (const Eigen::Vector2d& point : points) {
      low = low.min(point.array());
      high = high.max(point.array());
    }
  }
  if ((high < 0).any() || (low > width).any()) return;
  // coefficient[t power][s power]
  Eigen::Vector2d across[3][3], c[3][3];
  for (int j = 0; j < 3; ++j) {
    across[j][0] = p[j][1];
    across[j][1] = 0.5 * (p[j][2] - p[j][0]);
    across[j][2] = 0.5 * (p[j][2] + p[j][0]) - p[j][1];
  }
  for (int k = 0; k < 3; ++k) {
    c[0][k] = across[1][k];
    c[1][k] = 0.5 * (across[2][k] - across[0][k]);
    c[2][k] = 0.5 * (across[2][k] + across[0][k]) - across[1][k];
  }
  const double half_px = 0.5 * block_px_;
  Eigen::Matrix2d A;  // cells per pixel
  A.col(0) = c[0][1] / half_px;
  A.col(1) = c[1][0] / half_px;
  const Smoothing smooth(A, model_.blur_px2, sharpest_px2_);
  sums.widest_blur = std::max(sums.widest_blur, smooth.widest());
  // Beyond the white margin anything may lie.
  const float low_limit[2] = {smooth.tail(0), smooth.tail(1)};
  const float high_limit[2] = {static_cast<float>(width) - low_limit[0],
                               static_cast<float>(width) - low_limit[1]};

  const float a00 = static_cast<float>(A(0, 0)), a01 = static_cast<float>(A(0, 1));
  const float a10 = static_cast<float>(A(1, 0)), a11 = static_cast<float>(A(1, 1));
  const Eigen::Matrix<float, kLight, 1> light = model_.light.cast<float>();
  const auto cut = static_cast<float>(robust_cut);
  const float inverse_half = static_cast<float>(1 / half_border_);
  const float gradient_scale = static_cast<float>(half_border_);
  const float border_low = static_cast<float>(half_width_ - half_border_);
  const float border_high = static_cast<float>(half_width_ + half_border_);
  const int u0 = origin_.x + bu * block_px_, v0 = origin_.y + bv * block_px_;
  const int u1 = std::min(u0 + block_px_, grey_.cols), v1 = std::min(v0 + block_px_, grey_.rows);
  const auto first = static_cast<float>(0.5 - half_px), per_half = static_cast<float>(1 / half_px);
  const bool is_lattice = pixels.grid == Pixels::Grid::kLattice;
  const int stride = is_lattice ? pixels.spacing : pixels.grid == Pixels::Grid::kAll ? 1 : 2;
  const auto first_u = [&](int v) {
    if (pixels.grid == Pixels::Grid::kHalf) return u0 + v % 2;
    if (!is_lattice) return u0;
    const auto past =
        static_cast<int>((u0 + static_cast<std::int64_t>(pixels.offset) * v) % stride);
    return past == 0 ? u0 : u0 + stride - past;
  };
  // An eleventh of an edge's steepest slope: pixels with less hold 1 % of its information.
  const float least_gradient2 = std::pow(0.035F / smooth.widest(), 2.0F);
  rows.clear();
  for (int v = v0; v < v1; ++v) {
    const double t = (v - v0 + 0.5 - half_px) / half_px;
    Eigen::Vector2f k[3];
    for (int i = 0; i < 3; ++i) k[i] = (c[0][i] + t * (c[1][i] + t * c[2][i])).cast<float>();
    const uchar* line = grey_.ptr<uchar>(v);
    if (pixels.grid == Pixels::Grid::kQuarter && v % 2) continue;
    // A block begins at an even pixel.
    for (int u = first_u(v); u < u1; u += stride) {
      const float s = (static_cast<float>(u - u0) + first) * per_half;
      const float x = k[0].x() + s * (k[1].x() + s * k[2].x());
      const float y = k[0].y() + s * (k[1].y() + s * k[2].y());
      if (!(x > low_limit[0] && y > low_limit[1] && x < high_limit[0] && y < high_limit[1]))
        continue;
      Smoothed m;
      const bool is_flat = !smooth(pattern_, x, y, m);
      ++sums.num_visited;
      // Flat places hold no information on the corners: a quarter of them is enough for the light.
      if (!is_lattice && ((u | v) & 1) && (is_flat || m.x * m.x + m.y * m.y < least_gradient2))
        continue;
      const float X = (x - static_cast<float>(half_width_)) * inverse_half;
      const float Y = (y - static_cast<float>(half_width_)) * inverse_half;
      const float bright = 1 + light[2] * X + light[3] * Y;
      const float contrast = light[1] * bright;
      const float ink = light[0] + light[1] * m.m;
      const float expected = bright * ink;
      const uchar pixel = line[u];
      if (m.m > 0.9F) {
        ++sums.num_white;
        sums.num_saturated_white += pixel == 255;
      } else if (m.m < 0.1F) {
        ++sums.num_black;
        sums.num_saturated_black += pixel == 0;
      }
      if ((pixel == 255 && expected > 254.5F) || (pixel == 0 && expected < 0.5F)) continue;
      const float r = static_cast<float>(pixel) - std::clamp(expected, 0.0F, 255.0F);
      float weight = 1;
      sums.num_edge += !is_flat;
      const bool is_covered = std::abs(r) > cut;
      if (is_covered) weight = cut / std::abs(r);
      sums.num_covered += is_covered && !is_flat;
      const float sides[4] = {std::abs(y - border_high), std::abs(x - border_high),
                              std::abs(y - border_low), std::abs(x - border_low)};
      for (int side = 0; side < 4; ++side) {
        sums.side_seen[side] += sides[side] < 0.5F;
        sums.side_covered[side] += sides[side] < 0.5F && is_covered;
      }
      if (expected < 0 || expected > 255) continue;
      sums.num_pixels += weight * weight;
      sums.absolute += weight * std::abs(r);
      const float gx = weight * contrast * m.x * gradient_scale;
      const float gy = weight * contrast * m.y * gradient_scale;
      const float both = gx * X + gy * Y;
      const float wc = weight * contrast;
      rows.push_back(
          {Lane{-gx * X, -gx * Y, -gx, -gy * X}, Lane{-gy * Y, -gy, both * X, both * Y},
           Lane{weight * bright, weight * bright * m.m, weight * ink * X, weight * ink * Y},
           Lane{wc * (0.5F * (a00 * a00 * m.xx + a10 * a10 * m.yy) + a00 * a10 * m.xy),
                wc * (a00 * a01 * m.xx + a10 * a11 * m.yy + (a00 * a11 + a01 * a10) * m.xy),
                wc * (0.5F * (a01 * a01 * m.xx + a11 * a11 * m.yy) + a01 * a11 * m.xy),
                weight * r}});
    }
  }
  if (rows.empty()) return;
  sum_products(rows, sums.blocks.emplace_back());
}

void Refiner::look(double robust_cut, Pixels pixels, Sums& sums) {
  std::vector<BlockSums> blocks = std::move(sums.blocks);
  blocks.clear();
  blocks.reserve(static_cast<std::size_t>(num_u_) * num_v_);
  sums = Sums{};
  sums.blocks = std::move(blocks);
  const Eigen::Matrix2d& B = model_.blur_px2;
  sharpest_px2_ = B.trace() / 2 - std::hypot(0.5 * (B(0, 0) - B(1, 1)), B(0, 1));
  const Eigen::Matrix3d to_tag = model_.H.inverse();
  std::vector<Row> rows;
  rows.reserve(static_cast<std::size_t>(block_px_) * block_px_);
  for (int bv = 0; bv < num_v_; ++bv) {
    for (int bu = 0; bu < num_u_; ++bu)
      look_at_block(bu, bv, to_tag, robust_cut, pixels, rows, sums);
  }
  // Floats suffice for a sum over blocks too: the step is small at the end, and a covariance is
  // wanted to 1e-3.
  BlockSums all{};
  for (const BlockSums& block : sums.blocks) {
    for (std::size_t i = 0; i < std::size(all.lines); ++i) {
      for (int k = 0; k < 4; ++k) all.lines[i][k] += block.lines[i][k];
    }
  }
  const Eigen::Matrix<double, kColumns, kColumns> total = all.full().cast<double>();
  sums.H = total.topLeftCorner<kParameters, kParameters>();
  sums.g = total.block<kParameters, 1>(0, kParameters);
  sums.squares = total(kParameters, kParameters);
}

/// Pixels of a later evaluation, by the blur known so far.
Pixels Refiner::all_looks() const {
  const Eigen::Matrix2d& B = model_.blur_px2;
  const double widest_px2 = B.trace() / 2 + std::hypot(0.5 * (B(0, 0) - B(1, 1)), B(0, 1));
  const bool is_blurred = std::sqrt(widest_px2) > Pattern::kNarrow * least_cell_px_;
  if (is_blurred && area_px_ * all_looks_.share() > kBlurredPixels) {
    return Pixels::lattice(area_px_, kBlurredPixels);
  }
  return all_looks_;
}

/// Motion of the image while the shutter was open, if it explains that the blur is wider in one
/// direction: straight motion of length l has the variance l²/12. Along the tag's sides [cells].
double Refiner::motion_cells(const std::vector<Eigen::Vector2d>& corners_px) const {
  const Eigen::Matrix2d motion_px2 = model_.blur_px2 - sharpest_px2_ * Eigen::Matrix2d::Identity();
  Eigen::Matrix2d cell_px;
  cell_px.col(0) = corners_px[1] - corners_px[0] + corners_px[2] - corners_px[3];
  cell_px.col(1) = corners_px[0] - corners_px[3] + corners_px[1] - corners_px[2];
  const Eigen::Matrix2d to_cells = (cell_px / (2 * cells_.border)).inverse();
  const Eigen::Matrix2d motion = to_cells * motion_px2 * to_cells.transpose();
  return std::sqrt(12 * std::max(0.0, motion.diagonal().maxCoeff()));
}

/// ∂(corners [px])/∂(geometry).
Eigen::Matrix<double, 8, kGeometry> Refiner::corner_jacobian() const {
  static const Eigen::Vector2d kSquare[4] = {{-1, 1}, {1, 1}, {1, -1}, {-1, -1}};
  Eigen::Matrix<double, 8, kGeometry> J;
  for (int k = 0; k < 4; ++k) {
    const Eigen::Vector3d q = model_.H * kSquare[k].homogeneous();
    const Eigen::Vector2d ray = q.hnormalized();
    const Eigen::Matrix2d ray_per_tag =
        (model_.H.topLeftCorner<2, 2>() - ray * model_.H.bottomLeftCorner<1, 2>()) / q.z();
    J.middleRows<2>(2 * k) = px_per_ray_[k] * ray_per_tag * displacement(kSquare[k]);
  }
  return J;
}

CornerRefinement Refiner::run(const std::vector<Eigen::Vector2d>& corners_px) {
  CornerRefinement answer = fit(corners_px);
  answer.blur_cells = blur_cells_;
  answer.num_evaluations = num_visited_;
  answer.misfit = misfit_;
  return answer;
}

CornerRefinement Refiner::fit(const std::vector<Eigen::Vector2d>& corners_px) {
  if (const CornerRefusal refusal = begin(corners_px); refusal != CornerRefusal::kNone) {
    return {std::nullopt, refusal};
  }
  const auto refuse = [](CornerRefusal why) { return CornerRefinement{std::nullopt, why}; };
  constexpr int kMaxLooks = 8;
  constexpr double kSettled_px = 0.04;  // a Gauss–Newton step this short leaves its square
  // Pixels that differ from the print by more than this share of the contrast show something else.
  // At first the corners themselves may be off.
  constexpr double kFirstCut = 0.5, kCut = 0.15;
  // [cells]: a longer motion is no Gaussian blur, and its damage no longer shows in the residuals.
  constexpr double kLongestMotion = 0.65;
  Sums sums;
  Parameters step = Parameters::Zero();
  Normal inverse = Normal::Zero();
  Eigen::Matrix<double, 8, kGeometry> J;
  bool is_settled = false;
  // A lattice is used until the blur is known; one evaluation on a grid leads near enough.
  bool is_coarse = first_look_.grid == Pixels::Grid::kLattice;
  Eigen::Matrix<double, 8, 1> moved = Eigen::Matrix<double, 8, 1>::Zero();
  for (int n = 0; n < kMaxLooks && !is_settled; ++n) {
    const double contrast = model_.light[1];
    double cut = kFirstCut * contrast;
    if (n > 0) {
      // Nor is noise: five times the mean is four standard deviations.
      cut = std::clamp(5 * sums.absolute / sums.num_pixels, kCut * contrast, cut);
    }
    const Pixels pixels = n == 0 || is_coarse ? first_look_ : all_looks();
    look(cut, pixels, sums);
    num_visited_ += sums.num_visited;
    blur_cells_ = sums.widest_blur;
    misfit_ = sums.absolute / std::max(1.0, sums.num_pixels) / contrast;
    if (sums.num_white == 0 || sums.num_black == 0) return refuse(CornerRefusal::kTooSmall);
    if (2 * sums.num_saturated_white > sums.num_white ||
        2 * sums.num_saturated_black > sums.num_black) {
      return refuse(CornerRefusal::kSaturated);
    }
    if (sums.num_pixels < 3 * kParameters) return refuse(CornerRefusal::kTooSmall);
    const Parameters scale = sums.H.diagonal().cwiseSqrt().cwiseInverse();
    if (!scale.allFinite()) return refuse(CornerRefusal::kNotFound);
    const Normal scaled = scale.asDiagonal() * sums.H * scale.asDiagonal();
    const Eigen::LDLT<Normal> factor(scaled);
    if (factor.info() != Eigen::Success || !(factor.vectorD().minCoeff() > 1e-6)) {
      return refuse(CornerRefusal::kNotFound);
    }
    step = scale.asDiagonal() * factor.solve(scale.asDiagonal() * sums.g);
    if (!step.allFinite()) return refuse(CornerRefusal::kNotFound);
    J = corner_jacobian();
    const Eigen::Matrix<double, 8, 1> change = J * step.head<kGeometry>();
    const double longest = change.cwiseAbs().maxCoeff();
    const double limited = std::min(1.0, 1.0 / longest);  // [px]
    // A blur or light that is still far off bends the profiles, and with them the corners.
    const auto b = step.tail<3>();
    const double width_px2 = model_.blur_px2.trace() / 2 + kPixelVariance_px2;
    const auto light = step.segment<kLight>(kGeometry);
    const double light_change =
        std::max({std::abs(light[1]) / model_.light[1], std::abs(light[2]), std::abs(light[3])});
    const double blur_change = b.cwiseAbs().maxCoeff() / width_px2;
    is_settled =
        n > 0 && !is_coarse && longest < kSettled_px && light_change < 0.05 && blur_change < 0.15;
    if (is_coarse && longest < 0.5 && light_change < 0.1 && blur_change < 0.15) {
      if (sums.widest_blur > 1.1 * Pattern::kWide) return refuse(CornerRefusal::kBlurred);
      is_coarse = false;
    }
    if (is_settled) inverse = scale.asDiagonal() * factor.solve(Normal(scale.asDiagonal()));
    moved += limited * change;
    if (moved.cwiseAbs().maxCoeff() > 2) return refuse(CornerRefusal::kNotFound);

    Eigen::Matrix3d D;
    const auto d = limited * step.head<kGeometry>();
    D << 1 + d[0], d[1], d[2], d[3], 1 + d[4], d[5], d[6], d[7], 1;
    model_.H = model_.H * D;
    model_.light += light;
    // Linear extrapolation to a sharper image goes too far.
    Eigen::Matrix2d blur = model_.blur_px2;
    for (int i = 0; i < 2; ++i) {
      blur(i, i) = std::clamp(blur(i, i) + b[2 * i], std::max(0.3 * blur(i, i), kSharpest_px2),
                              5 * blur(i, i) + 0.5);
    }
    const double bound = 0.95 * std::sqrt(blur(0, 0) * blur(1, 1));
    blur(0, 1) = blur(1, 0) = std::clamp(blur(0, 1) + b[1], -bound, bound);
    model_.blur_px2 = blur;
    if (!(model_.light[1] > 5)) return refuse(CornerRefusal::kLowContrast);
  }
  if (!is_settled) return refuse(CornerRefusal::kNotFound);

  if (sums.widest_blur > Pattern::kWide || motion_cells(corners_px) > kLongestMotion) {
    return refuse(CornerRefusal::kBlurred);
  }
  if (sums.num_covered > 0.08 * sums.num_edge) return refuse(CornerRefusal::kCovered);
  for (int side = 0; side < 4; ++side)
    if (sums.side_covered[side] > 0.1 * sums.side_seen[side])
      return refuse(CornerRefusal::kCovered);

  // The noise, and the correlation of residuals within blocks beyond that of independent pixels.
  const double freedom = sums.num_pixels - kParameters;
  const double left = std::max(0.0, sums.squares - step.dot(sums.g));
  // A grey value is rounded to whole levels: no residual is better than that.
  const double variance = std::max(left / freedom, 1.0 / 12);
  Matrix8d covariance = J * inverse.topLeftCorner<kGeometry, kGeometry>() * J.transpose();
  const Eigen::LLT<Matrix8d> root(covariance);
  if (root.info() != Eigen::Success) return refuse(CornerRefusal::kNotFound);
  // A block adds T (g_b − H_b step) to the whitened corners, with the covariance under independent
  // noise σ² T (H_b − H_b H⁻¹ H_b) Tᵀ; T H Tᵀ is the identity.
  using Wide = Eigen::Matrix<float, 8, kColumns>;
  Wide T = Wide::Zero();
  T.leftCols<kParameters>() = root.matrixL().solve(J * inverse.topRows<kGeometry>()).cast<float>();
  Eigen::Matrix<float, kColumns, 1> after = Eigen::Matrix<float, kColumns, 1>::Zero();
  after.head<kParameters>() = -step.cast<float>();
  after[kParameters] = 1;
  const Eigen::LLT<Normal> inverse_root(inverse);
  if (inverse_root.info() != Eigen::Success) return refuse(CornerRefusal::kNotFound);
  Full R = Full::Zero();
  R.topLeftCorner<kParameters, kParameters>() = Normal(inverse_root.matrixL()).cast<float>();
  double pulled = 0, expected = 8;
  for (const BlockSums& block : sums.blocks) {
    const Wide share = T.lazyProduct(block.full());
    pulled += share.lazyProduct(after).squaredNorm();
    expected -= Wide(share.lazyProduct(R)).squaredNorm();
  }
  // With a single block there is nothing to compare.
  if (!(expected > 0.01)) return refuse(CornerRefusal::kTooSmall);
  const double inflation =
      expected > 1 ? std::max(1.0, pulled / (variance * expected)) : 8 / expected;
  covariance *= variance * inflation;

  RefinedCorners refined;
  static const Eigen::Vector2d kSquare[4] = {{-1, 1}, {1, 1}, {1, -1}, {-1, -1}};
  for (int k = 0; k < 4; ++k) {
    const Eigen::Vector2d p_px = lens_.project(ray_of(model_.H, kSquare[k]));
    if (!p_px.allFinite()) return refuse(CornerRefusal::kNotFound);
    if (p_px.minCoeff() < 0 || p_px.x() > grey_.cols - 1 || p_px.y() > grey_.rows - 1)
      return refuse(CornerRefusal::kNoTag);
    refined.corners_px.push_back(p_px);
  }
  refined.covariance_px2 = 0.5 * (covariance + covariance.transpose());
  refined.noise_sd = std::sqrt(variance * inflation);
  refined.contrast = model_.light[1];
  refined.blur_px2 = model_.blur_px2;
  if (!refined.covariance_px2.allFinite()) return refuse(CornerRefusal::kNotFound);
  constexpr double kWorst_px = 0.15;
  if (refined.covariance_px2.diagonal().maxCoeff() > kWorst_px * kWorst_px)
    return refuse(CornerRefusal::kLowContrast);
  return {refined, CornerRefusal::kNone};
}

}  // namespace

const char* name_of(CornerRefusal refusal) {
  switch (refusal) {
    case CornerRefusal::kNone:
      return "none";
    case CornerRefusal::kNoTag:
      return "no quadrangle in the image";
    case CornerRefusal::kTooSmall:
      return "too small";
    case CornerRefusal::kLowContrast:
      return "too little contrast";
    case CornerRefusal::kSaturated:
      return "saturated";
    case CornerRefusal::kBlurred:
      return "blurred";
    case CornerRefusal::kCovered:
      return "partly covered";
    case CornerRefusal::kNotFound:
      return "no fit nearby";
  }
  return "";
}

CornerRefinement refine_corners(const cv::Mat& grey, const Lens& lens, const TagCells& cells,
                                const std::vector<Eigen::Vector2d>& corners_px) {
  if (grey.type() != CV_8UC1)
    throw std::invalid_argument("refine_corners needs an 8-bit grey image");
  if (cells.border < 3 || cells.width != cells.border + 2 ||
      cells.is_white.size() != static_cast<std::size_t>(cells.width) * cells.width) {
    throw std::invalid_argument("refine_corners: the cells are no tag with a white margin");
  }
  if (grey.empty()) return {std::nullopt, CornerRefusal::kNoTag};
  return Refiner(grey, lens, cells).run(corners_px);
}

Matrix8d detected_covariance_px2(const CornerNoise& noise, const TagCells& cells,
                                 const std::vector<Eigen::Vector2d>& corners_px,
                                 const CornerRefinement& refused) {
  // Shares of a cell. Measured: ./run experiment corner_error --only blur motion, AprilTag's d²
  // where refused; the last of tags with a tenth to a half of an edge hidden: 0.05 to 0.2 cells.
  constexpr double kBlurPull = 0.5, kMisfitPull = 0.5, kHiddenPull = 0.12;
  // A blur beyond that was no estimate: the tag was found.
  constexpr double kMostBlur = 1;
  const bool is_hidden =
      refused.refusal == CornerRefusal::kCovered || refused.refusal == CornerRefusal::kNotFound;
  const double pull = std::hypot(kBlurPull * std::pow(std::min(refused.blur_cells, kMostBlur), 3),
                                 kMisfitPull * refused.misfit, is_hidden ? kHiddenPull : 0);
  const double pull_px = pull * shortest_side_px(corners_px) / cells.border;
  const double sigma_px = std::hypot(noise.sigma_px(corners_px), pull_px);
  return sigma_px * sigma_px * Matrix8d::Identity();
}

}  // namespace bodyschema
