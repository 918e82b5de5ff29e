// size_table: how learning grows with the number of parts: structure, processor time, bytes of the
// schema's message, and a recording that no model explains beside it. Prints a Markdown table.

#include <fmt/format.h>

#include <CLI/CLI.hpp>
#include <cmath>
#include <ctime>
#include <filesystem>
#include <fstream>
#include <iostream>

#include "common/bus/convert.h"
#include "processes/structure_learner/learn.h"
#include "tests/support/synthetic_robot.h"

using namespace bodyschema;
using namespace bodyschema::test;

namespace {

struct Arguments {
  std::vector<int> parts = {25, 50, 100, 200};
  int num_hidden = 2, num_samples = 40, num_seeds = 3;
  std::vector<int> unexplained_parts = {10};
  std::string csv;
};

// Recordings that no model of few joints explains.
enum class Unexplained {
  kWalk,  ///< every part walks at random, whatever the action
  kFree,  ///< every pose anywhere
  kSoft,  ///< a chain that bends in all six directions with three signals at a time
};

const char* name_of(Unexplained kind) {
  return kind == Unexplained::kWalk ? "walk" : kind == Unexplained::kFree ? "free" : "soft";
}

constexpr int kUnexplainedSignals = 4;

std::vector<Signal> unexplained_signals() {
  return {{"q1", -1, 1}, {"q2", -1, 1}, {"q3", -1, 1}, {"q4", -1, 1}};
}

Vector6d small_step(double position_m, double rotation_rad, Rng& rng) {
  Vector6d step = gaussian6(rng);
  step.head<3>() *= position_m;
  step.tail<3>() *= rotation_rad;
  return step;
}

std::vector<ActionPoseSample> unexplained(Unexplained kind, int num_parts, int num_samples,
                                          Rng& rng) {
  const Noise noise = nominal_noise(Regime::kTagIso);
  std::vector<Pose> start;
  std::vector<Eigen::Matrix<double, 6, kUnexplainedSignals>> bends;
  for (int part = 0; part < num_parts; ++part) {
    start.push_back(random_pose(rng, 0.1, 0.3));
    Eigen::Matrix<double, 6, kUnexplainedSignals> bend;
    for (int s = 0; s < kUnexplainedSignals; ++s) bend.col(s) = small_step(0.05, 0.4, rng);
    bend.col(part % kUnexplainedSignals).setZero();
    bends.push_back(bend);
  }
  std::vector<ActionPoseSample> samples(static_cast<std::size_t>(num_samples));
  for (int t = 0; t < num_samples; ++t) {
    ActionPoseSample& sample = samples[static_cast<std::size_t>(t)];
    sample.sample_index = t;
    sample.utime = 1'000'000 * std::int64_t{t};
    sample.action.resize(kUnexplainedSignals);
    for (double& q : sample.action) q = uniform(rng, -1, 1);
    Pose X = Pose::Identity();
    for (int part = 0; part < num_parts; ++part) {
      const auto n = static_cast<std::size_t>(part);
      if (kind == Unexplained::kFree) X = random_pose(rng, 0.1, 0.5);
      if (kind == Unexplained::kWalk) X = start[n] = start[n] * exp(small_step(0.02, 0.1, rng));
      if (kind == Unexplained::kSoft)
        X = X * start[n] * exp(Vector6d(bends[n] * (2 * sample.action).array().sin().matrix()));
      PartObservation seen;
      seen.part = part;
      seen.X_CB = X * exp(small_step(noise.position_m, noise.rotation_rad, rng));
      sample.parts.push_back(seen);
    }
  }
  return samples;
}

double thread_seconds() {
  timespec time{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &time);
  return static_cast<double>(time.tv_sec) + 1e-9 * static_cast<double>(time.tv_nsec);
}

struct Totals {
  double seconds = 0, largest_s = 0;
  int right = 0, incomplete = 0, wrong = 0, num_edges = 0, num_fits = 0;
  std::size_t bytes = 0;

  void add(const LearnResult& result, double took_s) {
    seconds += took_s;
    largest_s = std::max(largest_s, took_s);
    num_edges += static_cast<int>(result.schema.edges.size());
    num_fits += result.num_fits;
    bytes = std::max(bytes, static_cast<std::size_t>(to_message(result.schema).getEncodedSize()));
  }
};

void print(const std::string& recording, int num_parts, const char* noise, int num_seeds,
           const Totals& totals, const std::string& rightness) {
  std::cout << fmt::format("| {} | {} | {} | {} | {} | {} | {:.2f} ({:.2f}) | {} |\n", recording,
                           num_parts, noise, rightness, totals.num_edges / num_seeds,
                           totals.num_fits / num_seeds, totals.seconds / num_seeds,
                           totals.largest_s, totals.bytes)
            << std::flush;
}

void keep(const Arguments& arguments, const std::string& name,
          const std::vector<ActionPoseSample>& samples) {
  if (arguments.csv.empty()) return;
  std::ofstream file(std::filesystem::path(arguments.csv) / (name + ".csv"));
  write_csv(samples, file);
}

LearnResult timed_learn(const std::vector<Signal>& signals,
                        const std::vector<ActionPoseSample>& samples, bool is_told,
                        Totals* totals) {
  LearnOptions options;
  if (is_told) options.measurement.noise = nominal_noise(Regime::kTagIso);
  const double start = thread_seconds();
  LearnResult result = learn(signals, samples, options);
  totals->add(result, thread_seconds() - start);
  return result;
}

void measure_tree(const Arguments& arguments, int num_parts, bool is_told) {
  Totals totals;
  for (int seed = 1; seed <= arguments.num_seeds; ++seed) {
    Rng rng(static_cast<Rng::result_type>(seed));
    const SyntheticRobot robot =
        random_tree({.num_parts = num_parts, .num_hidden = arguments.num_hidden}, rng);
    const std::vector<ActionPoseSample> samples =
        babble(robot, arguments.num_samples, {.regime = Regime::kTagIso}, rng);
    keep(arguments, fmt::format("tree_{}_{}", num_parts, seed), samples);
    const Rightness rightness =
        judge(timed_learn(robot.signals, samples, is_told, &totals).schema, robot);
    totals.right += rightness == Rightness::kRight;
    totals.incomplete += rightness == Rightness::kIncomplete;
    totals.wrong += rightness == Rightness::kWrong;
  }
  print("tree", num_parts, is_told ? "told" : "–", arguments.num_seeds, totals,
        fmt::format("{} / {} / {}", totals.right, totals.incomplete, totals.wrong));
}

void measure_unexplained(const Arguments& arguments, Unexplained kind, int num_parts,
                         int num_samples, bool is_told) {
  Totals totals;
  for (int seed = 1; seed <= arguments.num_seeds; ++seed) {
    Rng rng(static_cast<Rng::result_type>(seed));
    const std::vector<ActionPoseSample> samples = unexplained(kind, num_parts, num_samples, rng);
    keep(arguments, fmt::format("{}_{}_{}_{}", name_of(kind), num_parts, num_samples, seed),
         samples);
    timed_learn(unexplained_signals(), samples, is_told, &totals);
  }
  print(fmt::format("{}, N = {}", name_of(kind), num_samples), num_parts, is_told ? "told" : "–",
        arguments.num_seeds, totals, "–");
}

}  // namespace

int main(int argc, char** argv) {
  Arguments arguments;
  CLI::App app("Learning time and message size over the number of parts");
  app.add_option("--parts", arguments.parts, "Sizes of the random trees; 0: none");
  app.add_option("--unexplained", arguments.unexplained_parts,
                 "Sizes of the recordings that no model explains; 0: none");
  app.add_option("--hidden", arguments.num_hidden, "Hidden parts of each tree");
  app.add_option("--samples", arguments.num_samples, "Samples of each tree");
  app.add_option("--seeds", arguments.num_seeds, "Robots a row");
  app.add_option("--csv", arguments.csv, "Also write the recordings into this folder");
  CLI11_PARSE(app, argc, argv);
  std::cout << "| recording | parts | noise | right / incomplete / wrong | edges | fits | "
               "CPU s, mean (largest) | bytes |\n|---|---|---|---|---|---|---|---|\n";
  for (const bool is_told : {true, false}) {
    for (const int n : arguments.parts)
      if (n > 0) measure_tree(arguments, n, is_told);
    for (const int n : arguments.unexplained_parts)
      for (const Unexplained kind : {Unexplained::kWalk, Unexplained::kFree, Unexplained::kSoft})
        for (const int num_samples : {100, 400})
          if (n > 0) measure_unexplained(arguments, kind, n, num_samples, is_told);
  }
}
