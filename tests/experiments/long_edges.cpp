// Faults at every joint and link of an arm of which base and hand alone are seen. Prints Markdown.
//
//   long_edges --joints 7 --seeds 5 [--slides 3] [--fine] [--healthy 2000] [--fault NAME] [-v]

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cstdio>
#include <vector>

#include "common/estimation/quantile.h"
#include "processes/model_monitor/health/health_words.h"
#include "tests/support/long_arm.h"

using namespace bodyschema;
using test::LongArm;
using test::LongFault;
using Kind = AdaptationEvent::Kind;

namespace {

constexpr double kRight_m = 0.03;
/// A schema is as good as before below this ratio of the errors.
constexpr double kAsGood = 1.5;

bool is_explanation(const AdaptationEvent& event) {
  return event.kind == Kind::kCandidate || event.kind == Kind::kRefined ||
         event.kind == Kind::kRecovered || event.kind == Kind::kDrift;
}

void print(const LongArm& arm, const test::LongLife& life) {
  for (const AdaptationEvent& event : life.events)
    std::fprintf(stderr, "    %lld %s\n", static_cast<long long>(event.sample_index),
                 text_of(event, arm.engineered().signals).c_str());
}

struct Cell {
  LongFault fault = LongFault::kNone;
  int at = 0;
  int num_runs = 0, num_named = 0, num_first = 0, num_early = 0, num_unrepaired = 0;
  std::vector<double> until, strict, again;
  double most_ms = 0, mean_ms = 0;
};

void run(const test::LongArmOptions& options, int seed, bool is_verbose, Cell* cell) {
  const int block = options.block_length;
  LongArm arm(options, cell->fault, cell->at, seed);
  const test::LongLife life = live(&arm, 3 * block);
  const double healthy = life.error[static_cast<std::size_t>(block) - 1];
  cell->until.push_back(life.samples_until_right(1, block, kRight_m));
  cell->strict.push_back(life.samples_until_right(1, block, kAsGood * healthy));
  cell->again.push_back(life.samples_until_right(2, block, kAsGood * healthy));
  bool is_named = false, is_first = true, was_first = false;
  for (const AdaptationEvent& event : life.events) {
    cell->num_early += event.sample_index < block;
    if (event.sample_index < block || event.sample_index >= 2 * block || !is_explanation(event))
      continue;
    is_named = arm.is_named_by(event);
    if (is_first) was_first = is_named;
    is_first = false;
  }
  ++cell->num_runs;
  cell->num_named += is_named;
  cell->num_first += was_first;
  cell->num_unrepaired += cell->until.back() >= block;
  cell->most_ms = std::max(cell->most_ms, 1e3 * life.most_seconds);
  cell->mean_ms += 1e3 * life.mean_seconds;
  if (!is_verbose) return;
  std::fprintf(stderr,
               "%s %d seed %d: right %.0f, strict %.0f (healthy %.1f mm), repaired %.0f%s\n",
               name_of(cell->fault), cell->at + 1, seed, cell->until.back(), cell->strict.back(),
               1e3 * healthy, cell->again.back(), is_named ? "" : ", NOT NAMED");
  print(arm, life);
}

void print_healthy(const test::LongArmOptions& options, int num_seeds, int num_samples) {
  int num_events = 0;
  double mean = 0, most = 0;
  for (int seed = 1; seed <= num_seeds; ++seed) {
    LongArm arm(options, LongFault::kNone, 0, seed);
    const test::LongLife life = live(&arm, num_samples);
    num_events += static_cast<int>(life.events.size());
    mean += life.mean_seconds / num_seeds;
    most = std::max(most, life.most_seconds);
    print(arm, life);
  }
  std::printf("healthy: %d events in %d × %d samples; %.2f ms a sample, %.1f ms at most\n",
              num_events, num_seeds, num_samples, 1e3 * mean, 1e3 * most);
}

double mean_of(const std::vector<double>& values) {
  double sum = 0;
  for (const double value : values) sum += value;
  return sum / static_cast<double>(values.size());
}

}  // namespace

int main(int argc, char** argv) {
  test::LongArmOptions options;
  int num_seeds = 5, num_healthy = 2000, slides = 0;
  std::string only;
  bool is_verbose = false;
  CLI::App app("Faults inside a long edge");
  app.add_option("--joints", options.num_joints)->check(CLI::Range(1, 9));
  app.add_option("--slides", slides, "The joint that slides, from 1; 0: none");
  app.add_option("--seeds", num_seeds)->check(CLI::PositiveNumber);
  app.add_option("--healthy", num_healthy, "Samples of a healthy arm; 0: none");
  app.add_option("--fault", only, "This one alone");
  app.add_flag("--fine", options.is_fine, "1 mm, 0.3°, no outliers; else 3 mm, 1°, 3 %");
  app.add_flag("-v,--verbose", is_verbose);
  CLI11_PARSE(app, argc, argv);
  options.slides = slides - 1;

  std::printf("%d joints, %s, %d seeds\n", options.num_joints, options.is_fine ? "fine" : "tag_iso",
              num_seeds);
  if (num_healthy > 0) print_healthy(options, num_seeds, num_healthy);
  std::printf(
      "\n| fault | at | named in the end | named at first | below 30 mm after, median (worst) | "
      "below 1.5 × healthy | never below 30 mm | repaired: 1.5 × healthy | events before | ms a "
      "sample, mean (most) "
      "|\n| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |\n");
  const int k = options.num_joints;
  for (const auto& [fault, first, last] : {std::tuple{LongFault::kStuck, 0, k - 1},
                                           {LongFault::kOffset, 0, k - 1},
                                           {LongFault::kGain, 0, k - 1},
                                           {LongFault::kBend, 0, k - 2},
                                           {LongFault::kBase, 0, 0},
                                           {LongFault::kTool, 0, 0},
                                           {LongFault::kDrift, 0, k - 1},
                                           {LongFault::kWorn, 0, k - 1}}) {
    if (!only.empty() && only != name_of(fault)) continue;
    for (int at = first; at <= last; ++at) {
      Cell cell;
      cell.fault = fault;
      cell.at = at;
      for (int seed = 1; seed <= num_seeds; ++seed) run(options, seed, is_verbose, &cell);
      const auto worst = [](const std::vector<double>& v) {
        return *std::max_element(v.begin(), v.end());
      };
      std::printf(
          "| %s | %d | %d of %d | %d | %.0f (%.0f) | %.1f (%.0f) | %d | %.1f (%.0f) | %d | %.1f "
          "(%.0f) |\n",
          name_of(fault), at + 1, cell.num_named, cell.num_runs, cell.num_first, median(cell.until),
          worst(cell.until), mean_of(cell.strict), worst(cell.strict), cell.num_unrepaired,
          mean_of(cell.again), worst(cell.again), cell.num_early, cell.mean_ms / cell.num_runs,
          cell.most_ms);
      std::fflush(stdout);
    }
  }
}
