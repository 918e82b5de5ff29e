#include <Eigen/Geometry>
#include <Eigen/LU>
#include <algorithm>
#include <array>
#include <cmath>
#include <iterator>
#include <utility>

#include "processes/marker_estimator/corner_fit.h"

// One look at the image: the model at the pixels of a tag, and the normal equations of its fit.

namespace bodyschema::corner_fit {

constexpr int kNumNodes = 6;

namespace {

/// Chebyshev's k-th point along so many points of a lattice.
double node(int k, int size) {
  return 0.5 * (size - 1) * (1 - std::cos((k + 0.5) * M_PI / kNumNodes));
}

/// Row p: Lagrange's polynomials at the p-th of so many points of a lattice.
Eigen::Matrix<double, Eigen::Dynamic, kNumNodes> lagrange(int size) {
  Eigen::Matrix<double, Eigen::Dynamic, kNumNodes> W(size, kNumNodes);
  for (int p = 0; p < size; ++p) {
    for (int k = 0; k < kNumNodes; ++k) {
      W(p, k) = 1;
      for (int m = 0; m < kNumNodes; ++m) {
        if (m != k) W(p, k) *= (p - node(m, size)) / (node(k, size) - node(m, size));
      }
    }
  }
  return W;
}

}  // namespace

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
  constexpr int n = kNumNodes;
  Eigen::Matrix<double, n, n> x, y;
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
  if (is_smooth) {
    const Eigen::Matrix<double, Eigen::Dynamic, n> along_u = lagrange(cols),
                                                   along_v = lagrange(rows);
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

namespace {

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

}  // namespace

std::optional<Refiner::BlockMap> Refiner::map_of_block(int bu, int bv,
                                                       const Eigen::Matrix3d& to_tag) const {
  Eigen::Vector2d p[3][3];
  for (int j = 0; j < 3; ++j) {
    for (int i = 0; i < 3; ++i) {
      const Eigen::Vector2d& ray = lattice_[(2 * bv + j) * (2 * num_u_ + 1) + 2 * bu + i];
      const Eigen::Vector3d q = to_tag * ray.homogeneous();
      p[j][i] = q.hnormalized() * half_border_ + Eigen::Vector2d::Constant(half_width_);
      if (!p[j][i].allFinite()) return std::nullopt;
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
  if ((high < 0).any() || (low > width).any()) return std::nullopt;
  Eigen::Vector2d across[3][3];
  BlockMap c;
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
  return c;
}

namespace {

int stride_of(Pixels pixels) {
  if (pixels.grid == Pixels::Grid::kLattice) return pixels.spacing;
  return pixels.grid == Pixels::Grid::kAll ? 1 : 2;
}

/// The first pixel of line v that a look visits, from u0 on.
int first_u(Pixels pixels, int u0, int v) {
  if (pixels.grid == Pixels::Grid::kHalf) return u0 + v % 2;
  if (pixels.grid != Pixels::Grid::kLattice) return u0;
  const auto past =
      static_cast<int>((u0 + static_cast<std::int64_t>(pixels.offset) * v) % pixels.spacing);
  return past == 0 ? u0 : u0 + pixels.spacing - past;
}

void count_saturated(float print, uchar pixel, Sums& sums) {
  if (print > 0.9F) {
    ++sums.num_white;
    sums.num_saturated_white += pixel == 255;
  } else if (print < 0.1F) {
    ++sums.num_black;
    sums.num_saturated_black += pixel == 0;
  }
}

/// By the distances from the outline's sides.
void count_sides(const std::array<float, 4>& distances, bool is_covered, Sums& sums) {
  for (int side = 0; side < 4; ++side) {
    const bool is_near = std::abs(distances[side]) < 0.5F;
    sums.side_seen[side] += is_near;
    sums.side_covered[side] += is_near && is_covered;
  }
}

/// Shares of a pixel's row: of the weight, and with it of what light and ink make of a pixel.
struct Weighted {
  float weight, bright, ink, contrast;
};

/// The residual `r` and its derivatives, weighted. `a`: cells per pixel; `at`: place on the tag;
/// `g`: gradient there.
inline Row row_of(const Smoothed& m, const Eigen::Matrix2f& a, const Eigen::Vector2f& at,
                  const Eigen::Vector2f& g, const Weighted& w, float r) {
  const float X = at.x(), Y = at.y(), gx = g.x(), gy = g.y(), both = gx * X + gy * Y;
  const float a00 = a(0, 0), a01 = a(0, 1), a10 = a(1, 0), a11 = a(1, 1);
  return {Lane{-gx * X, -gx * Y, -gx, -gy * X}, Lane{-gy * Y, -gy, both * X, both * Y},
          Lane{w.bright, w.bright * m.m, w.ink * X, w.ink * Y},
          Lane{w.contrast * (0.5F * (a00 * a00 * m.xx + a10 * a10 * m.yy) + a00 * a10 * m.xy),
               w.contrast * (a00 * a01 * m.xx + a10 * a11 * m.yy + (a00 * a11 + a01 * a10) * m.xy),
               w.contrast * (0.5F * (a01 * a01 * m.xx + a11 * a11 * m.yy) + a01 * a11 * m.xy),
               w.weight * r}};
}

}  // namespace

// One loop, though long: what it needs of the block stays in registers.
void Refiner::look_at_block(int bu, int bv, const Eigen::Matrix3d& to_tag, double robust_cut,
                            Pixels pixels, std::vector<Row>& rows, Sums& sums) const {
  const std::optional<BlockMap> map = map_of_block(bu, bv, to_tag);
  if (!map) return;
  const BlockMap& c = *map;
  const double half_px = 0.5 * block_px_;
  Eigen::Matrix2d A;  // cells per pixel
  A.col(0) = c[0][1] / half_px;
  A.col(1) = c[1][0] / half_px;
  const Smoothing smooth(A, model_.blur_px2, sharpest_px2_);
  sums.widest_blur = std::max(sums.widest_blur, smooth.widest());
  // Beyond the white margin anything may lie.
  const float low_limit[2] = {smooth.tail(0), smooth.tail(1)};
  const auto width = static_cast<float>(cells_.width);
  const float high_limit[2] = {width - low_limit[0], width - low_limit[1]};

  const Eigen::Matrix<float, kLight, 1> light = model_.light.cast<float>();
  const Eigen::Matrix2f a = A.cast<float>();
  const auto cut = static_cast<float>(robust_cut);
  const float inverse_half = static_cast<float>(1 / half_border_);
  const float gradient_scale = static_cast<float>(half_border_);
  const float border_low = static_cast<float>(half_width_ - half_border_);
  const float border_high = static_cast<float>(half_width_ + half_border_);
  const int u0 = origin_.x + bu * block_px_, v0 = origin_.y + bv * block_px_;
  const int u1 = std::min(u0 + block_px_, grey_.cols), v1 = std::min(v0 + block_px_, grey_.rows);
  const auto first = static_cast<float>(0.5 - half_px), per_half = static_cast<float>(1 / half_px);
  const bool is_lattice = pixels.grid == Pixels::Grid::kLattice;
  const int stride = stride_of(pixels);
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
    for (int u = first_u(pixels, u0, v); u < u1; u += stride) {
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
      count_saturated(m.m, pixel, sums);
      if ((pixel == 255 && expected > 254.5F) || (pixel == 0 && expected < 0.5F)) continue;
      const float r = static_cast<float>(pixel) - std::clamp(expected, 0.0F, 255.0F);
      float weight = 1;
      sums.num_edge += !is_flat;
      const bool is_covered = std::abs(r) > cut;
      if (is_covered) weight = cut / std::abs(r);
      sums.num_covered += is_covered && !is_flat;
      count_sides({y - border_high, x - border_high, y - border_low, x - border_low}, is_covered,
                  sums);
      if (expected < 0 || expected > 255) continue;
      sums.num_pixels += weight * weight;
      sums.absolute += weight * std::abs(r);
      const float wc = weight * contrast;
      rows.push_back(row_of(m, a, {X, Y}, {wc * m.x * gradient_scale, wc * m.y * gradient_scale},
                            {weight, weight * bright, weight * ink, wc}, r));
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

}  // namespace bodyschema::corner_fit
