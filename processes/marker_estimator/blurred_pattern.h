#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <vector>

#include "processes/marker_estimator/corner_refinement.h"

// What a blurred camera sees of a printed tag, and how it changes with the place on the tag.

namespace bodyschema::corner_fit {

inline constexpr double kPixelVariance_px2 = 1.0 / 12;  // of the pixel's own square, per axis

using Lane = float __attribute__((vector_size(16)));

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

inline const NormalTable kNormal;

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

  // Blurs [cells] up to which two and three lines in a direction are enough: the line behind the
  // last one that is counted is 2.6 standard deviations away or more.
  static constexpr float kMedium = 0.38F, kWide = 0.55F;

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
  [[gnu::always_inline]] bool operator()(const Pattern& pattern, float x, float y,
                                         Smoothed& s) const {
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
  [[gnu::always_inline]] Smoothed at_crossing(const Pattern& pattern, float x, float y) const {
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

}  // namespace bodyschema::corner_fit
