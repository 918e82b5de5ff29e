// How soon a small constant fault is found: the arm of BrokenArm, its engineered model, healthy for
// 100 samples, then broken for good. Found: something is said of the place that changed, or of one
// beside it, within --within samples. Prints Markdown.
//
//   small_faults [--runs 200] [--within 40] [--healthy 100] [--cell WORDS]

#include <fmt/format.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cstdio>
#include <set>
#include <string>
#include <vector>

#include "processes/model_monitor/adaptation.h"
#include "tests/support/broken_arm.h"

using namespace bodyschema;
using namespace bodyschema::test;

namespace {

using Kind = AdaptationEvent::Kind;

struct Cell {
  std::string name;
  Fault fault;
  double size;  ///< of BrokenArm's
  int joint = 4;
  double range_rad = 1.35;
};

const std::vector<Cell> kCells{
    {"nothing", Fault::kNone, 1},
    {"joint offset 1°", Fault::kOffset, 0.05},
    {"joint offset 1.5°", Fault::kOffset, 0.075},
    {"joint offset 2°", Fault::kOffset, 0.1},
    {"link bent by 1°, 0.7 mm", Fault::kBend, 1 / 45.0},
    {"link bent by 2°, 1.3 mm", Fault::kBend, 2 / 45.0},
    {"tool off by 1°, 3 mm", Fault::kTool, 1 / 80.0},
    {"tool off by 2°, 6 mm", Fault::kTool, 2 / 80.0},
    {"marker moved by 1.1°, 1 mm", Fault::kMarker, 0.02},
    {"marker moved by 2.3°, 2 mm", Fault::kMarker, 0.04},
    {"camera off by 1°, 7 mm", Fault::kCamera, 1 / 15.0},
    {"wrist's offset 5°", Fault::kOffset, 0.25, 7},
    {"wrist's offset 20°", Fault::kOffset, 1, 7},
    {"joint reversed, ±77°", Fault::kReversed, 1},
    {"joint reversed, ±160°", Fault::kReversed, 1, 4, 2.8},
    {"wrist reversed, ±160°", Fault::kReversed, 1, 7, 2.8},
    {"link bent by 10°, 7 mm, on and off", Fault::kIntermittent, 10 / 45.0}};

struct Count {
  int num_runs = 0, num_found = 0, num_placed = 0, num_named = 0;
  int num_early = 0, num_elsewhere = 0;  ///< events
  std::vector<double> until, mended;
  int num_marker = 0;  ///< runs in which the cause was marker_moved in the end
  double seconds = 0;
};

void live(const Cell& cell, Regime regime, int healthy, int within, int seed, Count* count) {
  Scenario scenario{cell.fault, cell.name.c_str(), 0.85, 0, 0, cell.size};
  scenario.joint = cell.joint;
  scenario.range_rad = cell.range_rad;
  BrokenArm arm(scenario, regime, healthy, seed);
  Adaptation adaptation(arm.engineered(), adaptation_options(regime));
  bool is_found = false, is_placed = false, is_named = false, is_marker = false;
  double healthy_m = 0;
  int bad = 0;
  const int end = std::min(healthy + within, arm.num_samples());
  for (int t = 0; t < end; ++t) {
    const ActionPoseSample sample = arm.observe(t);
    const double start = thread_seconds();
    const auto events = adaptation.on_sample(sample);
    count->seconds += thread_seconds() - start;
    for (const AdaptationEvent& event : events) {
      if (event.kind == Kind::kProbeWanted) continue;
      const int part = event.part >= 0 ? event.part : event.to;
      if (t < healthy) {
        ++count->num_early;
        continue;
      }
      if (!arm.is_near(part)) {
        ++count->num_elsewhere;
        continue;
      }
      if (!is_found) count->until.push_back(t - healthy + 1);
      is_found = true;
      const auto is_it = [&](const TrueChange& change) {
        return change.part == part && (event.part >= 0 ? change.at_marker : change.at_edge);
      };
      const auto it = std::find_if(arm.changes().begin(), arm.changes().end(), is_it);
      const bool is_explanation = event.kind == Kind::kCandidate || event.kind == Kind::kRefined ||
                                  event.kind == Kind::kDrift;
      if (!is_explanation && event.kind != Kind::kMismatch) continue;
      is_placed = it != arm.changes().end();
      if (is_explanation) is_named = is_placed && it->causes.contains(event.cause);
      if (is_explanation) is_marker = event.cause == "marker_moved";
    }
    if (t == healthy - 1) healthy_m = arm.error(adaptation.schema(), t);
    if (t >= healthy && arm.error(adaptation.schema(), t) > 1.5 * healthy_m) bad = t - healthy + 1;
  }
  ++count->num_runs;
  count->num_found += is_found;
  count->num_marker += is_marker;
  count->mended.push_back(bad);
  count->num_placed += is_placed;
  count->num_named += is_named;
}

}  // namespace

int main(int argc, char** argv) {
  int num_runs = 200, within = 40, healthy = 100;
  std::string words;
  bool is_chapter = false;
  CLI::App app("Small constant faults");
  app.add_option("--runs", num_runs, "A row")->check(CLI::PositiveNumber);
  app.add_option("--within", within, "Samples after the fault")->check(CLI::PositiveNumber);
  app.add_option("--healthy", healthy, "Samples before it")->check(CLI::PositiveNumber);
  app.add_option("--cell", words, "Rows whose name has these words alone");
  app.add_flag("--chapter", is_chapter, "In the chapter's noise instead of tag_iso");
  CLI11_PARSE(app, argc, argv);

  std::printf(
      "| fault | found within %d | samples, median (95 %%) | mended after, median (95 %%) | in the "
      "end: place right | cause right | called a moved marker | events before it, in 1000 | events "
      "elsewhere, in a run | ms a sample |\n"
      "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |\n",
      within);
  for (const Cell& cell : kCells) {
    if (cell.name.find(words) == std::string::npos) continue;
    Count count;
    for (int seed = 1; seed <= num_runs; ++seed)
      live(cell, is_chapter ? Regime::kChapter : Regime::kTagIso, healthy, within, seed, &count);
    const auto quantiles = [](std::vector<double>& samples) {
      std::sort(samples.begin(), samples.end());
      const auto at = [&](double share) {
        const double last = static_cast<double>(samples.size()) - 1;
        return samples.empty() ? 0.0 : samples[static_cast<std::size_t>(share * last)];
      };
      return fmt::format("{:.0f} ({:.0f})", at(0.5), at(0.95));
    };
    const auto percent = [&](int n) { return 100.0 * n / count.num_runs; };
    std::printf("| %s | %.1f %% | %s | %s | %.1f %% | %.1f %% | %.1f %% | %.2f | %.3f | %.2f |\n",
                cell.name.c_str(), percent(count.num_found), quantiles(count.until).c_str(),
                quantiles(count.mended).c_str(), percent(count.num_placed),
                percent(count.num_named), percent(count.num_marker),
                1e3 * count.num_early / count.num_runs / healthy,
                static_cast<double>(count.num_elsewhere) / count.num_runs,
                1e3 * count.seconds / count.num_runs / (healthy + within));
    std::fflush(stdout);
  }
}
