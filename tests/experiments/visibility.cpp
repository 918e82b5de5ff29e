// Visibility of each body part of a rig. Random actions as the babbler draws them go
// through the simulator; every accepted pose is rendered and searched for tags by the detector with
// the settings of the pipeline. Prints Markdown.
//
//   visibility config/arm7 --poses 300

#include <apriltag/apriltag.h>
#include <apriltag/tag36h11.h>

#include <CLI/CLI.hpp>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <map>
#include <memory>
#include <opencv2/calib3d.hpp>
#include <opencv2/imgcodecs.hpp>
#include <random>
#include <vector>

#include "common/bus/convert.h"
#include "common/geometry/angle.h"
#include "common/scene/scene_renderer.h"
#include "processes/robot_simulator/robot_simulator.h"

using namespace bodyschema;

namespace {

struct Detector {
  Detector() : family(tag36h11_create()), detector(apriltag_detector_create()) {
    apriltag_detector_add_family_bits(detector, family, 1);
    detector->quad_decimate = 1;
    detector->refine_edges = 1;
    detector->nthreads = 1;
    detector->qtp.min_white_black_diff = 20;
  }
  ~Detector() {
    apriltag_detector_destroy(detector);
    tag36h11_destroy(family);
  }
  /// Corners by tag id, pixel-centre convention, marker_pose_t's order.
  std::map<int, std::vector<cv::Point2d>> find(const cv::Mat& image) {
    image_u8_t view{image.cols, image.rows, static_cast<int>(image.step), image.data};
    zarray_t* found = apriltag_detector_detect(detector, &view);
    std::map<int, std::vector<cv::Point2d>> tags;
    for (int i = 0; i < zarray_size(found); ++i) {
      apriltag_detection_t* detection;
      zarray_get(found, i, &detection);
      if (detection->hamming > 1 || detection->decision_margin < 20) continue;
      for (const auto& corner : detection->p) {
        tags[detection->id].emplace_back(corner[0] - 0.5, corner[1] - 0.5);
      }
    }
    apriltag_detections_destroy(found);
    return tags;
  }
  apriltag_family_t* family;
  apriltag_detector_t* detector;
};

struct Tally {
  int seen = 0;
  int tags = 0;
  int several = 0;
  double tilt_deg = 0;
};

/// Sum of the squared errors of a tag's corners [px²].
double squared_error(const CameraCalibration& c, const Pose& X_CM, double size_m,
                     const std::vector<cv::Point2d>& corners) {
  const double h = size_m / 2;
  std::vector<cv::Point3d> points;
  for (const auto& [x, y] : {std::pair{-h, h}, {h, h}, {h, -h}, {-h, -h}}) {
    const Eigen::Vector3d p = X_CM * Eigen::Vector3d(x, y, 0);
    points.emplace_back(p.x(), p.y(), p.z());
  }
  std::vector<cv::Point2d> pixels;
  cv::projectPoints(points, cv::Vec3d(), cv::Vec3d(),
                    cv::Matx33d(c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1), c.distortion, pixels);
  double sum = 0;
  for (int k = 0; k < 4; ++k) {
    const cv::Point2d error = pixels[k] - corners[k];
    sum += error.dot(error);
  }
  return sum;
}

struct Errors {
  double sum = 0;
  int tags = 0;
  /// Root mean square per coordinate [px].
  double rms_px() const { return tags ? std::sqrt(sum / (8 * tags)) : 0; }
};

double seconds_since(std::chrono::steady_clock::time_point start) {
  return std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
}

struct Arguments {
  std::filesystem::path rig;
  int num_poses = 300;
  std::int64_t seed = 1;
  int num_pictures = 0;
  std::string picture_prefix = "pose";
  ImageEffects effects;
};

RobotSimulatorConfig ideal(const Arguments& arguments) {
  RobotSimulatorConfig config = RobotSimulatorConfig::load(arguments.rig / "robot_simulator.yaml");
  config.seed = arguments.seed;
  config.is_ideal = true;
  return config;
}

class Visibility {
 public:
  explicit Visibility(const Arguments& arguments)
      : arguments_(arguments),
        simulator_(ideal(arguments)),
        renderer_(arguments.rig, arguments.effects),
        engine_(arguments.seed) {}

  void measure() {
    while (accepted_ < arguments_.num_poses) {
      const action_command_t command = next_command();
      auto start = std::chrono::steady_clock::now();
      const RobotSimulator::Answer answer = simulator_.on_command(command);
      simulate_s_ += seconds_since(start);
      if (!answer.state) {
        ++reasons_[answer.statuses.back().reason];
        continue;
      }
      start = std::chrono::steady_clock::now();
      const cv::Mat image = renderer_.render(*answer.state, 0);
      render_s_ += seconds_since(start);
      start = std::chrono::steady_clock::now();
      const auto found = detector_.find(image);
      detect_s_ += seconds_since(start);
      if (accepted_ < arguments_.num_pictures) {
        cv::imwrite(arguments_.picture_prefix + "_" + std::to_string(accepted_) + ".png", image);
      }
      ++accepted_;
      tally(*answer.state, found);
    }
  }

  void print() {
    const Scene& scene = simulator_.scene();
    std::printf("%s: %d poses, %.0f %% of %d actions accepted, tags that the rig has not: %d\n\n",
                scene.robot().name.c_str(), accepted_, 100.0 * accepted_ / asked_, asked_,
                unknown_);
    std::printf("| part | seen | two tags or more | tags a pose | mean tilt |\n");
    std::printf("| --- | --- | --- | --- | --- |\n");
    for (const int part : scene.markers().parts()) {
      const Tally& tally = tallies_[part];
      std::printf("| %d | %.0f %% | %.0f %% | %.1f | %.0f° |\n", part,
                  100.0 * tally.seen / accepted_, 100.0 * tally.several / accepted_,
                  static_cast<double>(tally.tags) / accepted_,
                  tally.tags ? tally.tilt_deg / tally.tags : 0.0);
    }
    std::printf("\nCorners, rms per coordinate: %.3f px below 60° of tilt, %.3f px above\n",
                errors_of_[true].rms_px(), errors_of_[false].rms_px());
    std::printf("A pose: simulate %.1f ms, render %.1f ms, detect %.1f ms\n",
                1e3 * simulate_s_ / accepted_, 1e3 * render_s_ / accepted_,
                1e3 * detect_s_ / accepted_);
    for (const auto& [reason, count] : reasons_)
      std::fprintf(stderr, "%5d %s\n", count, reason.c_str());
  }

 private:
  action_command_t next_command() {
    std::uniform_real_distribution<double> unit(0, 1);
    action_command_t command{};
    command.source = "visibility";
    command.action_id = asked_++;
    command.utime = command.expiry_utime = simulator_.status().utime;
    const bool is_extreme = unit(engine_) < 0.5;
    for (const Signal& signal : simulator_.scene().signals().signals) {
      double x = 2 * unit(engine_) - 1;
      if (is_extreme) x = std::copysign(0.7 + 0.3 * std::abs(x), x);
      command.action.push_back(0.5 * (signal.lower + signal.upper) +
                               0.5 * (signal.upper - signal.lower) * x);
    }
    command.num_signals = static_cast<std::int32_t>(command.action.size());
    return command;
  }

  void tally(const sim_state_t& state, const std::map<int, std::vector<cv::Point2d>>& found) {
    const Scene& scene = simulator_.scene();
    std::map<int, int> tags_of_part;
    const Pose X_WC = from_message(state.X_WC);
    for (const auto& [id, corners] : found) {
      const TagPlacement* tag = scene.markers().find(id);
      if (!tag) {
        ++unknown_;
        continue;
      }
      ++tags_of_part[tag->part];
      const Pose X_CM = X_WC.inverse() * from_message(state.X_WG[scene.tag_geom(id)]) *
                        Eigen::Translation3d(0, 0, -kSheetThickness_m / 2);
      const double tilt_deg =
          std::acos(
              std::clamp(X_CM.translation().normalized().dot(X_CM.linear().col(2)), -1.0, 1.0)) *
          (1 / kDegree);
      tallies_[tag->part].tilt_deg += tilt_deg;
      Errors& errors = errors_of_[tilt_deg < 60];
      errors.sum += squared_error(renderer_.calibration(), X_CM, tag->size_m, corners);
      ++errors.tags;
    }
    for (const auto& [part, tags] : tags_of_part) {
      tallies_[part].seen += 1;
      tallies_[part].tags += tags;
      tallies_[part].several += tags > 1;
    }
  }

  const Arguments arguments_;
  RobotSimulator simulator_;
  SceneRenderer renderer_;
  Detector detector_;
  std::mt19937_64 engine_;
  std::map<int, Tally> tallies_;
  std::map<bool, Errors> errors_of_;  // tilt below 60°
  std::map<std::string, int> reasons_;
  int accepted_ = 0, asked_ = 0, unknown_ = 0;
  double simulate_s_ = 0, render_s_ = 0, detect_s_ = 0;
};

}  // namespace

int main(int argc, char** argv) {
  CLI::App app("Visibility of the body parts of a rig");
  Arguments arguments;
  app.add_option("rig", arguments.rig, "Folder of the rig")
      ->required()
      ->check(CLI::ExistingDirectory);
  app.add_option("--poses", arguments.num_poses, "Accepted poses to look at");
  app.add_option("--seed", arguments.seed, "Of actions and noise");
  app.add_option("--pictures", arguments.num_pictures, "Write the first poses as PNG");
  app.add_option("--prefix", arguments.picture_prefix, "Of the pictures' names");
  app.add_option("--pixel-samples", arguments.effects.pixel_samples, "Along each side of a pixel");
  app.add_flag("--shadows", arguments.effects.shadows, "Draw shadows");
  CLI11_PARSE(app, argc, argv);
  Visibility visibility(arguments);
  visibility.measure();
  visibility.print();
}
