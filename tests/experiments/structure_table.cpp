// structure_table: share of right learned structures. Prints a Markdown table
//   robot | regime | noise | N | right / incomplete / wrong % | detectable, right of these % |
//   mean CPU ms | fits
// "Detectable": every joint shows in the two markers next to it, r/√3 · √N > 5 σ with r its half
// range and σ the noise of their relative pose, in translation or in rotation.
//
// structure_table ROBOTS REGIMES NOISE NS FIRST_SEED NUM_SEEDS [verbose]
//   ROBOTS   comma-separated: a, c, co, d, dP, tree, tree3 (adjacent hidden parts), tree12, tree40
//   REGIMES  free, chapter, tag, tag_iso
//   NOISE    covariance (in the observations), given (isotropic), estimated, other (covariances and
//            second hypotheses)
//   NS       numbers of samples

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <ctime>
#include <iostream>
#include <sstream>

#include "processes/structure_learner/learn.h"
#include "tests/support/synthetic_robot.h"

using namespace bodyschema;
using namespace bodyschema::test;

namespace {

std::vector<std::string> split(const std::string& text) {
  std::vector<std::string> result;
  std::istringstream in(text);
  for (std::string item; std::getline(in, item, ',');) result.push_back(item);
  return result;
}

SyntheticRobot make_robot(const std::string& name, Rng& rng) {
  RandomTreeOptions options;
  if (name == "tree3") options.adjacent_hidden = true;
  if (name == "tree12") {
    options.num_parts = 12;
    options.num_hidden = 2;
  }
  if (name == "tree40") {
    options.num_parts = 40;
    options.num_hidden = 3;
    options.share_fixed = 0.25;
  }
  if (name.rfind("tree", 0) == 0) return random_tree(options, rng);
  return chapter_robot(name, rng);
}

bool is_detectable(const SyntheticRobot& robot, Regime regime, int num_samples) {
  if (regime == Regime::kFree) return true;
  const Noise noise = nominal_noise(regime);
  for (const TrueLink& link : robot.links) {
    if (link.signal < 0) continue;
    const Signal& signal = robot.signals[link.signal];
    const double half = 0.5 * (signal.upper - signal.lower);
    const double in_sigmas =
        half * std::max(std::abs(link.slide) / (std::sqrt(2.0) * noise.position_m),
                        std::abs(link.turn) / (std::sqrt(2.0) * noise.rotation_rad));
    if (in_sigmas * std::sqrt(num_samples / 3.0) < 5) return false;
  }
  return true;
}

void describe(const BodySchema& schema, const SyntheticRobot& robot) {
  for (const Edge& e : schema.edges) {
    std::printf("    %d-%d {", e.from, e.to);
    for (const int s : e.signals()) std::printf(" %d", s);
    std::printf(" } true {");
    for (const int s : robot.path_signals(e.from, e.to)) std::printf(" %d", s);
    std::printf(" } rms %.2g m %.2g rad, %d of %d outliers\n", e.position_rms_m, e.rotation_rms_rad,
                e.num_outliers, e.num_samples);
  }
  for (const auto& u : schema.unconnected)
    std::printf("    unconnected %d: %d %s\n", u.part, static_cast<int>(u.reason),
                u.detail.c_str());
  std::printf("    noise %.3g m %.3g rad\n", schema.noise.position_m, schema.noise.rotation_rad);
}

struct Seeds {
  int first, num;
};

void print_row(const std::string& robot_name, const std::string& regime_name,
               const std::string& noise, int n, const Seeds& seeds, bool verbose) {
  int counts[3] = {0, 0, 0};
  int num_detectable = 0, num_right = 0;  // and right
  double search_seconds = 0, learn_seconds = 0;
  long fits = 0;
  for (int seed = seeds.first; seed < seeds.first + seeds.num; ++seed) {
    Rng rng(seed);
    const SyntheticRobot robot = make_robot(robot_name, rng);
    ObservationOptions observation;
    for (const Regime r : {Regime::kFree, Regime::kChapter, Regime::kTag, Regime::kTagIso})
      if (regime_name == name_of(r)) observation.regime = r;
    observation.with_covariances = noise == "covariance" || noise == "other";
    observation.with_other_hypothesis = noise == "other";
    LearnOptions options;
    if (noise == "given") options.measurement.noise = nominal_noise(observation.regime);
    const auto samples = babble(robot, n, observation, rng);
    const std::clock_t start = std::clock();
    const LearnedStructure structure = find_structure(robot.signals, samples, options);
    search_seconds += static_cast<double>(std::clock() - start) / CLOCKS_PER_SEC;
    const LearnResult result = fit_structure(structure, samples, options);
    learn_seconds += static_cast<double>(std::clock() - start) / CLOCKS_PER_SEC;
    fits += result.num_fits;
    const Rightness rightness = judge(result.schema, robot);
    ++counts[static_cast<int>(rightness)];
    if (is_detectable(robot, observation.regime, n)) {
      ++num_detectable;
      num_right += rightness == Rightness::kRight;
    }
    if (verbose && rightness != Rightness::kRight) {
      std::printf("  seed %d: %s\n", seed, rightness == Rightness::kWrong ? "wrong" : "incomplete");
      describe(result.schema, robot);
    }
  }
  std::printf(
      "| %s | %s | %s | %d | %.1f / %.1f / %.1f | %.0f, %.1f | %.0f | %.0f | "
      "%.0f |\n",
      robot_name.c_str(), regime_name.c_str(), noise.c_str(), n, 100.0 * counts[0] / seeds.num,
      100.0 * counts[1] / seeds.num, 100.0 * counts[2] / seeds.num,
      100.0 * num_detectable / seeds.num, 100.0 * num_right / std::max(num_detectable, 1),
      1e3 * search_seconds / seeds.num, 1e3 * learn_seconds / seeds.num,
      static_cast<double>(fits) / seeds.num);
  std::fflush(stdout);
}

}  // namespace

int main(int argc, char** argv) {
  if (argc < 7) {
    std::cerr << "usage: structure_table ROBOTS REGIMES NOISE NS FIRST_SEED NUM_SEEDS [verbose]\n";
    return 2;
  }
  const Seeds seeds{std::stoi(argv[5]), std::stoi(argv[6])};
  const bool verbose = argc > 7;
  std::printf(
      "| robot | regime | noise | N | right / incomplete / wrong %% | detectable, right of these "
      "%% | "
      "search, ms | learning, ms | fits |\n");
  std::printf("|---|---|---|---|---|---|---|---|---|\n");
  for (const std::string& robot_name : split(argv[1])) {
    for (const std::string& regime_name : split(argv[2])) {
      for (const std::string& noise : split(argv[3])) {
        for (const std::string& n_text : split(argv[4]))
          print_row(robot_name, regime_name, noise, std::stoi(n_text), seeds, verbose);
      }
    }
  }
}
