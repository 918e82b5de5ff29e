// Section 4, first of its three assumptions: changes are rare. How often a healthy body is found
// broken.

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <map>

#include "common/text/text.h"
#include "processes/model_monitor/adaptation.h"
#include "processes/model_monitor/baseline/chapter_adaptation.h"
#include "tests/experiments/figures/experiment.h"
#include "tests/experiments/figures/robots.h"
#include "tests/experiments/figures/statistics.h"
#include "tests/support/broken_arm.h"

namespace bodyschema::experiments {
namespace {

using test::adaptation_options;
using test::BrokenArm;
using test::Fault;
using test::Regime;
using test::thread_seconds;
using Kind = AdaptationEvent::Kind;

constexpr double kVisible = 0.85;
constexpr int kBins = 60;
constexpr double kBinNats = 0.25;

/// One healthy life.
struct Watch {
  int num_alarms = 0;  ///< events of any kind, a request for a probe beside its candidate apart
  std::map<std::string, int> kinds;
  std::vector<int> above = std::vector<int>(kBins, 0);  ///< samples with a statistic ≥ n · kBinNats
  double seconds_first = 0, seconds_last = 0, seconds = 0;  ///< first and last quarter; all
};

Watch watch(Regime regime, double noise_factor, int num_samples, int seed) {
  BrokenArm arm({Fault::kNone, "healthy", kVisible}, regime, num_samples / BrokenArm::kNumBlocks,
                seed);
  Adaptation adaptation(arm.engineered(), adaptation_options(regime, noise_factor));
  Watch result;
  for (int t = 0; t < num_samples; ++t) {
    const ActionPoseSample sample = arm.observe(t);
    const double start = thread_seconds();
    const auto events = adaptation.on_sample(sample);
    const double seconds = thread_seconds() - start;
    result.seconds += seconds;
    if (t < num_samples / 4) result.seconds_first += seconds;
    if (t >= num_samples - num_samples / 4) result.seconds_last += seconds;
    for (const AdaptationEvent& event : events) {
      ++result.kinds[name_of(event.kind)];
      result.num_alarms += event.kind != Kind::kProbeWanted;
    }
    double highest = 0;
    for (const int part : adaptation.schema().parts)
      highest =
          std::max({highest, adaptation.edge_statistic(part), adaptation.marker_statistic(part)});
    for (int bin = 0; bin < kBins && highest >= bin * kBinNats; ++bin)
      ++result.above[static_cast<std::size_t>(bin)];
  }
  return result;
}

/// Share of the samples of a healthy body after which the chapter's procedure has no valid tree.
double baseline_share(Regime regime, int num_samples, int seed) {
  BrokenArm arm({Fault::kNone, "healthy", kVisible}, regime, num_samples / BrokenArm::kNumBlocks,
                seed);
  const BaselineOptions noise = baseline_options(regime);
  ChapterAdaptationOptions options;
  options.sigma_position_m = noise.sigma_position_m;
  options.sigma_rotation_rad = noise.sigma_rotation_rad;
  options.wait = num_samples;  // its test alone
  ChapterAdaptation adaptation(arm.engineered(), options, {});
  int invalid = 0;
  for (int t = 0; t < num_samples; ++t) {
    adaptation.on_sample(arm.observe(t));
    invalid += !adaptation.has_valid_tree();
  }
  return static_cast<double>(invalid) / num_samples;
}

Watch sum_of(const std::vector<Watch>& watches) {
  Watch all;
  for (const Watch& w : watches) {
    all.num_alarms += w.num_alarms;
    for (const auto& [kind, count] : w.kinds) all.kinds[kind] += count;
    for (std::size_t b = 0; b < w.above.size(); ++b) all.above[b] += w.above[b];
    all.seconds_first += w.seconds_first;
    all.seconds_last += w.seconds_last;
    all.seconds += w.seconds;
  }
  return all;
}

/// Shares of `total` samples.
Curve curve_of(const Watch& all, const std::string& name, int colour, int total) {
  Curve curve{.title = name, .colour = colour};
  for (int b = 0; b < kBins; ++b) {
    if (all.above[static_cast<std::size_t>(b)] == 0) break;
    curve.x.push_back(b * kBinNats);
    curve.y.push_back(static_cast<double>(all.above[static_cast<std::size_t>(b)]) / total);
  }
  return curve;
}

}  // namespace

Findings false_alarms(const Setup& setup) {
  struct Case {
    Regime regime;
    double noise_factor;
    int most;  ///< in 100 000
  };
  const std::vector<Case> cases = {{Regime::kChapter, 1, 3},
                                   {Regime::kTag, 1, 3},
                                   {Regime::kTagIso, 1, 3},
                                   {Regime::kTagIso, 0.5, 10},
                                   {Regime::kTagIso, 2, 10}};
  const int num_robots = setup.robots(20, 2), num_samples = setup.robots(5000, 200);
  Findings findings;
  Table table({"noise", "assumed, of the true one", "samples", "chapter",
               "baseline: samples without a valid tree %", "ours: false alarms", "of them",
               "in 100 000, at most (97.5 %)", "ms a sample, first / last quarter"});
  Panel panel{.title = "how high the highest statistic of a healthy body stands",
              .x_label = "nats",
              .y_label = "share of the samples above",
              .log_y = true,
              .y_range = {1e-6, 1}};
  int colour = 0;
  for (const Case& c : cases) {
    const std::string noise = test::name_of(c.regime);
    const std::string name = fmt::format("{}, noise × {:g}", noise, c.noise_factor);
    std::vector<Watch> watches(static_cast<std::size_t>(num_robots));
    for_each_robot(setup, name, num_robots, [&](int n) {
      watches[static_cast<std::size_t>(n)] = watch(c.regime, c.noise_factor, num_samples, 1000 + n);
    });
    const double theirs = 100 * baseline_share(c.regime, std::min(num_samples, 2000), 1000);
    const Watch all = sum_of(watches);
    const int total = num_robots * num_samples;
    const std::string kinds = listed(
        all.kinds, [](const auto& kind) { return fmt::format("{} {}", kind.second, kind.first); });
    table.add({noise, fmt::format("{:g}", c.noise_factor), std::to_string(total), "–",
               short_number(theirs), std::to_string(all.num_alarms), kinds.empty() ? "–" : kinds,
               short_number(1e5 * wilson_upper_bound(std::min(all.num_alarms, total), total)),
               fmt::format("{:.2f} / {:.2f}", 4e3 * all.seconds_first / total,
                           4e3 * all.seconds_last / total)});
    findings.musts.push_back({fmt::format("{}: ≤ {} false alarms in 100 000 samples", name, c.most),
                              fmt::format("{} in {}", all.num_alarms, total),
                              1e5 * all.num_alarms <= static_cast<double>(c.most) * total});
    if (!setup.quick) {
      const double ratio = all.seconds_last / all.seconds_first;
      findings.musts.push_back(
          {name + ": the time of a sample does not grow, and is below 5 ms",
           fmt::format("{:.2f} ms, last quarter / first {:.2f}", 1e3 * all.seconds / total, ratio),
           ratio < 1.3 && all.seconds / total < 0.005});
    }
    panel.curves.push_back(curve_of(all, name, colour++, total));
  }
  draw(setup, "false_alarms.png", {panel}, 1);
  findings.markdown = fmt::format(
      "{} healthy arms of seven parts, {} samples each, every marker seen in {:.0f} % of them. A "
      "false alarm is any event, a request for a probe apart. Baseline: the chapter's test of one "
      "arm's engineered model, nothing replaced.\n\n{}",
      num_robots, num_samples, 100 * kVisible, table.markdown());
  return findings;
}

}  // namespace bodyschema::experiments
