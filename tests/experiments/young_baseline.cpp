// A body that does not change: events that learner and monitor report of it live, and their last
// schema beside learn() on the same samples. One run a rig and seed is rendered; each part
// is hidden in it in turn. Prints Markdown; fails if there are events, or the schema is wrong or
// worse.
//
//   young_baseline [config/arm2 config/arm4 config/arm7] --seeds 50 --samples 60
//   young_baseline --honest --as-seen --seeds 1 --samples 2000      with calibration errors, false
//   events

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cstdio>
#include <filesystem>
#include <map>
#include <optional>
#include <set>
#include <stdexcept>
#include <string>
#include <vector>

#include "common/bus/channels.h"
#include "common/bus/convert.h"
#include "common/bus/event_log.h"
#include "common/config/rig.h"
#include "tests/support/live_run.h"
#include "tests/support/rendered_run.h"
#include "tests/support/rig_truth.h"
#include "tests/support/synthetic_robot.h"

using namespace bodyschema;
using test::Rightness;

namespace {

struct Arguments {
  std::vector<std::string> rigs;
  int num_seeds = 50;
  std::int64_t first_seed = 1;
  std::size_t num_samples = 60;
  std::optional<int> hide;
  std::string folder;
  bool must_be_there = false, is_honest = false, is_as_seen = false;
};

/// Rendered, or kept in the folder by an earlier call.
/// @throws std::runtime_error if it is not there and must be.
std::vector<sample_t> samples_of(const std::filesystem::path& rig, std::int64_t seed,
                                 const Arguments& arguments) {
  const std::set<int> hidden = arguments.hide ? std::set<int>{*arguments.hide} : std::set<int>{};
  const std::filesystem::path folder = arguments.folder;
  const std::size_t num_samples = arguments.num_samples;
  std::string name = rig.filename().string() + "_" + std::to_string(seed);
  for (const int part : hidden) name += "_" + std::to_string(part);
  if (arguments.is_honest) name += "_honest";
  const auto file = folder / (name + ".lcmlog");
  std::vector<sample_t> samples;
  if (!folder.empty() && std::filesystem::exists(file)) samples = read_log(file, kSample);
  if (samples.size() >= num_samples) {
    samples.resize(num_samples);
    return samples;
  }
  if (arguments.must_be_there)
    throw std::runtime_error(file.string() +
                             " is no run of so many samples; render it with --keep alone");
  samples.clear();
  test::RenderedRun run(rig, seed, hidden, std::nullopt, !arguments.is_honest);
  while (samples.size() < num_samples) samples.push_back(run.next().message);
  if (!folder.empty()) {
    LogAppender log(file, LogAppender::Mode::kOverwrite, LogAppender::Durability::kToKernel);
    for (const sample_t& sample : samples) log.append(kSample, sample);
  }
  return samples;
}

Rightness judge(const std::optional<BodySchema>& schema, const test::RigTruth& truth,
                const std::vector<int>& observed) {
  if (!schema) return Rightness::kIncomplete;
  if (truth.objection(*schema, observed).empty()) return Rightness::kRight;
  const bool is_wrong =
      schema->complete ||
      std::any_of(schema->edges.begin(), schema->edges.end(), [&](const Edge& edge) {
        const std::vector<int> signals = edge.signals();
        return std::set<int>(signals.begin(), signals.end()) !=
                   truth.path_signals(edge.from, edge.to) ||
               test::judge_chain(edge, truth.true_edge(edge.from, edge.to), schema->signals)
                       .rightness == Rightness::kWrong;
      });
  return is_wrong ? Rightness::kWrong : Rightness::kIncomplete;
}

/// Of all runs of a rig.
struct Counts {
  int num_runs = 0, num_eventful = 0, num_wrong = 0, num_worse = 0;
  std::size_t num_events = 0;
  std::ptrdiff_t num_missing = 0;
  std::map<Rightness, int> live, offline;

  void add(const test::LiveRun& run, Rightness held, Rightness learned) {
    ++num_runs;
    num_eventful += !run.events.empty();
    num_events += run.events.size();
    num_missing += std::count_if(run.events.begin(), run.events.end(), [](const auto& event) {
      return event.event_cause == health_event_t::CAUSE_MARKER_MISSING;
    });
    num_wrong += held == Rightness::kWrong && learned == Rightness::kWrong;
    num_worse += held > learned;
    ++live[held];
    ++offline[learned];
  }
  bool is_good() const { return num_eventful == 0 && num_wrong == 0 && num_worse == 0; }
};

void print(const std::string& rig, Counts counts) {
  const auto text = [](std::map<Rightness, int>& of) {
    return std::to_string(of[Rightness::kRight]) + " / " +
           std::to_string(of[Rightness::kIncomplete]) + " / " +
           std::to_string(of[Rightness::kWrong]);
  };
  std::printf("| %s | %d | %d | %zu | %td | %s | %s | %d | %d |\n", rig.c_str(), counts.num_runs,
              counts.num_eventful, counts.num_events, counts.num_missing, text(counts.live).c_str(),
              text(counts.offline).c_str(), counts.num_wrong, counts.num_worse);
  std::fflush(stdout);
}

/// All runs of a rig; what is not as it should be goes to stderr.
Counts run_all(const std::filesystem::path& rig, const Arguments& arguments) {
  const MeasurementModel measurement =
      load_noise(rig, arguments.is_honest ? "noise.yaml" : "ideal_noise.yaml").measurement;
  StructureLearnerConfig learner = StructureLearnerConfig::load(rig / "structure_learner.yaml");
  learner.options.measurement = measurement;
  ModelMonitorConfig monitor = ModelMonitorConfig::load(rig / "model_monitor.yaml");
  monitor.measurement = measurement;
  const test::RigTruth truth(rig);
  Counts counts;
  const std::int64_t end = arguments.first_seed + arguments.num_seeds;
  for (std::int64_t seed = arguments.first_seed; seed < end; ++seed) {
    const auto rendered = samples_of(rig, seed, arguments);
    std::vector<int> hidden;
    if (!arguments.is_as_seen) hidden = truth.parts();
    hidden.insert(hidden.begin(), -1);  // none
    if (arguments.hide) hidden = {*arguments.hide};
    for (const int part : hidden) {
      // A root that is never seen has no tree.
      if (part == learner.options.root) continue;
      const auto samples = part < 0 ? rendered : test::without_part(rendered, part);
      std::vector<int> observed = truth.parts();
      std::erase(observed, part);
      const test::LiveRun run = test::live_run(samples, learner, monitor);
      const Rightness held = judge(run.schema, truth, observed),
                      learned = judge(test::learned_offline(samples, learner), truth, observed);
      counts.add(run, held, learned);
      if (run.events.empty() && held == Rightness::kRight && learned == Rightness::kRight) continue;
      std::fprintf(stderr, "%s seed %lld, part %d hidden: live %d, offline %d\n",
                   rig.filename().c_str(), static_cast<long long>(seed), part,
                   static_cast<int>(held), static_cast<int>(learned));
      if (run.schema && held != Rightness::kRight)
        std::fprintf(stderr, "  held: %s\n", truth.objection(*run.schema, observed).c_str());
      for (const health_event_t& event : run.events)
        std::fprintf(stderr, "  %lld  %s\n", static_cast<long long>(event.event_sample),
                     event.event_text.c_str());
    }
  }
  return counts;
}

}  // namespace

int main(int argc, char** argv) {
  Arguments arguments;
  CLI::App app("A young baseline of a body that nothing happens to");
  app.add_option("RIGS", arguments.rigs, "Rig folders");
  app.add_option("--seeds", arguments.num_seeds)->check(CLI::PositiveNumber);
  app.add_option("--first-seed", arguments.first_seed);
  app.add_option("--samples", arguments.num_samples)->check(CLI::PositiveNumber);
  app.add_option("--hide", arguments.hide,
                 "This part alone is hidden, in the images, as ./run --hide does");
  app.add_flag("--honest", arguments.is_honest, "The robot with calibration errors");
  app.add_flag("--as-seen", arguments.is_as_seen, "No part is hidden in turn");
  app.add_option("--keep", arguments.folder, "Rendered samples are kept here and used again")
      ->check(CLI::ExistingDirectory);
  app.add_flag("--recorded", arguments.must_be_there,
               "Nothing is rendered: all is in --keep's folder");
  CLI11_PARSE(app, argc, argv);
  if (arguments.rigs.empty())
    for (const char* name : {"arm2", "arm4", "arm7"})
      arguments.rigs.push_back(std::string(BODYSCHEMA_SOURCE_FOLDER "/config/") + name);

  std::printf(
      "| rig | runs | with events | events | of them `marker_missing` | live: right / incomplete / "
      "wrong | offline: right / incomplete / wrong | wrong in both | live worse than offline |\n| "
      "--- "
      "| --- | --- | --- | --- | --- | --- | --- | --- |\n");
  bool is_good = true;
  for (const std::filesystem::path rig : arguments.rigs) {
    const Counts counts = run_all(rig, arguments);
    print(rig.filename(), counts);
    is_good &= counts.is_good();
  }
  return is_good ? 0 : 1;
}
