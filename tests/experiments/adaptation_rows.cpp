// adaptation_rows old|new [--runs N] [--fault WORDS] [--regime chapter|tag_iso]
#include <CLI/CLI.hpp>
#include <algorithm>
#include <array>
#include <cstdio>
#include <map>
#include <optional>
#include <string>
#include <thread>
#include <vector>

#include "processes/model_monitor/adaptation.h"
#include "tests/support/broken_arm.h"

using namespace bodyschema;
using namespace bodyschema::test;
using Kind = AdaptationEvent::Kind;

namespace {

struct Life {
  std::array<int, 4> until_right{};
  std::array<bool, 4> place{}, cause{};
  int wrong_events = 0, strictly_wrong = 0, num_events = 0;
  double seconds = 0, slowest = 0, error = 0;
};

bool verbose = false;

template <class Monitor>
Life live(const Scenario& scenario, Regime regime, int length, int seed, bool print) {
  BrokenArm arm(scenario, regime, length, seed);
  Monitor monitor(arm.engineered(), adaptation_options(regime, 1));
  Life life;
  std::map<std::pair<int, bool>, std::string> causes;
  const double limit = regime == Regime::kChapter ? 0.075 : 0.030;
  for (int t = 0; t < arm.num_samples(); ++t) {
    if (t % length == 0) causes.clear();
    const ActionPoseSample sample = arm.observe(t);
    const double start = thread_seconds();
    const auto events = monitor.on_sample(sample);
    const double s = thread_seconds() - start;
    life.seconds += s;
    life.slowest = std::max(life.slowest, s);
    const int block = t / length;
    const double error = arm.error(monitor.schema(), t);
    if (error > limit) life.until_right[block] = t % length + 1;
    if (t % length >= length - 20 && block == 1) life.error += error / 20;
    for (const AdaptationEvent& e : events) {
      const std::pair<int, bool> place{e.part >= 0 ? e.part : e.to, e.part >= 0};
      if (e.kind == Kind::kCandidate || e.kind == Kind::kRestored || e.kind == Kind::kRefined ||
          e.kind == Kind::kDrift)
        causes[place] = e.cause;
      if (e.kind == Kind::kReverted) causes.erase(place);
      if (print)
        std::printf("  seed %d t %d %s %s%d %s margin %.1f since %ld err %.1f mm\n", seed, t,
                    name_of(e.kind), e.part >= 0 ? "marker " : "edge to ", place.first,
                    e.cause.c_str(), e.margin, (long)e.since, error * 1e3);
      if (e.kind == Kind::kProbeWanted) continue;
      ++life.num_events;
      life.wrong_events += t < length || !arm.is_near(place.first);
      life.strictly_wrong +=
          t < length ||
          std::none_of(arm.changes().begin(), arm.changes().end(), [&](const TrueChange& c) {
            return c.part == place.first && (place.second ? c.at_marker : c.at_edge);
          });
    }
    if ((t + 1) % length == 0) {
      bool all = !causes.empty(), right = true;
      for (const auto& [p, cause] : causes) {
        bool is = false, caused = false;
        for (const TrueChange& c : arm.changes()) {
          const bool here = c.part == p.first && (p.second ? c.at_marker : c.at_edge);
          is |= here;
          caused |= here && (cause == "stored" || c.causes.contains(cause));
        }
        all &= is;
        right &= caused;
      }
      for (const TrueChange& c : arm.changes())
        all &= std::any_of(causes.begin(), causes.end(), [&](const auto& x) {
          return x.first.first == c.part && (x.first.second ? c.at_marker : c.at_edge);
        });
      life.place[block] = all;
      life.cause[block] = all && right;
    }
  }
  return life;
}

}  // namespace

int main(int argc, char** argv) {
  std::string which = "new", fault, regime_name = "tag_iso";
  int runs = 20, length = 100, first = 1;
  CLI::App app("rows");
  app.add_option("which", which);
  app.add_option("--runs", runs);
  app.add_option("--first", first);
  app.add_option("--fault", fault);
  app.add_option("--regime", regime_name);
  app.add_flag("--verbose", verbose);
  CLI11_PARSE(app, argc, argv);
  const Regime regime = regime_name == "chapter" ? Regime::kChapter : Regime::kTagIso;
  const std::vector<Scenario> scenarios = {
      {Fault::kStuck, "joint stuck", 0.919},   {Fault::kTool, "tool exchanged", 0.79},
      {Fault::kBend, "link bent", 0.85},       {Fault::kOffset, "joint offset", 0.85},
      {Fault::kGain, "joint gain", 0.85},      {Fault::kTwo, "two at once", 0.85},
      {Fault::kAdjacent, "two adjacent", 0.85}, {Fault::kMarker, "marker moved", 0.85},
      {Fault::kCamera, "camera bumped", 0.85}, {Fault::kWorn, "worn", 0.85},
      {Fault::kCoupled, "coupled", 0.85},      {Fault::kElastic, "elastic", 0.85},
      {Fault::kNone, "none", 0.85}};
  for (const Scenario& scenario : scenarios) {
    if (std::string(scenario.name).find(fault) == std::string::npos) continue;
    std::vector<Life> lives;
    for (int r = 0; r < runs; ++r)
      lives.push_back(live<Adaptation>(scenario, regime, length, first + r, verbose));
    std::printf("%-15s %-8s until", scenario.name, regime_name.c_str());
    for (int b = 1; b < 4; ++b) {
      double sum = 0;
      int worst = 0;
      for (const Life& l : lives) sum += l.until_right[b], worst = std::max(worst, l.until_right[b]);
      std::printf(" %.2f (%d)%s", sum / runs, worst, b < 3 ? " /" : "");
    }
    int place = 0, cause = 0, wrong = 0, strict = 0, num = 0;
    double ms = 0, slowest = 0, error = 0;
    for (const Life& l : lives) {
      for (int b = 1; b < 4; ++b) place += l.place[b], cause += l.cause[b];
      wrong += l.wrong_events;
      strict += l.strictly_wrong;
      num += l.num_events;
      ms += l.seconds * 1e3 / (4 * length) / runs;
      slowest = std::max(slowest, l.slowest * 1e3);
      error += l.error * 1e3 / runs;
    }
    std::printf(" | place %.1f cause %.1f %% | events %d wrong %d strictly %d | err %.2f mm | %.2f ms (%.0f)\n",
                100.0 * place / (3 * runs), 100.0 * cause / (3 * runs), num, wrong, strict, error, ms, slowest);
    std::fflush(stdout);
  }
}
