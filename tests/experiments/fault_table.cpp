// A simulated rig breaks and is repaired while it babbles, from rendered images: of the robot with
// calibration errors, or the ideal one. Prints Markdown.
//
//   fault_table [config/arm7] --seeds 5 [--ideal]

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <set>
#include <string>
#include <vector>

#include "bodyschema/fault_command_t.hpp"
#include "common/bus/cause_names.h"
#include "common/bus/convert.h"
#include "common/estimation/quantile.h"
#include "tests/support/rendered_run.h"

using namespace bodyschema;
using F = fault_command_t;
using H = health_event_t;

namespace {

constexpr std::int64_t kBroken = 60, kRepaired = 110, kEnd = 150;
/// A schema is as good as before below this ratio of the errors.
constexpr double kAsGood = 1.5;

struct Case {
  const char* name;
  std::int8_t fault;
  const char* place;
  std::vector<int> numbers;
  double amount_deg;
  int part;  ///< the edge that leads to it, or its marker
  std::set<std::string> causes;
};

const std::vector<Case> kCases = {
    {"joint stuck", F::FAULT_STUCK, "q3", {-1}, 0, 5, {"joint_stuck"}},
    {"link bent by 10°", F::FAULT_BEND, "forearm", {-1}, 10, 6, {"geometry"}},
    {"tool exchanged", F::FAULT_TOOL, "", {1}, 0, 8, {"geometry"}},
    {"camera bumped", F::FAULT_CAMERA_BUMP, "", {-1}, 0, 1, {"camera_moved"}},
    {"one tag of four moved", F::FAULT_MARKER_MOVED, "", {28}, 0, 8, {"marker_moved"}},
    {"all tags of a part lost",
     F::FAULT_MARKER_LOST,
     "",
     {32, 33, 34, 35},
     0,
     9,
     {"marker_missing"}},
};

struct Life {
  bool is_named = false;             ///< place and cause of the first decision on a change
  std::int64_t until = -1;           ///< samples until it
  std::vector<std::string> strange;  ///< events elsewhere
  double healthy_m = 0, after_m = 0, repaired_m = 0;
};

bool is_decision(const H& event) {
  return event.event_kind == H::EVENT_CANDIDATE || event.event_kind == H::EVENT_RESTORED ||
         event.event_kind == H::EVENT_MISSING;
}
int part_of(const H& event) { return event.event_from >= 0 ? event.event_to : event.event_part; }

Life live(const Case& c, const std::filesystem::path& rig, std::int64_t seed, bool is_ideal) {
  test::RenderedRun run(rig, seed, {}, Choice::kActive, is_ideal);
  Life life;
  std::int64_t next_event = 0;
  std::vector<double> healthy, after, repaired;
  for (std::int64_t n = 0; n < kEnd; ++n) {
    if (n == kBroken)
      for (const int number : c.numbers) run.break_body(c.fault, c.place, number, c.amount_deg);
    if (n == kRepaired) run.break_body(F::FAULT_REPAIR);
    const test::RenderedRun::Step step = run.next();
    for (const H& event : run.monitor().health().events) {
      if (event.event_number < next_event) continue;
      next_event = event.event_number + 1;
      if (event.event_kind <= H::EVENT_SCHEMA_REFUSED || event.event_kind == H::EVENT_PROBE_WANTED)
        continue;
      if (part_of(event) != c.part || n < kBroken) {
        life.strange.push_back(std::to_string(n) + " " + event.event_text);
      } else if (life.until < 0 && n < kRepaired && is_decision(event)) {
        life.until = n - kBroken + 1;
        life.is_named = c.causes.count(cause_text(event.event_cause));
      }
    }
    if (!run.monitor().schema()) continue;
    // The end effector relative to the root: their placement errors are those of a healthy run,
    // too.
    const BodySchema schema = from_message(*run.monitor().schema());
    const auto X_RB = schema.predict(schema.root, 8, step.sample.action);
    if (!X_RB) continue;
    const double error_m =
        ((step.truth.at(schema.root).inverse() * step.truth.at(8)).translation() -
         X_RB->X_AB.translation())
            .norm();
    if (n >= kBroken - 15 && n < kBroken) healthy.push_back(error_m);
    if (n >= kRepaired - 30 && n < kRepaired) after.push_back(error_m);
    if (n >= kEnd - 20) repaired.push_back(error_m);
  }
  const auto middle = [](const std::vector<double>& v) { return v.empty() ? NAN : median(v); };
  life.healthy_m = middle(healthy);
  life.after_m = middle(after);
  life.repaired_m = middle(repaired);
  return life;
}

}  // namespace

int main(int argc, char** argv) {
  std::string rig = std::string(BODYSCHEMA_SOURCE_FOLDER "/config/arm7");
  int num_seeds = 5;
  bool is_ideal = false;
  CLI::App app("A rig breaks and is repaired, from rendered images");
  app.add_option("RIG", rig, "Rig folder with the parts of config/arm7");
  app.add_option("--seeds", num_seeds)->check(CLI::PositiveNumber);
  app.add_flag("--ideal", is_ideal, "Without calibration errors");
  CLI11_PARSE(app, argc, argv);

  std::printf(
      "%s, %s, broken from sample %lld to %lld, %d seeds\n\n"
      "| fault | named | samples until, median (worst) | events elsewhere (runs) | end effector "
      "before, mm | broken, from 20 samples on | repaired, from 20 on | as good as before: broken, "
      "repaired |\n| --- | --- | --- | --- | --- | --- | --- | --- |\n",
      std::filesystem::path(rig).filename().c_str(), is_ideal ? "ideal" : "with calibration errors",
      static_cast<long long>(kBroken), static_cast<long long>(kRepaired), num_seeds);
  for (const Case& c : kCases) {
    int num_named = 0, num_strange_runs = 0, num_good = 0, num_good_again = 0;
    std::size_t num_strange = 0;
    std::vector<double> until, healthy, after, repaired;
    for (std::int64_t seed = 1; seed <= num_seeds; ++seed) {
      const Life life = live(c, rig, seed, is_ideal);
      num_named += life.is_named;
      until.push_back(life.until < 0 ? kRepaired - kBroken : static_cast<double>(life.until));
      num_strange += life.strange.size();
      num_strange_runs += !life.strange.empty();
      healthy.push_back(life.healthy_m * 1e3);
      after.push_back(life.after_m * 1e3);
      repaired.push_back(life.repaired_m * 1e3);
      num_good += life.after_m < kAsGood * life.healthy_m;
      num_good_again += life.repaired_m < kAsGood * life.healthy_m;
      std::fprintf(stderr, "%s, seed %lld: named %d after %lld, %.2f %.2f %.2f mm\n", c.name,
                   static_cast<long long>(seed), life.is_named, static_cast<long long>(life.until),
                   healthy.back(), after.back(), repaired.back());
      for (const std::string& event : life.strange) std::fprintf(stderr, "  %s\n", event.c_str());
    }
    std::printf("| %s | %d of %d | %.0f (%.0f) | %zu (%d) | %.2f | %.2f | %.2f | %d, %d |\n",
                c.name, num_named, num_seeds, median(until),
                *std::max_element(until.begin(), until.end()), num_strange, num_strange_runs,
                median(healthy), median(after), median(repaired), num_good, num_good_again);
    std::fflush(stdout);
  }
}
