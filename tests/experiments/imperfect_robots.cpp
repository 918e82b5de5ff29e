// Structures that learn() finds for robots that no model of ours describes: chains and trees of 2
// to 7 joints, one imperfection a row. Counts right, incomplete and wrong structures, and wrong
// ones that are called complete; prints Markdown.
//
//   imperfect_robots [--robots 12] [--samples 20 50 100] [--told 1 | --estimate-noise]
//     [--outlier-rate 0.03] [--cell WORDS...] [--stream 100] [--ends]

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cstdio>
#include <string>
#include <vector>

#include "common/geometry/angle.h"
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

}  // namespace

int main(int argc, char** argv) {
  int num_robots = 12;
  std::vector<int> nums_samples = {20, 50, 100};
  bool is_noise_estimated = false;
  double told = 1;
  bool are_wrong_listed = false, are_ends_alone = false;
  double period = 0;
  double outlier_rate = MeasurementModel().outlier_rate;
  std::vector<std::string> cells;
  CLI::App app("Robots that are not as our models are");
  app.add_option("--robots", num_robots, "A row")->check(CLI::PositiveNumber);
  app.add_option("--samples", nums_samples)->check(CLI::PositiveNumber);
  app.add_option("--told", told, "Times the true noise, 3 mm and 1°")->check(CLI::PositiveNumber);
  app.add_option("--outlier-rate", outlier_rate, "Told, of a marker")->check(CLI::Range(0.0, 0.5));
  app.add_flag("--estimate-noise", is_noise_estimated, "Its 3 mm and 1° are not told");
  app.add_option("--stream", period, "Smooth motion: samples of a swing; 0: random poses");
  app.add_flag("--ends", are_ends_alone, "Chains, of which the root and the last part are seen");
  app.add_flag("--list-wrong", are_wrong_listed, "Their edges, on stderr");
  app.add_option("--cell", cells, "Rows whose name has one of these words alone");
  CLI11_PARSE(app, argc, argv);

  std::printf("| imperfection |");
  for (const int n : nums_samples) std::printf(" %d: right / incomplete / wrong (complete) |", n);
  std::printf("\n| --- |");
  for (std::size_t n = 0; n < nums_samples.size(); ++n) std::printf(" --- |");
  std::printf("\n");
  for (const Imperfection& imperfection : imperfections()) {
    const auto is_named = [&](const std::string& words) {
      return imperfection.name.find(words) != std::string::npos;
    };
    if (!cells.empty() && std::none_of(cells.begin(), cells.end(), is_named)) continue;
    if (imperfection.lag + imperfection.drive != 0 && period == 0)
      continue;  // of poses at rest there is none
    std::printf("| %s |", imperfection.name.c_str());
    for (const int num_samples : nums_samples) {
      int num_right = 0, num_incomplete = 0, num_wrong = 0, num_complete = 0;
      for (int r = 0; r < num_robots; ++r) {
        ImperfectRobot robot(2 + r % 6, are_ends_alone || r / 6 % 2 == 0, imperfection,
                             static_cast<std::uint64_t>(r));
        std::vector<ActionPoseSample> samples =
            period > 0 ? robot.wander(num_samples, period) : robot.babble(num_samples);
        SyntheticRobot truth = robot.structure();
        if (are_ends_alone) hide_all_but_ends(&truth, &samples);
        LearnOptions options;
        options.root = 1;
        options.measurement.outlier_rate = outlier_rate;
        if (!is_noise_estimated) options.measurement.noise = Noise{told * 0.003, told * kDegree};
        const BodySchema schema = learn(robot.signals(), samples, options).schema;
        const Rightness rightness = judge(schema, truth);
        num_right += rightness == Rightness::kRight;
        num_incomplete += rightness == Rightness::kIncomplete;
        num_wrong += rightness == Rightness::kWrong;
        num_complete += rightness == Rightness::kWrong && schema.complete;
        if (are_wrong_listed && rightness == Rightness::kWrong) list_edges(r, schema, robot);
      }
      std::printf(" %d / %d / %d (%d) |", num_right, num_incomplete, num_wrong, num_complete);
      std::fflush(stdout);
    }
    std::printf("\n");
  }
}
