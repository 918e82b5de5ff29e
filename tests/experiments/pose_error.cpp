// Errors of the poses that the pipeline observes. Samples of a simulated rig go from action to
// SAMPLE and are compared with the simulator's truth: per part, by the tilt of its best tag, by
// distance, and per pair of parts, for which the learner's test statistic d² is defined. They judge
// the systematic error of noise.yaml. Of the ideal robot, or of one with calibration errors, as
// ./run has it. Prints Markdown.
//
//   pose_error config/arm7 --samples 300 --honest

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <functional>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "common/bus/convert.h"
#include "common/config/rig.h"
#include "common/geometry/angle.h"
#include "tests/support/rendered_run.h"

using namespace bodyschema;

namespace {

constexpr double kChi2Median = 5.348;   // chi^2_6
constexpr double kChi2Outlier = 20.06;  // chi^2_6(0.9973)
constexpr double kFlipRad = 10 * kDegree;

double quantile(std::vector<double> values, double q) {
  if (values.empty()) return NAN;
  const auto at =
      values.begin() + static_cast<std::ptrdiff_t>(q * static_cast<double>(values.size() - 1));
  std::nth_element(values.begin(), at, values.end());
  return *at;
}

double mahalanobis2(const Vector6d& residual, const Matrix6d& covariance) {
  return residual.dot(covariance.ldlt().solve(residual));
}

/// Errors of one kind of observation.
struct Errors {
  std::vector<double> d2, lateral_m, depth_m, rotation_rad;
  int flips = 0;
  int ambiguous = 0;  ///< a second hypothesis was offered

  void add(const PartObservation& part, const Pose& X_CB_true) {
    const Pose error = X_CB_true.inverse() * part.X_CB;
    const Eigen::Vector3d e_C = part.X_CB.translation() - X_CB_true.translation();
    const Eigen::Vector3d ray = X_CB_true.translation().normalized();
    d2.push_back(mahalanobis2(log(error), part.covariance));
    depth_m.push_back(std::abs(e_C.dot(ray)));
    lateral_m.push_back((e_C - ray * ray.dot(e_C)).norm());
    rotation_rad.push_back(rotation_angle(error));
    flips += rotation_angle(error) > kFlipRad;
    ambiguous += part.X_CB_other.has_value();
  }

  void print(const std::string& name) const {
    const auto share = [&](double count) { return 100 * count / static_cast<double>(d2.size()); };
    const auto refuted =
        std::count_if(d2.begin(), d2.end(), [](double x) { return x > kChi2Outlier; });
    std::printf("| %s | %zu | %.2f | %.2f | %.2f | %.2f | %.1f | %.1f | %.1f | %.1f | %.1f |\n",
                name.c_str(), d2.size(), quantile(lateral_m, .5) * 1e3, quantile(depth_m, .5) * 1e3,
                quantile(rotation_rad, .5) / kDegree, quantile(rotation_rad, .95) / kDegree,
                quantile(d2, .5), quantile(d2, .95), share(double(refuted)), share(flips),
                share(ambiguous));
  }
};

void print_header(const char* what) {
  std::printf(
      "\n| %s | n | lateral mm | depth mm | rotation ° | rotation 95 %% | d² median | d² 95 %% | "
      "d² > 20.06, %% | flips %% | ambiguous %% |\n"
      "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |\n",
      what);
}

/// A row of d² of pairs.
void print_distances(const char* name, const std::vector<double>& d2) {
  const auto refuted =
      std::count_if(d2.begin(), d2.end(), [](double x) { return x > kChi2Outlier; });
  std::printf("| %s | %.2f | %.1f | %.2f |\n", name, quantile(d2, .5), quantile(d2, .95),
              100 * double(refuted) / double(d2.size()));
}

std::string bin(double value, const std::vector<double>& edges, const char* unit) {
  const auto above = std::upper_bound(edges.begin(), edges.end(), value);
  char text[64];
  if (above == edges.end()) {
    std::snprintf(text, sizeof text, "from %g %s", edges.back(), unit);
  } else {
    std::snprintf(text, sizeof text, "to %g %s", *above, unit);
  }
  return text;
}

/// Angle between the line of sight and the normal of the visible tag that faces the camera most.
double best_tilt(const part_observation_t& part, const Pose& X_CB, const Markers& markers) {
  double best = M_PI / 2;
  for (const tag_corners_t& tag : part.tags) {
    const TagPlacement* placement = markers.find(tag.tag_id);
    if (!placement) continue;
    const Pose X_CM = X_CB * placement->X_BM.value_or(Pose::Identity());
    best = std::min(best, std::acos(std::clamp(
                              X_CM.linear().col(2).dot(X_CM.translation().normalized()), -1., 1.)));
  }
  return best;
}

/// Errors by all that they may depend on.
class Tables {
 public:
  Tables(const std::filesystem::path& rig, const MeasurementModel& measurement)
      : markers_(load_markers(rig)), measurement_(measurement) {}

  void add(const test::RenderedRun::Step& step) {
    for (std::size_t k = 0; k < step.sample.parts.size(); ++k) {
      const PartObservation& part = step.sample.parts[k];
      const Pose& truth = step.truth.at(part.part);
      ++seen_[part.part];
      all_.add(part, truth);
      by_part_[part.part].add(part, truth);
      const part_observation_t& message = step.message.parts[k];
      by_tilt_[bin(best_tilt(message, truth, markers_) / kDegree, {10, 20, 30, 40, 50, 60, 70},
                   "°")]
          .add(part, truth);
      by_distance_[bin(truth.translation().norm(), {1.6, 1.8, 2.0, 2.2, 2.4}, "m")].add(part,
                                                                                        truth);
      by_tags_[std::to_string(message.num_tags)].add(part, truth);
      for (std::size_t j = 0; j < k; ++j) {
        const PartObservation& other = step.sample.parts[j];
        const Pose z = other.X_CB.inverse() * part.X_CB;
        const Pose z_true = step.truth.at(other.part).inverse() * truth;
        const Vector6d error = log(z_true.inverse() * z);
        const auto d2 = [&](const MeasurementModel& model) {
          return mahalanobis2(
              error, relative_covariance(z, model.covariance(other), model.covariance(part)));
        };
        pair_d2_.push_back(d2({}));
        pair_d2_by_model_.push_back(d2(measurement_));
      }
    }
  }

  void print(int num_samples) {
    print_header("part");
    for (const auto& [part, errors] : by_part_) {
      char name[64];
      std::snprintf(name, sizeof name, "%d, seen %.1f %%", part, 100.0 * seen_[part] / num_samples);
      errors.print(name);
    }
    all_.print("all");
    print_header("tilt of the best tag");
    for (const auto& [name, errors] : by_tilt_) errors.print(name);
    print_header("distance");
    for (const auto& [name, errors] : by_distance_) errors.print(name);
    print_header("tags of the part");
    for (const auto& [name, errors] : by_tags_) errors.print(name);

    std::printf(
        "\n| all pairs of parts: d² by | median (%.2f) | 95 %% (12.59) | d² > %.2f, %% |\n"
        "| --- | --- | --- | --- |\n",
        kChi2Median, kChi2Outlier);
    print_distances("the images and markers.yaml", pair_d2_);
    print_distances("noise.yaml too", pair_d2_by_model_);
  }

 private:
  const Markers markers_;
  const MeasurementModel measurement_;
  Errors all_;
  std::map<int, Errors> by_part_;
  std::map<std::string, Errors> by_tilt_, by_distance_, by_tags_;
  std::vector<double> pair_d2_, pair_d2_by_model_;
  std::map<int, int> seen_;
};

}  // namespace

int main(int argc, char** argv) {
  std::string rig = "config/arm7";
  int num_samples = 2000;
  std::int64_t seed = 1;
  CLI::App app("Errors of observed poses against the simulator's truth");
  app.add_option("RIG", rig, "Rig folder");
  app.add_option("--samples", num_samples)->check(CLI::PositiveNumber);
  app.add_option("--seed", seed);
  bool is_honest = false;
  app.add_flag("--honest", is_honest,
               "With the rig's calibration errors, as ./run without --ideal");
  CLI11_PARSE(app, argc, argv);

  const MeasurementModel measurement =
      load_noise(rig, is_honest ? "noise.yaml" : "ideal_noise.yaml").measurement;
  test::RenderedRun run(rig, seed, {}, std::nullopt, !is_honest);
  Tables tables(rig, measurement);
  for (int i = 0; i < num_samples; ++i) tables.add(run.next());
  std::printf("%s, %s, seed %lld, %d samples, %d actions refused\n", rig.c_str(),
              is_honest ? "with calibration errors" : "ideal", static_cast<long long>(seed),
              num_samples, run.num_rejected());
  tables.print(num_samples);
  return 0;
}
