#include "tests/experiments/edge_corners.h"

#include <Eigen/Eigenvalues>
#include <Eigen/Geometry>
#include <Eigen/LU>
#include <algorithm>
#include <array>
#include <cmath>
#include <numeric>

#include "common/camera/fit_pose.h"

namespace bodyschema::test {
namespace {

const Eigen::Vector2d kSquare[4] = {{-1, 1}, {1, 1}, {1, -1}, {-1, -1}};

double cubic(double a, double b, double c, double d, double t) {  // Catmull and Rom
  return b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)));
}

std::optional<double> grey_at(const cv::Mat& image, const Eigen::Vector2d& p) {
  const int u = static_cast<int>(std::floor(p.x())), v = static_cast<int>(std::floor(p.y()));
  if (u < 1 || v < 1 || u + 2 >= image.cols || v + 2 >= image.rows) return std::nullopt;
  double rows[4];
  for (int j = 0; j < 4; ++j) {
    const uchar* row = image.ptr<uchar>(v - 1 + j) + u - 1;
    rows[j] = cubic(row[0], row[1], row[2], row[3], p.x() - u);
  }
  return cubic(rows[0], rows[1], rows[2], rows[3], p.y() - v);
}

struct EdgeLine {
  Eigen::Vector2d point, normal;  ///< in rays; the normal has unit length
  Eigen::Vector2d along;
  Eigen::Matrix2d covariance;  ///< of (offset along the normal at `point`, slope)
};

Eigen::Matrix3d homography(const std::vector<Eigen::Vector2d>& rays) {
  Matrix8d A = Matrix8d::Zero();
  Eigen::Matrix<double, 8, 1> b;
  for (int k = 0; k < 4; ++k) {
    for (int i = 0; i < 2; ++i) {
      A.block<1, 3>(2 * k + i, 3 * i) = kSquare[k].homogeneous().transpose();
      A.block<1, 2>(2 * k + i, 6) = -rays[k][i] * kSquare[k].transpose();
      b[2 * k + i] = rays[k][i];
    }
  }
  const Eigen::Matrix<double, 8, 1> h = A.partialPivLu().solve(b);
  Eigen::Matrix3d H;
  H << h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], 1;
  return H;
}

/// Robust by Huber's weights.
EdgeLine line_through(const std::vector<Eigen::Vector2d>& points) {
  std::vector<double> weights(points.size(), 1.0);
  EdgeLine line;
  for (int round = 0; round < 5; ++round) {
    double total = 0;
    Eigen::Vector2d mean = Eigen::Vector2d::Zero();
    for (std::size_t i = 0; i < points.size(); ++i) {
      total += weights[i];
      mean += weights[i] * points[i];
    }
    mean /= total;
    Eigen::Matrix2d scatter = Eigen::Matrix2d::Zero();
    for (std::size_t i = 0; i < points.size(); ++i) {
      scatter += weights[i] * (points[i] - mean) * (points[i] - mean).transpose();
    }
    const Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d> eigen(scatter);
    line.point = mean;
    line.normal = eigen.eigenvectors().col(0);
    line.along = eigen.eigenvectors().col(1);
    std::vector<double> distances;
    for (const auto& p : points) distances.push_back(std::abs(line.normal.dot(p - mean)));
    std::vector<double> sorted = distances;
    std::nth_element(sorted.begin(), sorted.begin() + sorted.size() / 2, sorted.end());
    const double sd = std::max(1.4826 * sorted[sorted.size() / 2], 1e-9);
    // Neighbouring profiles share pixels: each is worth about half a measurement.
    line.covariance =
        Eigen::Vector2d(2 * sd * sd / total, 2 * sd * sd / eigen.eigenvalues()[1]).asDiagonal();
    for (std::size_t i = 0; i < points.size(); ++i) {
      weights[i] = std::min(1.0, 2 * sd / std::max(distances[i], 1e-12));
    }
  }
  return line;
}

/// The line through the centroids on side k, from corner k to the next.
std::optional<EdgeLine> fit_edge(const cv::Mat& grey, const Lens& lens, int border,
                                 const Eigen::Matrix3d& H, int k) {
  const Eigen::Vector2d from = kSquare[k], to = kSquare[(k + 1) % 4];
  const Eigen::Vector2d outward = 0.5 * (from + to);
  const auto pixel = [&](const Eigen::Vector2d& p) -> Eigen::Vector2d {
    return lens.project((H * p.homogeneous()).hnormalized());
  };
  const double length_px = (pixel(to) - pixel(from)).norm();
  const int num_places = std::clamp(static_cast<int>(length_px), 8, 400);
  const double cell = 2.0 / border;
  std::vector<Eigen::Vector2d> points;
  for (int i = 0; i < num_places; ++i) {
    // The edge is not straight near the corners.
    const double share = (cell * 0.6 + (2 - 1.2 * cell) * (i + 0.5) / num_places) / 2;
    const Eigen::Vector2d place = from + share * (to - from);
    const double px_per_unit =
        (pixel(place + 0.5 * cell * outward) - pixel(place)).norm() / (0.5 * cell);
    const double reach = std::min(0.8 * cell, 3.0 / px_per_unit);
    constexpr int kSteps = 24;
    double previous = 0, sum = 0, moment = 0;
    bool is_inside = true;
    for (int s = 0; s <= kSteps && is_inside; ++s) {
      const double d = reach * (2.0 * s / kSteps - 1);
      const auto value = grey_at(grey, pixel(place + d * outward));
      if (!value) {
        is_inside = false;
      } else if (s > 0) {
        const double rise = *value - previous;
        sum += rise;
        moment += rise * (d - reach / kSteps);
      }
      previous = value.value_or(0);
    }
    if (!is_inside || sum < 10) continue;
    const double d = moment / sum;
    if (std::abs(d) > 0.6 * reach) continue;
    points.push_back((H * (place + d * outward).homogeneous()).hnormalized());
  }
  if (points.size() < 6) return std::nullopt;
  return line_through(points);
}

}  // namespace

std::optional<RefinedCorners> edge_corners(const cv::Mat& grey, const Lens& lens, int border,
                                           const std::vector<Eigen::Vector2d>& corners_px) {
  std::vector<Eigen::Vector2d> rays;
  for (const Eigen::Vector2d& p : corners_px) {
    const auto point = lens.straighten(p);
    if (!point) return std::nullopt;
    rays.push_back(point->ray);
  }
  RefinedCorners refined;
  for (int round = 0; round < 2; ++round) {
    const Eigen::Matrix3d H = homography(rays);
    std::array<EdgeLine, 4> lines;
    for (int k = 0; k < 4; ++k) {
      const auto line = fit_edge(grey, lens, border, H, k);
      if (!line) return std::nullopt;
      lines[k] = *line;
    }
    refined.corners_px.clear();
    // Corner k lies on the edges k − 1 and k; every edge has an offset and a slope of its own.
    Eigen::Matrix<double, 8, 8> J = Eigen::Matrix<double, 8, 8>::Zero();
    Eigen::Matrix<double, 8, 8> S = Eigen::Matrix<double, 8, 8>::Zero();
    for (int k = 0; k < 4; ++k) {
      const EdgeLine &a = lines[(k + 3) % 4], &b = lines[k];
      Eigen::Matrix2d N;
      N << a.normal.transpose(), b.normal.transpose();
      const Eigen::Matrix2d inverse = N.inverse();
      rays[k] = inverse * Eigen::Vector2d(a.normal.dot(a.point), b.normal.dot(b.point));
      const auto point = lens.straighten(lens.project(rays[k]));
      if (!point) return std::nullopt;
      refined.corners_px.push_back(lens.project(rays[k]));
      const int from[2] = {(k + 3) % 4, k};
      for (int i = 0; i < 2; ++i) {
        const EdgeLine& line = lines[from[i]];
        const Eigen::Vector2d along(1, line.along.dot(rays[k] - line.point));
        J.block<2, 2>(2 * k, 2 * from[i]) = point->px_per_ray * inverse.col(i) * along.transpose();
      }
      S.block<2, 2>(2 * k, 2 * k) = lines[k].covariance;
    }
    refined.covariance_px2 = J * S * J.transpose();
  }
  return refined;
}

}  // namespace bodyschema::test
