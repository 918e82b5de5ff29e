#include "tests/support/tag_view.h"

#include <Eigen/Geometry>
#include <Eigen/LU>
#include <algorithm>
#include <array>
#include <cmath>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>
#include <stdexcept>

#include "common/camera/fit_pose.h"
#include "common/scene/tag_bitmap.h"

namespace bodyschema::test {
namespace {

constexpr int kCells = 10;

std::array<Eigen::Vector2d, 64> hammersley() {
  std::array<Eigen::Vector2d, 64> points;
  for (int i = 0; i < 64; ++i) {
    int reversed = 0;
    for (int bit = 0; bit < 6; ++bit) reversed |= (i >> bit & 1) << (5 - bit);
    points[i] = {(i + 0.5) / 64, (reversed + 0.5) / 64};
  }
  return points;
}

std::vector<Eigen::Vector2d> project(const Plate& plate, const Lens& lens, double size_m) {
  std::vector<Eigen::Vector2d> pixels;
  for (const Eigen::Vector3d& p_MP : tag_corners(size_m)) {
    const Eigen::Vector3d p_C = plate.X_CM * p_MP;
    pixels.push_back(lens.project(p_C.head<2>() / p_C.z()));
  }
  return pixels;
}

/// Mean along a straight line of `length` in the image, its middle in place.
cv::Mat along(const cv::Mat& image, const Eigen::Vector2d& length) {
  const int steps = std::max(2, static_cast<int>(std::ceil(length.norm())));
  cv::Mat sum = cv::Mat::zeros(image.size(), CV_64FC1), moved;
  for (int i = 0; i < steps; ++i) {
    const Eigen::Vector2d d = ((i + 0.5) / steps - 0.5) * length;
    const cv::Matx23d shift(1, 0, d.x(), 0, 1, d.y());
    cv::warpAffine(image, moved, shift, image.size(), cv::INTER_LINEAR, cv::BORDER_REPLICATE);
    sum += moved;
  }
  return sum / steps;
}

}  // namespace

camera_info_t camera_around(const Plate& plate, const camera_info_t& camera) {
  Eigen::Vector2d low(1e9, 1e9), high(-1e9, -1e9);
  for (const Eigen::Vector2d& p : project(plate, Lens(camera), plate.size_m * 10 / 8)) {
    low = low.cwiseMin(p);
    high = high.cwiseMax(p);
  }
  constexpr int kMargin_px = 16;
  const auto whole_blocks = [](double value) {
    return static_cast<int>(std::floor(value / 8)) * 8;
  };
  const int u0 = whole_blocks(low.x() - kMargin_px), v0 = whole_blocks(low.y() - kMargin_px);
  camera_info_t around = camera;
  around.cx -= u0;
  around.cy -= v0;
  around.image_width = whole_blocks(high.x() + kMargin_px) + 8 - u0;
  around.image_height = whole_blocks(high.y() + kMargin_px) + 8 - v0;
  return around;
}

/// Positions of the pixels' corners on the tag; within a pixel the map is bilinear.
std::vector<Eigen::Vector2d> TagView::lattice_on_tag(const Lens& lens) const {
  const int cols = camera_.image_width, rows = camera_.image_height;
  std::vector<Eigen::Vector2d> lattice(static_cast<std::size_t>(cols + 1) * (rows + 1));
  for (int v = 0; v <= rows; ++v) {
    for (int u = 0; u <= cols; ++u) {
      const auto point = lens.straighten({u - 0.5, v - 0.5});
      lattice[v * (cols + 1) + u] =
          point ? Eigen::Vector2d((to_tag_ * point->ray.homogeneous()).hnormalized())
                : Eigen::Vector2d(100, 100);
    }
  }
  return lattice;
}

/// The picture of unit contrast at `rays_per_px` times the resolution, `beyond` the plate's edges;
/// also finds the plate's pixels.
cv::Mat TagView::many_rays(int id, const std::vector<Eigen::Vector2d>& lattice, double beyond) {
  const int n = options_.rays_per_px;
  const int cols = camera_.image_width, rows = camera_.image_height;
  // Value of the print; −1: beyond the plate.
  const cv::Mat bitmap = tag_bitmap(id, 1);
  const auto cell = [&](const Eigen::Vector2d& p) {
    const Eigen::Vector2d c = 4 * p + Eigen::Vector2d::Constant(kCells / 2.0);
    if (!(c.minCoeff() >= 0 && c.maxCoeff() < kCells)) return -1;
    return static_cast<int>(c.y()) * kCells + static_cast<int>(c.x());
  };
  const auto ink = [&](int c) {
    return c < 0 ? beyond : bitmap.at<uchar>(c / kCells, c % kCells) ? 1.0 : 0.0;
  };
  const auto points = hammersley();
  cv::Mat fine(rows * n, cols * n, CV_64FC1);
  is_plate_ = cv::Mat::zeros(rows, cols, CV_8UC1);
  for (int v = 0; v < rows; ++v) {
    for (int u = 0; u < cols; ++u) {
      const Eigen::Vector2d* a = &lattice[v * (cols + 1) + u];
      const Eigen::Vector2d* b = a + cols + 1;
      const auto on_tag = [&](double s, double t) -> Eigen::Vector2d {
        return (1 - t) * ((1 - s) * a[0] + s * a[1]) + t * ((1 - s) * b[0] + s * b[1]);
      };
      is_plate_.at<uchar>(v, u) =
          cell(a[0]) >= 0 && cell(a[1]) >= 0 && cell(b[0]) >= 0 && cell(b[1]) >= 0;
      for (int j = 0; j < n; ++j) {
        for (int i = 0; i < n; ++i) {
          const auto at = [&](double s, double t) { return on_tag((i + s) / n, (j + t) / n); };
          const int first = cell(at(0, 0));
          double sum = ink(first);
          if (cell(at(1, 0)) != first || cell(at(0, 1)) != first || cell(at(1, 1)) != first) {
            sum = 0;
            for (const Eigen::Vector2d& p : points) sum += ink(cell(at(p.x(), p.y())));
            sum /= static_cast<double>(points.size());
          }
          fine.at<double>(v * n + j, u * n + i) = sum;
        }
      }
    }
  }
  return fine;
}

TagView::TagView(const Plate& plate, const camera_info_t& camera, const TagViewOptions& options)
    : camera_(camera), options_(options) {
  if (options.rays_per_px < 4) throw std::invalid_argument("rays_per_px below 4");
  const Lens lens(camera);
  corners_px_ = project(plate, lens, plate.size_m);
  const double half_m = plate.size_m / 2;
  Eigen::Matrix3d from_tag;
  from_tag << plate.X_CM.linear().col(0) * half_m, plate.X_CM.linear().col(1) * half_m,
      plate.X_CM.translation();
  to_tag_ = from_tag.inverse();

  const int n = options.rays_per_px;
  const int cols = camera.image_width, rows = camera.image_height;
  const double dark = options.black, contrast = options.white - options.black;
  cv::Mat fine = many_rays(plate.id, lattice_on_tag(lens), (options.background - dark) / contrast);
  if (options.blur_px > 0) {
    const int reach = static_cast<int>(std::ceil(6 * options.blur_px * n));
    cv::GaussianBlur(fine, fine, {2 * reach + 1, 2 * reach + 1}, options.blur_px * n,
                     options.blur_px * n, cv::BORDER_REPLICATE);
  }
  if (!options.motion_px.isZero()) fine = along(fine, n * options.motion_px);

  const Eigen::Vector2d centre =
      (corners_px_[0] + corners_px_[1] + corners_px_[2] + corners_px_[3]) / 4;
  exact_.create(rows, cols, CV_64FC1);
  for (int v = 0; v < rows; ++v) {
    for (int u = 0; u < cols; ++u) {
      const double mean = cv::mean(fine(cv::Rect(u * n, v * n, n, n)))[0];
      const double light = 1 + options.light_gradient.dot(Eigen::Vector2d(u, v) - centre);
      exact_.at<double>(v, u) = light * (dark + contrast * mean);
    }
  }
  fine_ = fine;
}

cv::Mat TagView::taken(double noise_sd, std::uint64_t seed, int jpeg_quality) const {
  cv::Mat noise(exact_.size(), CV_64FC1);
  cv::RNG random(seed * 0x9e3779b97f4a7c15ULL + 1);
  random.fill(noise, cv::RNG::NORMAL, 0, noise_sd);
  cv::Mat grey;
  cv::Mat(exact_ + noise).convertTo(grey, CV_8U);
  if (jpeg_quality <= 0) return grey;
  std::vector<uchar> bytes;
  cv::imencode(".jpg", grey, bytes, {cv::IMWRITE_JPEG_QUALITY, jpeg_quality});
  return cv::imdecode(bytes, cv::IMREAD_GRAYSCALE);
}

Eigen::Matrix<double, 8, 8> TagView::cramer_rao_px2(double noise_sd) const {
  const Lens lens(camera_);
  const int n = options_.rays_per_px;
  const double contrast = options_.white - options_.black;
  // Displacement of an image point with the corners: of the ray by the homography, of the pixel by
  // the lens.
  static const Eigen::Vector2d kSquare[4] = {{-1, 1}, {1, 1}, {1, -1}, {-1, -1}};
  const Eigen::Matrix3d from_tag = to_tag_.inverse();
  const auto displacement = [&](const Eigen::Vector2d& p) {
    const Eigen::Vector3d q = from_tag * p.homogeneous();
    const Eigen::Vector2d ray = q.hnormalized();
    const Eigen::Matrix2d ray_per_tag =
        (from_tag.topLeftCorner<2, 2>() - ray * from_tag.bottomLeftCorner<1, 2>()) / q.z();
    Eigen::Matrix<double, 2, 8> D;
    D << p.x(), p.y(), 1, 0, 0, 0, -p.x() * p.x(), -p.x() * p.y(),  //
        0, 0, 0, p.x(), p.y(), 1, -p.y() * p.x(), -p.y() * p.y();
    return Eigen::Matrix<double, 2, 8>(lens.straighten(lens.project(ray))->px_per_ray *
                                       ray_per_tag * D);
  };
  Eigen::Matrix<double, 8, 8> corners_per_geometry;
  for (int k = 0; k < 4; ++k) {
    corners_per_geometry.middleRows<2>(2 * k) = displacement(kSquare[k]);
  }
  const Eigen::Matrix<double, 8, 8> geometry_per_corners = corners_per_geometry.inverse();
  Eigen::Matrix<double, 11, 11> information = Eigen::Matrix<double, 11, 11>::Zero();
  for (int v = 1; v + 1 < exact_.rows; ++v) {
    for (int u = 1; u + 1 < exact_.cols; ++u) {
      if (!is_plate_.at<uchar>(v, u)) continue;
      const auto mean = [&](int du, int dv) {
        return cv::mean(fine_(cv::Rect(u * n + du, v * n + dv, n, n)))[0];
      };
      const double here = mean(0, 0), left = mean(-1, 0), right = mean(1, 0), up = mean(0, -1),
                   down = mean(0, 1);
      const Eigen::RowVector2d gradient((right - left) * n / 2, (down - up) * n / 2);
      const double laplacian = (left + right + up + down - 4 * here) * n * n;
      const auto point = lens.straighten({u, v});
      if (!point) continue;
      const Eigen::Vector2d p = (to_tag_ * point->ray.homogeneous()).hnormalized();
      Eigen::Matrix<double, 11, 1> J;
      // A pattern that moves by d shows at a pixel the value from d before it.
      J.head<8>() = -contrast * (gradient * displacement(p) * geometry_per_corners).transpose();
      J[8] = 1 - here;
      J[9] = here;
      J[10] = contrast * laplacian / 2;
      information += J * J.transpose();
    }
  }
  return noise_sd * noise_sd * information.inverse().topLeftCorner<8, 8>();
}

}  // namespace bodyschema::test
