// Arms of six and seven joints of which base and hand alone are seen: structures that learn()
// finds, errors of the hand's pose in the base beside the Cramér–Rao bound, and time. Counts right,
// incomplete and wrong structures, and wrong ones that are called complete; prints Markdown. With
// --positions the hand is a point: right is then what all signals move, and is at the right place.
//
//   long_chains [--robots 40] [--samples 25 40 100] [--gains own|one] [--scrambled]
//               [--estimate-noise] [--positions]

#include <fmt/format.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <ctime>
#include <string>
#include <vector>

#include "common/geometry/angle.h"
#include "processes/structure_learner/learn.h"
#include "tests/experiments/figures/cramer_rao.h"
#include "tests/support/random_arm.h"

using namespace bodyschema;
using namespace bodyschema::test;

namespace {

constexpr Noise kNoise{0.001, 0.3 * kDegree};

double cpu_seconds() { return static_cast<double>(std::clock()) / CLOCKS_PER_SEC; }

struct Row {
  int num_right = 0, num_right_complete = 0, num_incomplete = 0, num_wrong = 0;
  int num_wrong_complete = 0;
  double squared_error = 0, squared_bound = 0;  // of right ones [m²]
  double seconds = 0, most_seconds = 0;
};

// Mean square of the hand's error over random actions [m²].
double squared_error(const SyntheticRobot& robot, const BodySchema& schema, Rng& rng,
                     std::vector<Eigen::VectorXd>* actions) {
  constexpr int kActions = 100;
  const int hand = robot.links.back().part;
  double squared = 0;
  for (int n = 0; n < kActions; ++n) {
    actions->push_back(robot.random_action(rng));
    const std::map<int, Pose> X_C = robot.poses_in_camera(actions->back());
    const Pose truth = X_C.at(1).inverse() * X_C.at(hand);
    const auto found = schema.predict(1, hand, actions->back());
    squared += (found->X_AB.translation() - truth.translation()).squaredNorm() / kActions;
  }
  return squared;
}

// As well as the least that is possible.
void add_errors(const SyntheticRobot& robot, const BodySchema& schema,
                const std::vector<ActionPoseSample>& samples, Rng& rng, Row* row) {
  experiments::CramerRao bound(robot);
  for (ActionPoseSample sample : samples) {
    for (PartObservation& o : sample.parts) o.covariance = isotropic(kNoise);
    bound.add(sample);
  }
  std::vector<Eigen::VectorXd> actions;
  row->squared_error += squared_error(robot, schema, rng, &actions);
  row->squared_bound +=
      std::pow(experiments::position_bound_rms(bound, 1, robot.links.back().part, actions), 2);
}

Rightness judge_point(const SyntheticRobot& robot, const BodySchema& schema, Rng& rng, Row* row) {
  if (!schema.complete) return Rightness::kIncomplete;
  std::vector<Eigen::VectorXd> actions;
  const double squared = squared_error(robot, schema, rng, &actions);
  if (!schema.unused_signals().empty() || squared > std::pow(3 * kNoise.position_m, 2))
    return Rightness::kWrong;
  row->squared_error += squared;
  return Rightness::kRight;
}

Row run(const RandomArmOptions& options, int num_robots, int num_samples, bool is_told,
        bool is_point) {
  Row row;
  for (int r = 0; r < num_robots; ++r) {
    Rng rng(1000 + r);
    RandomArmOptions arm = options;
    arm.num_joints = 6 + r % 2;
    const SyntheticRobot robot = random_arm(arm, rng);
    std::vector<ActionPoseSample> samples = noisy_babble(robot, num_samples, kNoise, rng);
    if (is_point) samples = with_positions_alone(std::move(samples), {robot.links.back().part});
    LearnOptions learning;
    learning.root = 1;
    if (is_told) learning.measurement.noise = kNoise;
    const double start = cpu_seconds();
    const BodySchema schema = learn(robot.signals, samples, learning).schema;
    const double seconds = cpu_seconds() - start;
    row.seconds += seconds / num_robots;
    row.most_seconds = std::max(row.most_seconds, seconds);
    const Rightness rightness =
        is_point ? judge_point(robot, schema, rng, &row) : judge(schema, robot);
    row.num_right += rightness == Rightness::kRight;
    row.num_right_complete += rightness == Rightness::kRight && schema.complete;
    row.num_incomplete += rightness == Rightness::kIncomplete;
    row.num_wrong += rightness == Rightness::kWrong;
    row.num_wrong_complete += rightness == Rightness::kWrong && schema.complete;
    if (rightness == Rightness::kRight && !is_point) add_errors(robot, schema, samples, rng, &row);
  }
  return row;
}

}  // namespace

int main(int argc, char** argv) {
  int num_robots = 40;
  std::vector<int> nums_samples = {25, 40, 100};
  bool is_estimated = false, is_point = false;
  RandomArmOptions options;
  std::string gains = "own";
  CLI::App app("Arms seen at their ends");
  app.add_option("--robots", num_robots)->check(CLI::PositiveNumber);
  app.add_option("--samples", nums_samples)->check(CLI::PositiveNumber);
  app.add_option("--gains", gains, "Of each signal its own, or one for all")
      ->check(CLI::IsMember({"own", "one"}));
  app.add_flag("--scrambled", options.scrambled, "Signals are not listed in the joints' order");
  app.add_flag("--estimate-noise", is_estimated, "Its 1 mm and 0.3° are not told");
  app.add_flag("--positions", is_point, "Of the hand a position alone");
  CLI11_PARSE(app, argc, argv);
  options.own_gains = gains == "own";

  std::printf(
      "| gains | order | noise | N | right / incomplete / wrong (complete) | hand, rms | over "
      "Cramér–Rao | CPU s, mean (largest) |\n| --- | --- | --- | --- | --- | --- | --- | --- |\n");
  for (const int num_samples : nums_samples) {
    const Row row = run(options, num_robots, num_samples, !is_estimated, is_point);
    const double num_right = std::max(row.num_right, 1);
    std::printf(
        "| %s | %s | %s | %d | %d / %d / %d (%d) | %.2f mm | %s | %.2f (%.1f) |\n", gains.c_str(),
        options.scrambled ? "scrambled" : "listed", is_estimated ? "not told" : "told", num_samples,
        row.num_right, row.num_incomplete, row.num_wrong, row.num_wrong_complete,
        1000 * std::sqrt(row.squared_error / num_right),
        is_point ? "–"
                 : fmt::format("{:.2f}",
                               std::sqrt(row.squared_error / std::max(row.squared_bound, 1e-30)))
                       .c_str(),
        row.seconds, row.most_seconds);
    std::fflush(stdout);
  }
}
