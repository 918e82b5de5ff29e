// Gain of active babbling: the end effector's error and the share of right structures after N
// samples, with actions drawn uniformly, near the ends of the ranges, half and half (as `choice:
// random` does), and chosen. As in the motor_babbler the first four samples are drawn, uniformly or
// half and half, and the schema that a choice rests on is learned again after every fourth; TEST
// samples, which are not learned from, do not count here. Prints Markdown.
//
//   active_babbling --seeds 20 --robots c d --regimes chapter tag --at 10 20 30

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <limits>
#include <optional>
#include <string>
#include <vector>

#include "common/geometry/angle.h"
#include "processes/motor_babbler/action_choice.h"
#include "processes/motor_babbler/motor_babbler.h"
#include "processes/structure_learner/learn.h"
#include "tests/support/synthetic_robot.h"

using namespace bodyschema;
using namespace bodyschema::test;

namespace {

constexpr int kSamplesABlock = 4;
constexpr double kViewAngle = 70 * kDegree;

struct Strategy {
  const char* name;
  double extreme_share;
  bool is_active;
};
constexpr Strategy kStrategies[] = {{"uniform", 0, false},
                                    {"corners", 1, false},
                                    {"half and half", 0.5, false},
                                    {"active", 0, true},
                                    {"active, drawn half and half", 0.5, true}};

/// One strategy after N samples, over the robots.
struct Cell {
  int num_robots = 0, num_right = 0, num_wrong = 0;
  std::vector<double> error_m;  ///< of the right ones
};

/// Root mean square error of the end effector, in the root's frame, over 200 actions [m].
double end_effector_rms(const BodySchema& schema, const SyntheticRobot& robot, std::uint64_t seed) {
  Rng rng(seed);
  const int end_effector = robot.visible_parts().back();
  double sum = 0;
  for (int t = 0; t < 200; ++t) {
    const Eigen::VectorXd action = robot.random_action(rng);
    const auto predicted = schema.predict(schema.root, end_effector, action);
    if (!predicted) return std::numeric_limits<double>::quiet_NaN();
    const auto X_CB = robot.poses_in_camera(action);
    const Pose truth = X_CB.at(schema.root).inverse() * X_CB.at(end_effector);
    sum += (predicted->X_AB.translation() - truth.translation()).squaredNorm();
  }
  return std::sqrt(sum / 200);
}

void run(const Strategy& strategy, const std::string& robot_name, Regime regime,
         double max_view_angle_rad, std::int64_t seed, const std::vector<int>& at,
         std::vector<Cell>* cells) {
  Rng rng(static_cast<std::uint64_t>(seed));
  const SyntheticRobot robot = chapter_robot(robot_name, rng);
  ObservationOptions observation;
  observation.regime = regime;
  observation.with_covariances = true;
  observation.with_other_hypothesis = regime == Regime::kTag;
  observation.max_view_angle_rad = max_view_angle_rad;
  LearnOptions options;
  options.root = 1;
  options.expected_parts = robot.visible_parts();
  MotorBabblerConfig config;
  config.signals = robot.signals;
  config.extreme_share = strategy.extreme_share;
  config.extreme_from = 0.7;

  std::vector<ActionPoseSample> samples;
  std::vector<SeenAction> past;
  std::optional<BodySchema> schema;
  for (int n = 0; n < at.back(); ++n) {
    Eigen::VectorXd action = random_action(config, seed, n);
    if (strategy.is_active && schema) {
      const auto candidates = candidate_actions(config, seed, n);
      action = candidates[choose_action(*schema, past, candidates)];
    }
    samples.push_back(observe(robot, action, observation, n, rng));
    SeenAction seen{n, true, action, {}};
    for (const PartObservation& part : samples.back().parts) seen.parts.insert(part.part);
    past.push_back(seen);

    const auto cell = std::find(at.begin(), at.end(), n + 1);
    const bool is_block_over = strategy.is_active && (n + 1) % kSamplesABlock == 0;
    if (cell == at.end() && !is_block_over) continue;
    BodySchema learned = learn(robot.signals, samples, options).schema;
    learned.last_sample_index = n;
    if (is_block_over) schema = learned;
    if (cell == at.end()) continue;
    Cell& result = (*cells)[static_cast<std::size_t>(cell - at.begin())];
    const Rightness rightness = judge(learned, robot);
    ++result.num_robots;
    result.num_right += rightness == Rightness::kRight;
    result.num_wrong += rightness == Rightness::kWrong;
    if (rightness == Rightness::kRight) {
      result.error_m.push_back(
          end_effector_rms(learned, robot, 1'000'000 + static_cast<std::uint64_t>(seed)));
    }
  }
}

std::string text(const Cell& cell) {
  char shares[64], errors[96];
  std::snprintf(shares, sizeof shares, "%.0f / %.0f %%", 100.0 * cell.num_right / cell.num_robots,
                100.0 * cell.num_wrong / cell.num_robots);
  const auto n = static_cast<double>(cell.error_m.size());
  if (n < 2) return std::string(shares) + ", –";
  std::vector<double> sorted = cell.error_m;
  std::sort(sorted.begin(), sorted.end());
  double mean = 0, variance = 0;
  for (const double error : sorted) mean += error / n;
  for (const double error : sorted) variance += (error - mean) * (error - mean) / (n - 1);
  std::snprintf(errors, sizeof errors, ", %.2f ± %.2f (%.2f) mm", mean * 1e3,
                std::sqrt(variance / n) * 1e3, sorted[sorted.size() / 2] * 1e3);
  return std::string(shares) + errors;
}

}  // namespace

int main(int argc, char** argv) {
  int num_seeds = 20;
  std::int64_t first_seed = 1;
  std::vector<std::string> robots = {"c", "d"}, regimes = {"chapter", "tag"};
  std::vector<int> at = {10, 20, 30};
  CLI::App app("Random, corner and active babbling on synthetic robots");
  app.add_option("--robots", robots);
  app.add_option("--regimes", regimes)->check(CLI::IsMember({"chapter", "tag", "tag_iso"}));
  app.add_option("--at", at, "Numbers of samples that are learned from");
  app.add_option("--seeds", num_seeds)->check(CLI::PositiveNumber);
  app.add_option("--first-seed", first_seed);
  CLI11_PARSE(app, argc, argv);
  std::sort(at.begin(), at.end());

  std::printf(
      "right / wrong structures; end effector rms, mean ± standard error (median) of the "
      "right ones\n\n| robot | seen | N |");
  for (const Strategy& strategy : kStrategies) std::printf(" %s |", strategy.name);
  std::printf("\n| --- | --- | --- |");
  for (std::size_t s = 0; s < std::size(kStrategies); ++s) std::printf(" --- |");
  std::printf("\n");
  for (const std::string& robot : robots) {
    for (const Regime regime : {Regime::kChapter, Regime::kTag, Regime::kTagIso}) {
      if (std::find(regimes.begin(), regimes.end(), name_of(regime)) == regimes.end()) continue;
      for (const double view_angle : {M_PI, kViewAngle}) {
        std::vector<std::vector<Cell>> cells;
        for (const Strategy& strategy : kStrategies) {
          cells.emplace_back(at.size());
          for (std::int64_t seed = first_seed; seed < first_seed + num_seeds; ++seed)
            run(strategy, robot, regime, view_angle, seed, at, &cells.back());
        }
        for (std::size_t i = 0; i < at.size(); ++i) {
          std::printf("| %s, %s | %s | %d |", robot.c_str(), name_of(regime),
                      view_angle < M_PI ? "within 70°" : "always", at[i]);
          for (const auto& of_strategy : cells) std::printf(" %s |", text(of_strategy[i]).c_str());
          std::printf("\n");
        }
        std::fflush(stdout);
      }
    }
  }
  return 0;
}
