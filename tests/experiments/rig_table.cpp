// Accuracy of the simulated rigs, from rendered images: structure right after N samples, over
// seeds, and the held-out error of the end effector against the simulator's truth. Every fifth
// sample is TEST, as in ./run. For the ideal robot; for the robot with calibration errors also
// aligned (evaluation.h; by the truth of all actions), and the scale. Prints Markdown.
//
//   rig_table config/arm2 config/arm4 config/arm7 --seeds 10 --at 20 30 60 100 [--move-camera]

#include <yaml-cpp/yaml.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <numeric>
#include <optional>
#include <random>
#include <string>
#include <vector>

#include "common/config/rig.h"
#include "common/estimation/evaluation.h"
#include "common/geometry/angle.h"
#include "common/kinematics/kinematic_path.h"
#include "processes/structure_learner/structure_learner.h"
#include "tests/common/bus/bus_test_support.h"
#include "tests/support/rendered_run.h"
#include "tests/support/rig_truth.h"

using namespace bodyschema;

namespace {

/// Errors of the end effector over the seeds.
struct Errors {
  std::vector<double> position_m, rotation_rad;
  void add(const std::vector<PartErrors>& parts, int end_effector) {
    for (const PartErrors& part : parts) {
      if (part.part != end_effector || part.count == 0) continue;
      position_m.push_back(part.position_median_m);
      rotation_rad.push_back(part.rotation_median_rad);
    }
  }
};

struct Row {
  int right = 0;
  int incomplete = 0;
  Errors errors, aligned;
  Errors in_camera;  ///< of X_CR too
  /// Squared Mahalanobis distance of the truth from the end effector's pose in the root, and from
  /// X_CR, by the schema's covariances: χ²₆ if they are true.
  std::vector<double> end_effector_d2, root_d2;
  std::vector<double> scale, seconds;
  std::string objections;
};

double median(std::vector<double> values) {
  if (values.empty()) return NAN;
  std::nth_element(values.begin(), values.begin() + values.size() / 2, values.end());
  return values[values.size() / 2];
}

double worst(const std::vector<double>& values) {
  return values.empty() ? NAN : *std::max_element(values.begin(), values.end());
}

/// "0.18 mm, 0.01° | 0.22 mm, 0.03°": median and worst seed.
std::string text(const Errors& errors) {
  char buffer[100];
  std::snprintf(buffer, sizeof buffer, "%.2f mm, %.2f° | %.2f mm, %.2f°",
                median(errors.position_m) * 1e3, median(errors.rotation_rad) / kDegree,
                worst(errors.position_m) * 1e3, worst(errors.rotation_rad) / kDegree);
  return buffer;
}

/// "5.3 (11.2)": mean and 95 % quantile.
std::string text(std::vector<double> distances) {
  if (distances.empty()) return "";
  std::sort(distances.begin(), distances.end());
  const double sum = std::accumulate(distances.begin(), distances.end(), 0.0);
  char buffer[100];
  std::snprintf(buffer, sizeof buffer, "%.1f (%.1f)", sum / static_cast<double>(distances.size()),
                distances[distances.size() * 95 / 100]);
  return buffer;
}

double squared_distance(const Pose& estimate, const Matrix6d& covariance, const Pose& truth) {
  const Vector6d error = log(estimate.inverse() * truth);
  return error.dot(covariance.ldlt().solve(error));
}

void add_distances(const BodySchema& schema, const std::vector<ActionPoseSample>& held_out,
                   int end_effector, Row* row) {
  const auto path = KinematicPath::between(schema, schema.root, end_effector);
  if (!path || held_out.empty()) return;
  for (const ActionPoseSample& exact : held_out)
    row->end_effector_d2.push_back(squared_distance(
        path->predict(exact.action), path->covariance(exact.action, Variance::kFirstOrder),
        exact.find(schema.root)->X_CB.inverse() * exact.find(end_effector)->X_CB));
  row->root_d2.push_back(squared_distance(schema.X_CR, schema.X_CR_covariance,
                                          held_out.front().find(schema.root)->X_CB));
}

/// Samples of a run up to some sample: for learning, and true poses.
struct Seen {
  std::vector<ActionPoseSample> training;
  std::vector<ActionPoseSample> truth;     ///< of all actions
  std::vector<ActionPoseSample> held_out;  ///< of the TEST actions
};

void add(const test::RenderedRun::Step& step, bool is_test, Seen& seen) {
  ActionPoseSample exact = step.sample;
  exact.parts.clear();
  for (const auto& [part, X_CB] : step.truth) {
    PartObservation& observation = exact.parts.emplace_back();
    observation.part = part;
    observation.X_CB = X_CB;
  }
  if (is_test) {
    seen.held_out.push_back(exact);
  } else {
    seen.training.push_back(step.sample);
  }
  seen.truth.push_back(std::move(exact));
}

struct Options {
  std::vector<int> at = {20, 30, 60, 100};
  std::vector<int> hidden;
  int num_seeds = 10;
  std::int64_t first_seed = 1;
  std::optional<Choice> choice;
  std::vector<double> systematic;  ///< [mm, deg] instead of noise.yaml's
  bool moves_camera = false;       ///< by seed, within ±5 cm and ±3° of robot.yaml's X_WC
};

/// A copy of the rig with its camera elsewhere: what a view biases is drawn anew.
std::filesystem::path with_moved_camera(const std::filesystem::path& rig, std::int64_t seed,
                                        const std::filesystem::path& copy) {
  std::filesystem::copy(rig, copy, std::filesystem::copy_options::recursive);
  YAML::Node robot = YAML::LoadFile(copy / "robot.yaml");
  std::mt19937_64 random(static_cast<std::uint64_t>(seed));
  const auto move = [&](YAML::Node values, double most) {
    for (std::size_t axis = 0; axis < 3; ++axis)
      values[axis] =
          values[axis].as<double>() + std::uniform_real_distribution(-most, most)(random);
  };
  move(robot["X_WC"]["position_m"], 0.05);
  move(robot["X_WC"]["rpy_deg"], 3);
  std::ofstream(copy / "robot.yaml") << robot;
  return copy;
}

/// One row for each of options.at.
std::vector<Row> measured(const std::filesystem::path& rig, bool is_ideal, const Options& options) {
  StructureLearnerConfig config = StructureLearnerConfig::load(rig / "structure_learner.yaml");
  config.options.measurement =
      load_noise(rig, is_ideal ? "ideal_noise.yaml" : "noise.yaml").measurement;
  if (!options.systematic.empty())
    config.options.measurement.systematic = {options.systematic[0] * 1e-3,
                                             options.systematic[1] * kDegree};
  const int end_effector = load_signals(rig).end_effector_part;
  const test::RigTruth truth(rig);
  std::vector<int> observed = truth.parts();
  for (const int part : options.hidden) std::erase(observed, part);
  std::vector<Row> rows(options.at.size());
  for (std::int64_t seed = options.first_seed; seed < options.first_seed + options.num_seeds;
       ++seed) {
    const test::TemporaryFolder scratch;
    test::RenderedRun run(
        options.moves_camera ? with_moved_camera(rig, seed, scratch / rig.filename()) : rig, seed,
        {options.hidden.begin(), options.hidden.end()}, options.choice, is_ideal);
    Seen seen;
    std::vector<std::vector<ActionPoseSample>> trained;
    for (int n = 1; n <= options.at.back(); ++n) {
      add(run.next(), n % 5 == 0, seen);
      if (std::find(options.at.begin(), options.at.end(), n) != options.at.end())
        trained.push_back(seen.training);
    }
    std::fprintf(stderr, "%s seed %d%s: %d actions refused\n", rig.filename().c_str(),
                 static_cast<int>(seed), is_ideal ? ", ideal" : "", run.num_rejected());
    for (std::size_t i = 0; i < rows.size(); ++i) {
      Row& row = rows[i];
      const auto start = std::chrono::steady_clock::now();
      const BodySchema schema = learn(config.signals, trained[i], config.options).schema;
      row.seconds.push_back(
          std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count());
      const std::string objection = truth.objection(schema, observed);
      row.right += objection.empty();
      row.incomplete += !schema.complete;
      if (objection.empty())
        add_distances(schema, seen.held_out, end_effector, &row);
      else
        row.objections += " seed " + std::to_string(seed) + ": " + objection + ";";
      const JudgedErrors errors = judge(schema, seen.held_out, seen.truth);
      row.errors.add(errors.parts, end_effector);
      row.aligned.add(errors.aligned_parts, end_effector);
      if (const PartObservation* root = seen.held_out.front().find(schema.root)) {
        const Pose X_RS = root->X_CB.inverse() * schema.X_CR;  // it rests
        row.in_camera.add(evaluate(schema, seen.held_out, {.X_RS = X_RS}), end_effector);
      }
      if (errors.alignment) row.scale.push_back(errors.alignment->scale);
    }
  }
  return rows;
}

void print(const std::string& rig, const Options& options, const std::vector<Row>& ideal,
           const std::vector<Row>& honest) {
  for (std::size_t i = 0; i < options.at.size(); ++i) {
    std::printf("| %s | %d |", rig.c_str(), options.at[i]);
    if (ideal.empty()) {
      std::printf(" | | | | | | | |");
    } else {
      std::printf(" %d of %d | %d | %s | %s | %s | %s |", ideal[i].right, options.num_seeds,
                  ideal[i].incomplete, text(ideal[i].errors).c_str(),
                  text(ideal[i].in_camera).c_str(), text(ideal[i].end_effector_d2).c_str(),
                  text(ideal[i].root_d2).c_str());
    }
    if (honest.empty()) {
      std::printf(" | | | | | | | | |");
    } else {
      const Row& row = honest[i];
      std::printf(" %d of %d | %d | %s | %s | %s | %s | %.4f |", row.right, options.num_seeds,
                  row.incomplete, text(row.aligned).c_str(), text(row.errors).c_str(),
                  text(row.end_effector_d2).c_str(), text(row.root_d2).c_str(), median(row.scale));
    }
    std::printf(" %.0f ms |\n", median((honest.empty() ? ideal : honest)[i].seconds) * 1e3);
    for (const auto* rows : {&ideal, &honest}) {
      if (rows->empty() || (*rows)[i].objections.empty()) continue;
      std::fprintf(stderr, "%s at %d%s:%s\n", rig.c_str(), options.at[i],
                   rows == &ideal ? ", ideal" : "", (*rows)[i].objections.c_str());
    }
    std::fflush(stdout);
  }
}

}  // namespace

int main(int argc, char** argv) {
  std::vector<std::string> rigs;
  Options options;
  CLI::App app("Structure and accuracy of the simulated rigs, from rendered images");
  app.add_option("RIGS", rigs, "Rig folders")->required();
  app.add_option("--at", options.at, "Numbers of samples, TEST samples included");
  app.add_option("--seeds", options.num_seeds)->check(CLI::PositiveNumber);
  app.add_option("--first-seed", options.first_seed);
  app.add_option("--hide", options.hidden, "Parts that are hidden");
  std::string choice, only;
  app.add_option("--choice", choice, "How actions are found; else as motor_babbler.yaml says")
      ->check(CLI::IsMember({"active", "random"}));
  app.add_option("--systematic", options.systematic,
                 "Systematic error of a part that the learner is told [mm, deg], not noise.yaml's")
      ->expected(2);
  app.add_flag("--move-camera", options.moves_camera,
               "By seed, within 5 cm and 3° an axis of robot.yaml's");
  app.add_option("--only", only, "One of the two robots")
      ->check(CLI::IsMember({"ideal", "honest"}));
  CLI11_PARSE(app, argc, argv);
  std::sort(options.at.begin(), options.at.end());
  if (!choice.empty()) options.choice = choice == "active" ? Choice::kActive : Choice::kRandom;
  std::printf(
      "| rig | samples | ideal: right | incomplete | end effector, median | worst seed | in "
      "the camera's frame, median | worst seed | d² of its pose in the root, mean (95 %%) | d² of "
      "X_CR | with "
      "calibration errors: right | incomplete | aligned, median | worst seed | unaligned, median | "
      "worst seed | d² of its pose in the root | d² of X_CR | scale | learning |\n"
      "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | "
      "--- | --- | --- | --- | --- |\n");
  for (const std::filesystem::path rig : rigs) {
    std::vector<Row> ideal, honest;
    if (only != "honest") ideal = measured(rig, true, options);
    if (only != "ideal") honest = measured(rig, false, options);
    print(rig.filename(), options, ideal, honest);
  }
  return 0;
}
