// What the simulated rigs reach, from rendered images: structure right after N samples, over seeds,
// and the held-out error of the end effector against the simulator's truth. Every fifth sample is
// TEST, as in
// ./run. Prints Markdown.
//
//   rig_table config/arm2 config/arm4 config/arm7 --seeds 10 --at 20 30 60 100

#include <CLI/CLI.hpp>
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "common/config/rig.h"
#include "common/geometry/angle.h"
#include "common/schema/kinematic_path.h"
#include "processes/console/evaluation.h"
#include "processes/structure_learner/structure_learner.h"
#include "tests/support/rendered_run.h"
#include "tests/support/rig_truth.h"

using namespace bodyschema;

namespace {

struct Row {
  int right = 0;
  int incomplete = 0;
  std::vector<double> position_m, rotation_rad, seconds;
  /// Squared Mahalanobis distance of the truth from the end effector's pose in the root, and from
  /// X_CR, by the schema's covariances: χ²₆ if they are true.
  std::vector<double> end_effector_d2, root_d2;
  std::string objections;
};

double squared_distance(const Pose& estimate, const Matrix6d& covariance, const Pose& truth) {
  const Vector6d error = log(estimate.inverse() * truth);
  return error.dot(covariance.ldlt().solve(error));
}

/// "mean (95 % quantile)".
std::string of_distances(std::vector<double> values) {
  if (values.empty()) return "–";
  std::sort(values.begin(), values.end());
  double sum = 0;
  for (const double value : values) sum += value;
  char text[64];
  std::snprintf(text, sizeof text, "%.1f (%.1f)", sum / static_cast<double>(values.size()),
                values[values.size() * 95 / 100]);
  return text;
}

double median(std::vector<double> values) {
  if (values.empty()) return NAN;
  std::nth_element(values.begin(), values.begin() + values.size() / 2, values.end());
  return values[values.size() / 2];
}

}  // namespace

int main(int argc, char** argv) {
  std::vector<std::string> rigs;
  std::vector<int> at = {20, 30, 60, 100};
  std::vector<int> hidden;
  int num_seeds = 10;
  std::int64_t first_seed = 1;
  CLI::App app("Structure and accuracy of the simulated rigs, from rendered images");
  app.add_option("RIGS", rigs, "Rig folders")->required();
  app.add_option("--at", at, "Numbers of samples, TEST samples included");
  app.add_option("--seeds", num_seeds)->check(CLI::PositiveNumber);
  app.add_option("--first-seed", first_seed);
  app.add_option("--hide", hidden, "Parts that are hidden");
  std::string choice;
  app.add_option("--choice", choice, "How actions are found; else as motor_babbler.yaml says")
      ->check(CLI::IsMember({"active", "random"}));
  CLI11_PARSE(app, argc, argv);
  std::sort(at.begin(), at.end());

  std::optional<Choice> forced;
  if (!choice.empty()) forced = choice == "active" ? Choice::kActive : Choice::kRandom;
  std::printf(
      "| rig | samples | right | incomplete | end effector, median | worst seed | d² end effector, "
      "mean (95 %%) | d² X_CR | learning |\n"
      "| --- | --- | --- | --- | --- | --- | --- | --- | --- |\n");
  for (const std::filesystem::path rig : rigs) {
    const StructureLearnerConfig config =
        StructureLearnerConfig::load(rig / "structure_learner.yaml");
    const Signals signals = load_signals(rig);
    const test::RigTruth truth(rig);
    std::vector<int> observed = truth.parts();
    for (const int part : hidden) std::erase(observed, part);
    std::vector<Row> rows(at.size());
    for (std::int64_t seed = first_seed; seed < first_seed + num_seeds; ++seed) {
      test::RenderedRun run(rig, seed, {hidden.begin(), hidden.end()}, forced);
      // Held out for judging: the TEST samples of the whole run, with their true poses.
      std::vector<ActionPoseSample> training, held_out;
      std::vector<std::vector<ActionPoseSample>> trained;
      for (int n = 1; n <= at.back(); ++n) {
        const auto step = run.next();
        if (n % 5 == 0) {
          ActionPoseSample exact = step.sample;
          exact.parts.clear();
          for (const auto& [part, X_CB] : step.truth) {
            PartObservation observation;
            observation.part = part;
            observation.X_CB = X_CB;
            exact.parts.push_back(observation);
          }
          held_out.push_back(std::move(exact));
        } else {
          training.push_back(step.sample);
        }
        if (std::find(at.begin(), at.end(), n) != at.end()) trained.push_back(training);
      }
      std::fprintf(stderr, "%s seed %d: %d actions refused\n", rig.filename().c_str(),
                   static_cast<int>(seed), run.num_rejected());
      for (std::size_t i = 0; i < at.size(); ++i) {
        const auto start = std::chrono::steady_clock::now();
        const BodySchema schema = learn(config.signals, trained[i], config.options).schema;
        rows[i].seconds.push_back(
            std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count());
        const std::string objection = truth.objection(schema, observed);
        rows[i].right += objection.empty();
        rows[i].incomplete += !schema.complete;
        if (!objection.empty())
          rows[i].objections += " seed " + std::to_string(seed) + ": " + objection + ";";
        if (objection.empty()) {
          const auto path = KinematicPath::between(schema, schema.root, signals.end_effector_part);
          for (const ActionPoseSample& exact : held_out) {
            const PartObservation* root = exact.find(schema.root);
            const PartObservation* end = exact.find(signals.end_effector_part);
            if (!path || !root || !end) continue;
            rows[i].end_effector_d2.push_back(squared_distance(
                path->predict(exact.action), path->covariance(exact.action, Variance::kFirstOrder),
                root->X_CB.inverse() * end->X_CB));
          }
          if (const PartObservation* root = held_out.front().find(schema.root))
            rows[i].root_d2.push_back(
                squared_distance(schema.X_CR, schema.X_CR_covariance, root->X_CB));
        }
        for (const PartErrors& part : evaluate(schema, held_out)) {
          if (part.part != signals.end_effector_part || part.count == 0) continue;
          rows[i].position_m.push_back(part.position_median_m);
          rows[i].rotation_rad.push_back(part.rotation_median_rad);
        }
      }
    }
    for (std::size_t i = 0; i < at.size(); ++i) {
      const Row& row = rows[i];
      const auto worst = [](const std::vector<double>& v) {
        return v.empty() ? NAN : *std::max_element(v.begin(), v.end());
      };
      std::printf(
          "| %s | %d | %d of %d | %d | %.2f mm, %.2f° | %.2f mm, %.2f° | %s | %s | %.0f ms |\n",
          rig.filename().c_str(), at[i], row.right, num_seeds, row.incomplete,
          median(row.position_m) * 1e3, median(row.rotation_rad) / kDegree,
          worst(row.position_m) * 1e3, worst(row.rotation_rad) / kDegree,
          of_distances(row.end_effector_d2).c_str(), of_distances(row.root_d2).c_str(),
          median(row.seconds) * 1e3);
      if (!row.objections.empty())
        std::fprintf(stderr, "%s at %d:%s\n", rig.filename().c_str(), at[i],
                     row.objections.c_str());
      std::fflush(stdout);
    }
  }
  return 0;
}
