#include "processes/marker_estimator/corner_refinement.h"

#include <Eigen/Cholesky>
#include <Eigen/Geometry>
#include <Eigen/LU>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "processes/marker_estimator/corner_fit.h"

namespace bodyschema {
namespace corner_fit {
namespace {

constexpr double kTypicalBlur_px2 = 0.5;  // where the fit begins
constexpr double kSharpest_px2 = 1e-3;
const Eigen::Vector2d kSquare[4] = {{-1, 1}, {1, 1}, {1, -1}, {-1, -1}};  // in the order of corners

Eigen::Matrix3d homography_from(const std::array<Eigen::Vector2d, 4>& rays) {
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
}  // namespace

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

Pixels Refiner::all_looks() const {
  const Eigen::Matrix2d& B = model_.blur_px2;
  const double widest_px2 = B.trace() / 2 + std::hypot(0.5 * (B(0, 0) - B(1, 1)), B(0, 1));
  constexpr double kFlat = 0.19;  // [cells]: with less blur most pixels are flat, and cost little
  const bool is_blurred = std::sqrt(widest_px2) > kFlat * least_cell_px_;
  if (is_blurred && area_px_ * all_looks_.share() > kBlurredPixels) {
    return Pixels::lattice(area_px_, kBlurredPixels);
  }
  return all_looks_;
}

double Refiner::motion_cells(const std::vector<Eigen::Vector2d>& corners_px) const {
  const Eigen::Matrix2d motion_px2 = model_.blur_px2 - sharpest_px2_ * Eigen::Matrix2d::Identity();
  Eigen::Matrix2d cell_px;
  cell_px.col(0) = corners_px[1] - corners_px[0] + corners_px[2] - corners_px[3];
  cell_px.col(1) = corners_px[0] - corners_px[3] + corners_px[1] - corners_px[2];
  const Eigen::Matrix2d to_cells = (cell_px / (2 * cells_.border)).inverse();
  const Eigen::Matrix2d motion = to_cells * motion_px2 * to_cells.transpose();
  return std::sqrt(12 * std::max(0.0, motion.diagonal().maxCoeff()));
}

Eigen::Matrix<double, 8, kGeometry> Refiner::corner_jacobian() const {
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

CornerRefusal Refiner::look_again(int n, bool is_coarse, Sums* sums) {
  // Pixels that differ from the print by more than this share of the contrast show something else.
  // At first the corners themselves may be off.
  constexpr double kFirstCut = 0.5, kCut = 0.15;
  const double contrast = model_.light[1];
  double cut = kFirstCut * contrast;
  if (n > 0) {
    // Nor is noise: five times the mean is four standard deviations.
    cut = std::clamp(5 * sums->absolute / sums->num_pixels, kCut * contrast, cut);
  }
  look(cut, n == 0 || is_coarse ? first_look_ : all_looks(), *sums);
  num_visited_ += sums->num_visited;
  blur_cells_ = sums->widest_blur;
  misfit_ = sums->absolute / std::max(1.0, sums->num_pixels) / contrast;
  if (sums->num_white == 0 || sums->num_black == 0) return CornerRefusal::kTooSmall;
  if (2 * sums->num_saturated_white > sums->num_white ||
      2 * sums->num_saturated_black > sums->num_black)
    return CornerRefusal::kSaturated;
  return sums->num_pixels < 3 * kParameters ? CornerRefusal::kTooSmall : CornerRefusal::kNone;
}

std::optional<Refiner::Step> Refiner::solve(const Sums& sums) const {
  Step step;
  step.scale = sums.H.diagonal().cwiseSqrt().cwiseInverse();
  if (!step.scale.allFinite()) return std::nullopt;
  step.factor.compute(step.scale.asDiagonal() * sums.H * step.scale.asDiagonal());
  if (step.factor.info() != Eigen::Success || !(step.factor.vectorD().minCoeff() > 1e-6))
    return std::nullopt;
  step.delta = step.scale.asDiagonal() * step.factor.solve(step.scale.asDiagonal() * sums.g);
  if (!step.delta.allFinite()) return std::nullopt;
  step.J = corner_jacobian();
  step.change_px = step.J * step.delta.head<kGeometry>();
  const auto light = step.delta.segment<kLight>(kGeometry);
  step.light_change =
      std::max({std::abs(light[1]) / model_.light[1], std::abs(light[2]), std::abs(light[3])});
  step.blur_change = step.delta.tail<3>().cwiseAbs().maxCoeff() /
                     (model_.blur_px2.trace() / 2 + kPixelVariance_px2);
  return step;
}

void Refiner::move(const Parameters& delta, double share_of_geometry) {
  Eigen::Matrix3d D;
  const auto d = share_of_geometry * delta.head<kGeometry>();
  D << 1 + d[0], d[1], d[2], d[3], 1 + d[4], d[5], d[6], d[7], 1;
  model_.H = model_.H * D;
  model_.light += delta.segment<kLight>(kGeometry);
  // Linear extrapolation to a sharper image goes too far.
  const auto b = delta.tail<3>();
  Eigen::Matrix2d blur = model_.blur_px2;
  for (int i = 0; i < 2; ++i) {
    blur(i, i) = std::clamp(blur(i, i) + b[2 * i], std::max(0.3 * blur(i, i), kSharpest_px2),
                            5 * blur(i, i) + 0.5);
  }
  const double bound = 0.95 * std::sqrt(blur(0, 0) * blur(1, 1));
  blur(0, 1) = blur(1, 0) = std::clamp(blur(0, 1) + b[1], -bound, bound);
  model_.blur_px2 = blur;
}

CornerRefinement Refiner::fit(const std::vector<Eigen::Vector2d>& corners_px) {
  const auto refuse = [](CornerRefusal why) { return CornerRefinement{std::nullopt, why}; };
  if (const CornerRefusal why = begin(corners_px); why != CornerRefusal::kNone) return refuse(why);
  constexpr int kMaxLooks = 8;
  constexpr double kSettled_px = 0.04;  // a Gauss–Newton step this short leaves its square
  Sums sums;
  std::optional<Step> step;
  bool is_settled = false;
  // A lattice is used until the blur is known; one evaluation on a grid leads near enough.
  bool is_coarse = first_look_.grid == Pixels::Grid::kLattice;
  Eigen::Matrix<double, 8, 1> moved = Eigen::Matrix<double, 8, 1>::Zero();
  for (int n = 0; n < kMaxLooks && !is_settled; ++n) {
    if (const CornerRefusal why = look_again(n, is_coarse, &sums); why != CornerRefusal::kNone)
      return refuse(why);
    step = solve(sums);
    if (!step) return refuse(CornerRefusal::kNotFound);
    const double longest = step->change_px.cwiseAbs().maxCoeff();
    // A blur or light that is still far off bends the profiles, and with them the corners.
    is_settled = n > 0 && !is_coarse && longest < kSettled_px && step->light_change < 0.05 &&
                 step->blur_change < 0.15;
    if (is_coarse && longest < 0.5 && step->light_change < 0.1 && step->blur_change < 0.15) {
      if (sums.widest_blur > 1.1 * Pattern::kWide) return refuse(CornerRefusal::kBlurred);
      is_coarse = false;
    }
    const double limited = std::min(1.0, 1.0 / longest);  // [px]
    moved += limited * step->change_px;
    if (moved.cwiseAbs().maxCoeff() > 2) return refuse(CornerRefusal::kNotFound);
    move(step->delta, limited);
    if (!(model_.light[1] > 5)) return refuse(CornerRefusal::kLowContrast);
  }
  if (!is_settled) return refuse(CornerRefusal::kNotFound);
  if (const CornerRefusal why = visible_damage(sums, corners_px); why != CornerRefusal::kNone)
    return refuse(why);
  return conclude(sums, *step);
}

CornerRefusal Refiner::visible_damage(const Sums& sums,
                                      const std::vector<Eigen::Vector2d>& corners_px) const {
  // [cells]: a longer motion is no Gaussian blur, and its damage no longer shows in the residuals.
  constexpr double kLongestMotion = 0.65;
  if (sums.widest_blur > Pattern::kWide || motion_cells(corners_px) > kLongestMotion)
    return CornerRefusal::kBlurred;
  if (sums.num_covered > 0.08 * sums.num_edge) return CornerRefusal::kCovered;
  for (int side = 0; side < 4; ++side)
    if (sums.side_covered[side] > 0.1 * sums.side_seen[side]) return CornerRefusal::kCovered;
  return CornerRefusal::kNone;
}

std::optional<double> Refiner::inflation(const Sums& sums, const Step& step, const Normal& inverse,
                                         const Eigen::LLT<Matrix8d>& root, double variance) const {
  // A block adds T (g_b − H_b step) to the whitened corners, with the covariance under independent
  // noise σ² T (H_b − H_b H⁻¹ H_b) Tᵀ; T H Tᵀ is the identity.
  using Wide = Eigen::Matrix<float, 8, kColumns>;
  Wide T = Wide::Zero();
  T.leftCols<kParameters>() =
      root.matrixL().solve(step.J * inverse.topRows<kGeometry>()).cast<float>();
  Eigen::Matrix<float, kColumns, 1> after = Eigen::Matrix<float, kColumns, 1>::Zero();
  after.head<kParameters>() = -step.delta.cast<float>();
  after[kParameters] = 1;
  const Eigen::LLT<Normal> inverse_root(inverse);
  if (inverse_root.info() != Eigen::Success) return std::nullopt;
  Full R = Full::Zero();
  R.topLeftCorner<kParameters, kParameters>() = Normal(inverse_root.matrixL()).cast<float>();
  double pulled = 0, expected = 8;
  for (const BlockSums& block : sums.blocks) {
    const Wide share = T.lazyProduct(block.full());
    pulled += share.lazyProduct(after).squaredNorm();
    expected -= Wide(share.lazyProduct(R)).squaredNorm();
  }
  if (!(expected > 0.01)) return 0;
  return expected > 1 ? std::max(1.0, pulled / (variance * expected)) : 8 / expected;
}

CornerRefinement Refiner::conclude(const Sums& sums, const Step& step) const {
  const auto refuse = [](CornerRefusal why) { return CornerRefinement{std::nullopt, why}; };
  const Normal inverse =
      step.scale.asDiagonal() * step.factor.solve(Normal(step.scale.asDiagonal()));
  const double freedom = sums.num_pixels - kParameters;
  const double left = std::max(0.0, sums.squares - step.delta.dot(sums.g));
  // A grey value is rounded to whole levels: no residual is better than that.
  const double variance = std::max(left / freedom, 1.0 / 12);
  Matrix8d covariance = step.J * inverse.topLeftCorner<kGeometry, kGeometry>() * step.J.transpose();
  const Eigen::LLT<Matrix8d> root(covariance);
  if (root.info() != Eigen::Success) return refuse(CornerRefusal::kNotFound);
  const auto inflation = this->inflation(sums, step, inverse, root, variance);
  if (!inflation) return refuse(CornerRefusal::kNotFound);
  // With a single block there is nothing to compare.
  if (*inflation == 0) return refuse(CornerRefusal::kTooSmall);
  covariance *= variance * *inflation;

  RefinedCorners refined;
  for (int k = 0; k < 4; ++k) {
    const Eigen::Vector2d p_px = lens_.project(ray_of(model_.H, kSquare[k]));
    if (!p_px.allFinite()) return refuse(CornerRefusal::kNotFound);
    if (p_px.minCoeff() < 0 || p_px.x() > grey_.cols - 1 || p_px.y() > grey_.rows - 1)
      return refuse(CornerRefusal::kNoTag);
    refined.corners_px.push_back(p_px);
  }
  refined.covariance_px2 = 0.5 * (covariance + covariance.transpose());
  refined.noise_sd = std::sqrt(variance * *inflation);
  refined.contrast = model_.light[1];
  refined.blur_px2 = model_.blur_px2;
  if (!refined.covariance_px2.allFinite()) return refuse(CornerRefusal::kNotFound);
  constexpr double kWorst_px = 0.15;
  if (refined.covariance_px2.diagonal().maxCoeff() > kWorst_px * kWorst_px)
    return refuse(CornerRefusal::kLowContrast);
  return {refined, CornerRefusal::kNone};
}

}  // namespace corner_fit

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
  return corner_fit::Refiner(grey, lens, cells).run(corners_px);
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
