// Errors of a tag's corners. Rendered tags with known corners over side, tilt, blur,
// noise, JPEG quality, light and lens: AprilTag's own corners, OpenCV's cornerSubPix, lines along
// the edges (edge_corners.h) and the fit to the grey values (corner_refinement.h), beside the
// Cramér–Rao bound of the pixels. Prints Markdown.
//
//   corner_error --views 12 --frames 12

#include <CLI/CLI.hpp>
#include <Eigen/Cholesky>
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <functional>
#include <map>
#include <opencv2/imgproc.hpp>
#include <random>
#include <string>
#include <vector>

#include "common/bus/convert.h"
#include "common/camera/fit_pose.h"
#include "common/geometry/angle.h"
#include "processes/marker_estimator/corner_refinement.h"
#include "processes/marker_estimator/tag_detector.h"
#include "tests/experiments/edge_corners.h"
#include "tests/support/tag_view.h"

using namespace bodyschema;
using namespace bodyschema::test;

namespace {

constexpr double kSize_m = 0.08;
constexpr CornerNoise kDetected{0.05, 0.15};  // as every rig's noise.yaml

/// One row of a table.
struct Cell {
  double side_px = 50;  ///< of the black square, if it faced the camera
  double tilt_deg = 35;
  double blur_px = 0.7, motion_px = 0;
  double noise_sd = 2;
  int jpeg_quality = 0;
  double light_change = 0;  ///< over the length of a side
  double white = 220;
  bool is_distorted = false;
};

camera_info_t camera_of(const Cell& cell) {
  camera_info_t camera = pinhole_camera();
  if (cell.is_distorted) {
    camera.distortion_model = camera_info_t::MODEL_PLUMB_BOB;
    set_array(camera.num_coefficients, camera.distortion, {-0.35, 0.12, 1e-3, -1e-3, -0.01});
  }
  return camera;
}

/// Errors of one corner detector.
struct Errors {
  struct View {
    Eigen::Matrix<double, 8, 1> sum = Eigen::Matrix<double, 8, 1>::Zero();
    double squares = 0;
    int n = 0;
  };
  std::vector<View> views;
  std::vector<double> d2;
  int failed = 0;
  double squares_over_bound = 0;  ///< error² by the bound's variance, over all coordinates
  int num_over_bound = 0;

  void add(const std::vector<Eigen::Vector2d>& corners, const TagView& view,
           const Matrix8d& bound) {
    Eigen::Matrix<double, 8, 1> e;
    for (int k = 0; k < 4; ++k) e.segment<2>(2 * k) = corners[k] - view.corners_px()[k];
    View& v = views.back();
    v.sum += e;
    v.squares += e.squaredNorm();
    ++v.n;
    squares_over_bound += e.squaredNorm() / bound.trace();
    ++num_over_bound;
  }
  void add(const RefinedCorners& corners, const TagView& view, const Matrix8d& bound) {
    add(corners.corners_px, view, bound);
    judge(corners.corners_px, view, corners.covariance_px2);
  }
  void judge(const std::vector<Eigen::Vector2d>& corners, const TagView& view,
             const Matrix8d& covariance_px2) {
    Eigen::Matrix<double, 8, 1> e;
    for (int k = 0; k < 4; ++k) e.segment<2>(2 * k) = corners[k] - view.corners_px()[k];
    d2.push_back(e.dot(covariance_px2.ldlt().solve(e)));
  }
  double rms() const {
    double squares = 0;
    int n = 0;
    for (const View& v : views) {
      squares += v.squares;
      n += 8 * v.n;
    }
    return std::sqrt(squares / n);
  }
  /// Root mean square over views and coordinates of the mean error, less the mean's own scatter.
  double bias() const {
    double squares = 0;
    int n = 0;
    for (const View& v : views) {
      if (v.n < 2) continue;
      const double mean2 = (v.sum / v.n).squaredNorm();
      const double scatter2 = (v.squares - v.n * mean2) / (v.n - 1);
      squares += mean2 - scatter2 / v.n;
      n += 8;
    }
    return n ? std::sqrt(std::max(0.0, squares / n)) : NAN;
  }
  double mean_d2() const {
    double sum = 0;
    for (const double x : d2) sum += x;
    return sum / static_cast<double>(d2.size());
  }
  double d2_quantile(double q) const {
    if (d2.empty()) return NAN;
    std::vector<double> sorted = d2;
    std::sort(sorted.begin(), sorted.end());
    return sorted[static_cast<std::size_t>(q * static_cast<double>(sorted.size() - 1))];
  }
  double over_bound() const { return std::sqrt(squares_over_bound / num_over_bound); }
};

Plate random_plate(const Cell& cell, const camera_info_t& camera,
                   const std::function<double()>& uniform) {
  Plate plate;
  plate.id = static_cast<int>(uniform() * 587);
  plate.size_m = kSize_m;
  const double distance_m = camera.fx * kSize_m / cell.side_px;
  const double off = cell.is_distorted ? 1 : 0.3;
  plate.X_CM =
      marker_pose(distance_m, cell.tilt_deg * kDegree, 2 * M_PI * uniform(), 2 * M_PI * uniform(),
                  off * (0.3 + 0.01 * uniform()), off * (0.2 + 0.01 * uniform()));
  return plate;
}

TagViewOptions random_options(const Cell& cell, const std::function<double()>& uniform) {
  TagViewOptions options;
  options.blur_px = cell.blur_px;
  options.white = cell.white;
  const double way = 2 * M_PI * uniform();
  options.motion_px = cell.motion_px * Eigen::Vector2d(std::cos(way), std::sin(way));
  const double light = 2 * M_PI * uniform();
  options.light_gradient =
      cell.light_change / cell.side_px * Eigen::Vector2d(std::cos(light), std::sin(light));
  options.rays_per_px = cell.side_px > 120 ? 4 : 8;
  return options;
}

std::vector<Eigen::Vector2d> sub_pixel_corners(const cv::Mat& image,
                                               const std::vector<Eigen::Vector2d>& corners_px,
                                               double side_px) {
  const int window = std::max(2, static_cast<int>(side_px / 16));
  std::vector<cv::Point2f> points;
  for (const auto& p : corners_px)
    points.emplace_back(static_cast<float>(p.x()), static_cast<float>(p.y()));
  cv::cornerSubPix(image, points, {window, window}, {-1, -1},
                   {cv::TermCriteria::COUNT | cv::TermCriteria::EPS, 50, 1e-4});
  std::vector<Eigen::Vector2d> moved;
  for (const auto& p : points) moved.emplace_back(p.x, p.y);
  return moved;
}

/// All corner detectors on the images of one cell.
class Comparison {
 public:
  explicit Comparison(const Cell& cell) : cell_(cell) {}

  void add_view(const Plate& plate, const camera_info_t& camera, const TagViewOptions& options,
                int num_frames, std::uint64_t first_seed, int num_views) {
    const camera_info_t around = camera_around(plate, camera);
    const Lens lens(around);
    const TagView view(plate, around, options);
    const Matrix8d bound = view.cramer_rao_px2(std::hypot(cell_.noise_sd, std::sqrt(1.0 / 12)));
    bound2_ += bound.trace() / 8 / num_views;
    for (Errors* errors : {&april_, &sub_pixel_, &edges_, &photometric_})
      errors->views.emplace_back();
    for (int f = 0; f < num_frames; ++f, ++num_) {
      const cv::Mat image = view.taken(cell_.noise_sd, first_seed + f, cell_.jpeg_quality);
      const auto found = detector_.detect(image);
      const auto it = std::find_if(found.begin(), found.end(),
                                   [&](const TagDetection& d) { return d.id == plate.id; });
      if (it == found.end())
        ++unseen_;
      else
        add_frame(image, *it, view, lens, bound);
    }
  }

  std::string row(const std::string& name) const {
    std::string why;
    for (const auto& [reason, n] : refusals_) why += " " + reason;
    const double seen = num_ - unseen_;
    char line[512];
    std::snprintf(line, sizeof line,
                  "| %s | %.0f | %.3f, %.3f | %.3f, %.3f | %.3f, %.3f, %.2f, %.1f | "
                  "%.4f, %.4f, %.2f, %.1f, %.1f | %.4f | %.0f%s | %.1f | %.0f |",
                  name.c_str(), 100 * seen / num_, april_.bias(), april_.rms(), sub_pixel_.bias(),
                  sub_pixel_.rms(), edges_.bias(), edges_.rms(), edges_.over_bound(),
                  edges_.mean_d2(), photometric_.bias(), photometric_.rms(),
                  photometric_.over_bound(), photometric_.mean_d2(), photometric_.d2_quantile(0.95),
                  std::sqrt(bound2_), 100 * photometric_.failed / seen, why.c_str(),
                  april_.mean_d2(), time_us_ / seen);
    // A detector that found nothing has no figure.
    std::string row = line;
    for (const char* none : {"-nan", "nan"}) {
      for (std::size_t at; (at = row.find(none)) != std::string::npos;) {
        row.replace(at, std::string(none).size(), "–");
      }
    }
    return row;
  }

 private:
  void add_frame(const cv::Mat& image, const TagDetection& found, const TagView& view,
                 const Lens& lens, const Matrix8d& bound) {
    april_.add(found.corners_px, view, bound);
    sub_pixel_.add(sub_pixel_corners(image, found.corners_px, cell_.side_px), view, bound);
    if (const auto corners = edge_corners(image, lens, 8, found.corners_px)) {
      edges_.add(*corners, view, bound);
    } else {
      ++edges_.failed;
    }
    const TagCells& cells = detector_.cells(found.id);
    const auto begin = std::chrono::steady_clock::now();
    const CornerRefinement fit = refine_corners(image, lens, cells, found.corners_px);
    time_us_ +=
        std::chrono::duration<double, std::micro>(std::chrono::steady_clock::now() - begin).count();
    if (fit.corners) {
      photometric_.add(*fit.corners, view, bound);
    } else {
      ++photometric_.failed;
      ++refusals_[name_of(fit.refusal)];
      april_.judge(found.corners_px, view,
                   detected_covariance_px2(kDetected, cells, found.corners_px, fit));
    }
  }

  const Cell cell_;
  TagDetector detector_{"tag36h11", 1, 20};
  Errors april_, sub_pixel_, edges_, photometric_;
  int unseen_ = 0, num_ = 0;
  double bound2_ = 0, time_us_ = 0;
  std::map<std::string, int> refusals_;
};

void print_row(const std::string& name, const Cell& cell, int num_views, int num_frames,
               std::uint64_t seed) {
  std::mt19937_64 random(seed);
  const auto uniform = [&] { return std::uniform_real_distribution<double>(0, 1)(random); };
  const camera_info_t camera = camera_of(cell);
  Comparison comparison(cell);
  for (int i = 0; i < num_views; ++i) {
    const Plate plate = random_plate(cell, camera, uniform);
    comparison.add_view(plate, camera, random_options(cell, uniform), num_frames,
                        seed * 1000003 + i * 1009, num_views);
  }
  std::puts(comparison.row(name).c_str());
  std::fflush(stdout);
}

void print_header(const std::string& what) {
  std::printf(
      "\n| %s | seen %% | AprilTag: bias, rms | cornerSubPix: bias, rms | edges: bias, rms, over "
      "bound, d² | grey values: bias, rms, over bound, d², d² 95 %% | bound | refused %% | "
      "AprilTag's d² where refused | µs |\n"
      "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |\n",
      what.c_str());
}

std::string text(const char* format, double value) {
  char buffer[64];
  std::snprintf(buffer, sizeof buffer, format, value);
  return buffer;
}

struct Arguments {
  int num_views = 12, num_frames = 12;
  std::uint64_t seed = 1;
  std::vector<std::string> only;
};

void print_tables(const Arguments& arguments) {
  const auto table = [&](const char* name, const std::string& title, const char* format,
                         const std::vector<double>& values,
                         const std::function<void(Cell&, double)>& set) {
    const auto& only = arguments.only;
    if (!only.empty() && std::find(only.begin(), only.end(), name) == only.end()) return;
    print_header(title);
    for (const double value : values) {
      Cell cell;
      set(cell, value);
      print_row(text(format, value), cell, arguments.num_views, arguments.num_frames,
                arguments.seed);
    }
  };
  table("side", "side", "%g px", {12, 16, 20, 25, 35, 50, 80, 120, 200},
        [](Cell& c, double v) { c.side_px = v; });
  table("tilt", "tilt", "%g°", {0, 15, 30, 45, 60, 70, 75},
        [](Cell& c, double v) { c.tilt_deg = v; });
  for (const double side : {25.0, 40.0}) {
    table("tilt", text("tilt, side %g px", side), "%g°", {0, 30, 45, 60, 70},
          [=](Cell& c, double v) {
            c.tilt_deg = v;
            c.side_px = side;
          });
  }
  for (const double side : {25.0, 50.0, 100.0}) {
    table("sharp", text("tilt, no blur but the pixel's square, side %g px", side), "%g°",
          {0, 30, 45, 60}, [=](Cell& c, double v) {
            c.tilt_deg = v;
            c.blur_px = 0;
            c.side_px = side;
          });
  }
  table("blur", "blur", "%g px", {0, 0.3, 0.5, 1, 1.5, 2, 3},
        [](Cell& c, double v) { c.blur_px = v; });
  table("motion", "motion while the shutter is open", "%g px", {1, 2, 3, 5, 8, 12},
        [](Cell& c, double v) { c.motion_px = v; });
  table("noise", "noise", "%g", {0.5, 1, 2, 4, 8, 16}, [](Cell& c, double v) { c.noise_sd = v; });
  table("jpeg", "JPEG quality", "%g", {98, 95, 90, 80, 60, 40},
        [](Cell& c, double v) { c.jpeg_quality = static_cast<int>(v); });
  table("jpeg", "JPEG quality, side 25 px", "%g", {95, 90, 80, 60}, [](Cell& c, double v) {
    c.jpeg_quality = static_cast<int>(v);
    c.side_px = 25;
  });
  table("light", "change of light over a side, white 150", "%g", {0, 0.1, 0.3, 0.6},
        [](Cell& c, double v) {
          c.light_change = v;
          c.white = 150;
        });
  table("white", "white before it is cut off at 255", "%g", {240, 255, 258, 262, 280},
        [](Cell& c, double v) { c.white = v; });
  table("lens", "distorted, side", "%g px", {25, 50, 100, 200}, [](Cell& c, double v) {
    c.is_distorted = true;
    c.side_px = v;
  });
}

}  // namespace

int main(int argc, char** argv) {
  Arguments arguments;
  CLI::App app("Errors of tag corners against the truth");
  app.add_option("--views", arguments.num_views)->check(CLI::PositiveNumber);
  app.add_option("--frames", arguments.num_frames)->check(CLI::PositiveNumber);
  app.add_option("--seed", arguments.seed);
  app.add_option("--only", arguments.only,
                 "Tables: side, tilt, sharp, blur, motion, noise, jpeg, light, white, lens");
  CLI11_PARSE(app, argc, argv);
  std::printf(
      "All in px, over %d views × %d frames; side 50 px, tilt 35°, blur 0.7 px, noise 2 grey "
      "levels, "
      "contrast 195, where nothing else is said. d² has 8 degrees of freedom (95 %%: 15.5).\n",
      arguments.num_views, arguments.num_frames);
  print_tables(arguments);
  return 0;
}
