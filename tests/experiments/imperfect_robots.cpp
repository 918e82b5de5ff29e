// Structures that learn() finds for robots that no model of ours describes: chains and trees of 2
// to 7 joints, one imperfection a row. Counts right, incomplete and wrong structures, and wrong
// ones that are called complete; with --errors also how far the complete ones predict parts from
// where they are at rest, and how many standard deviations of theirs that is. Prints Markdown.
//
//   imperfect_robots [--robots 12] [--samples 20 50 100] [--told 1 | --estimate-noise]
//     [--outlier-rate 0.03] [--cell WORDS...] [--stream 100] [--ends]
//     [--errors]

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <string>
#include <vector>

#include "common/estimation/quantile.h"
#include "common/geometry/angle.h"
#include "common/schema/standard_deviations.h"
#include "processes/structure_learner/learn.h"
#include "tests/support/imperfect_robot.h"

using namespace bodyschema;
using namespace bodyschema::test;

namespace {

// The edges of a wrong structure, how far each joint goes, and the signals that are on its true
// path.
void list_edges(int seed, const BodySchema& schema, const ImperfectRobot& robot) {
  std::fprintf(stderr, "robot %d%s, noise %.1f mm %.2f°:", seed,
               schema.complete ? ", complete" : "", 1000 * schema.noise.position_m,
               schema.noise.rotation_rad / kDegree);
  for (const Edge& edge : schema.edges) {
    std::fprintf(stderr, "  %d-%d {", edge.from, edge.to);
    for (const ScrewJoint& joint : edge.joints) {
      const Signal& signal = schema.signals[static_cast<std::size_t>(joint.signal)];
      const double range = signal.upper - signal.lower;
      std::fprintf(stderr, " %s %.1f° %.0f mm", signal.name.c_str(),
                   joint.gain * joint.turn * range / kDegree,
                   1000 * joint.gain * joint.slide * range);
    }
    if (edge.residual_gp) {
      std::fprintf(stderr, " | soft");
      for (const int s : edge.signals())
        std::fprintf(stderr, " %s", schema.signals[static_cast<std::size_t>(s)].name.c_str());
    }
    std::fprintf(stderr, " | true");
    for (const int s : robot.structure().path_signals(edge.from, edge.to))
      std::fprintf(stderr, " %s", schema.signals[static_cast<std::size_t>(s)].name.c_str());
    std::fprintf(stderr, " }");
  }
  std::fprintf(stderr, "\n");
}

/// Of a schema's predictions, rms over the parts and actions at rest.
struct Errors {
  double position_m = 0;
  double in_deviations = 0;  ///< of one axis; 1: as large as told
};

Errors errors_of(const BodySchema& schema, const std::vector<ActionPoseSample>& samples,
                 ImperfectRobot& robot) {
  double sum = 0, sum_in_deviations = 0;
  int count = 0;
  for (const ActionPoseSample& sample : samples) {
    robot.go(sample.action);
    const auto& poses = robot.poses();
    const auto& X_CR = poses[static_cast<std::size_t>(schema.root) - 1];
    for (const int part : schema.parts) {
      if (part == schema.root) continue;
      const auto predicted = schema.predict(schema.root, part, sample.action, Variance::kOneAction);
      const Eigen::Vector3d p_RB =
          X_CR.inverse() * poses[static_cast<std::size_t>(part) - 1].translation();
      const double squared = (predicted->X_AB.translation() - p_RB).squaredNorm();
      const double sd_m = deviations_of(predicted->covariance).position_m;
      sum += squared;
      sum_in_deviations += squared / (3 * sd_m * sd_m);
      ++count;
    }
  }
  return {std::sqrt(sum / count), std::sqrt(sum_in_deviations / count)};
}

double median_of(const std::vector<double>& values) {
  return values.empty() ? NAN : median(values);
}

struct Arguments {
  int num_robots = 12;
  std::vector<int> nums_samples = {20, 50, 100};
  bool is_noise_estimated = false;
  double told = 1;
  bool are_wrong_listed = false, are_ends_alone = false, are_errors_told = false;
  double period = 0;
  double outlier_rate = MeasurementModel().outlier_rate;
  std::vector<std::string> cells;
};

/// Learns so many robots; prints what came out.
void print_cell(const Imperfection& imperfection, int num_samples, const Arguments& arguments) {
  int num_right = 0, num_incomplete = 0, num_wrong = 0, num_complete = 0;
  std::vector<double> errors_mm, in_deviations;
  for (int r = 0; r < arguments.num_robots; ++r) {
    ImperfectRobot robot(2 + r % 6, arguments.are_ends_alone || r / 6 % 2 == 0, imperfection,
                         static_cast<std::uint64_t>(r));
    const auto record = [&](int n) {
      return arguments.period > 0 ? robot.wander(n, arguments.period) : robot.babble(n);
    };
    std::vector<ActionPoseSample> samples = record(num_samples);
    SyntheticRobot truth = robot.structure();
    if (arguments.are_ends_alone) hide_all_but_ends(&truth, &samples);
    LearnOptions options;
    options.root = 1;
    options.measurement.outlier_rate = arguments.outlier_rate;
    if (!arguments.is_noise_estimated)
      options.measurement.noise = Noise{arguments.told * 0.003, arguments.told * kDegree};
    const BodySchema schema = learn(robot.signals(), samples, options).schema;
    const Rightness rightness = judge(schema, truth);
    num_right += rightness == Rightness::kRight;
    num_incomplete += rightness == Rightness::kIncomplete;
    num_wrong += rightness == Rightness::kWrong;
    num_complete += rightness == Rightness::kWrong && schema.complete;
    if (arguments.are_errors_told && schema.complete) {
      constexpr int kHeldOut = 200;
      const Errors errors = errors_of(schema, record(kHeldOut), robot);
      errors_mm.push_back(1e3 * errors.position_m);
      in_deviations.push_back(errors.in_deviations);
    }
    if (arguments.are_wrong_listed && rightness == Rightness::kWrong) list_edges(r, schema, robot);
  }
  std::printf(" %d / %d / %d (%d) |", num_right, num_incomplete, num_wrong, num_complete);
  if (arguments.are_errors_told)
    std::printf(" %.2f | %.1f | %.1f |", median_of(errors_mm), median_of(in_deviations),
                in_deviations.empty() ? NAN : std::ranges::max(in_deviations));
}

}  // namespace

int main(int argc, char** argv) {
  Arguments arguments;
  CLI::App app("Robots that are not as our models are");
  app.add_option("--robots", arguments.num_robots, "A row")->check(CLI::PositiveNumber);
  app.add_option("--samples", arguments.nums_samples)->check(CLI::PositiveNumber);
  app.add_option("--told", arguments.told, "Times the true noise, 3 mm and 1°")
      ->check(CLI::PositiveNumber);
  app.add_option("--outlier-rate", arguments.outlier_rate, "Told, of a marker")
      ->check(CLI::Range(0.0, 0.5));
  app.add_flag("--estimate-noise", arguments.is_noise_estimated, "Its 3 mm and 1° are not told");
  app.add_option("--stream", arguments.period,
                 "Smooth motion: samples of a swing; 0: random poses");
  app.add_flag("--ends", arguments.are_ends_alone,
               "Chains, of which the root and the last part are seen");
  app.add_flag("--list-wrong", arguments.are_wrong_listed, "Their edges, on stderr");
  app.add_flag("--errors", arguments.are_errors_told, "Of what complete schemas predict");
  app.add_option("--cell", arguments.cells, "Rows whose name has one of these words alone");
  CLI11_PARSE(app, argc, argv);

  std::printf("| imperfection |");
  for (const int n : arguments.nums_samples) {
    std::printf(" %d: right / incomplete / wrong (complete) |", n);
    if (arguments.are_errors_told)
      std::printf(" error of a complete one, median [mm] | in its standard deviations | worst |");
  }
  std::printf("\n| --- |");
  for (std::size_t n = 0; n < arguments.nums_samples.size(); ++n)
    std::printf("%s", arguments.are_errors_told ? " --- | --- | --- | --- |" : " --- |");
  std::printf("\n");
  for (const Imperfection& imperfection : imperfections()) {
    const auto is_named = [&](const std::string& words) {
      return imperfection.name.find(words) != std::string::npos;
    };
    if (!arguments.cells.empty() &&
        std::none_of(arguments.cells.begin(), arguments.cells.end(), is_named))
      continue;
    if (imperfection.lag + imperfection.drive != 0 && arguments.period == 0)
      continue;  // of poses at rest there is none
    std::printf("| %s |", imperfection.name.c_str());
    for (const int num_samples : arguments.nums_samples) {
      print_cell(imperfection, num_samples, arguments);
      std::fflush(stdout);
    }
    std::printf("\n");
  }
}
