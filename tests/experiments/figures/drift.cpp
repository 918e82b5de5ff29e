// Beyond the chapter: a link that bends continuously, slowly or fast, and then stops.

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <optional>

#include "processes/model_monitor/adaptation.h"
#include "processes/model_monitor/baseline/chapter_adaptation.h"
#include "processes/structure_learner/baseline/fit_matrix_gp.h"
#include "tests/experiments/figures/experiment.h"
#include "tests/experiments/figures/robots.h"
#include "tests/experiments/figures/statistics.h"
#include "tests/support/broken_arm.h"

namespace bodyschema::experiments {
namespace {

using test::BrokenArm;
using test::Fault;
using test::Regime;
using test::Scenario;
using Kind = AdaptationEvent::Kind;

constexpr int kHealthy = 60, kAfter = 60;
/// Samples after its end from which an edge is to have settled.
constexpr int kSettled = 20;
constexpr double kMost_deg = 25;
constexpr int kPart = 4;  // where the edge that drifts leads
/// From this rate on it must be named a drift; a slower one is below the noise for long.
constexpr double kFast_deg = 0.1;
constexpr double kMillimetre = 1e-3;

Scenario scenario_of(double rate_deg) {
  return {Fault::kDrift, "drift", 0.85, rate_deg, kMost_deg};
}

int length_of(double rate_deg) { return static_cast<int>(std::ceil(kMost_deg / rate_deg)); }

struct Life {
  std::vector<double> error;           ///< of the end effector, by sample [m]
  std::optional<double> named, ended;  ///< reported so many samples after its begin, its end
  int num_too_early = 0;               ///< reported as ended before its end, and so begun again
  bool is_wrong = false;               ///< an event elsewhere, or before it
  bool is_invalid = false;             ///< an edge or a marker, at some sample
  double seconds = 0;

  double worst(int begin, int end) const {
    return *std::max_element(error.begin() + begin, error.begin() + end);
  }
};

Life live(double rate_deg, int seed) {
  BrokenArm arm(scenario_of(rate_deg), Regime::kTagIso, kHealthy, seed);
  Adaptation adaptation(arm.engineered(), test::adaptation_options(Regime::kTagIso));
  Life life;
  const int end = kHealthy + length_of(rate_deg);
  for (int t = 0; t < end + kAfter; ++t) {
    const ActionPoseSample sample = arm.observe(t);
    const double start = test::thread_seconds();
    const auto events = adaptation.on_sample(sample);
    life.seconds += test::thread_seconds() - start;
    life.error.push_back(arm.error(adaptation.schema(), t));
    for (const AdaptationEvent& event : events) {
      const int part = event.part >= 0 ? event.part : event.to;
      const bool is_drift = event.kind == Kind::kDrift;
      life.is_wrong |= t < kHealthy || !arm.is_near(part) || (is_drift && part != kPart);
      if (is_drift && part == kPart && !life.named && t < end) life.named = t - kHealthy;
      if (event.kind != Kind::kRecovered || event.cause != "drift") continue;
      life.num_too_early += t < end;
      if (t >= end && !life.ended) life.ended = t - end;
    }
    for (const int part : adaptation.schema().parts)
      life.is_invalid |= adaptation.edge_state(part) == EdgeState::kInvalid ||
                         adaptation.marker_state(part) == EdgeState::kInvalid;
  }
  return life;
}

/// Errors by the chapter's procedure.
std::vector<double> live_as_the_chapter(double rate_deg, int seed) {
  BrokenArm arm(scenario_of(rate_deg), Regime::kTagIso, kHealthy, seed);
  const BaselineOptions noise = baseline_options(Regime::kTagIso);
  ChapterAdaptationOptions options;
  options.sigma_position_m = noise.sigma_position_m;
  options.sigma_rotation_rad = noise.sigma_rotation_rad;
  ChapterAdaptation adaptation(arm.engineered(), options, fit_matrix_gp_edge);
  std::vector<double> error;
  for (int t = 0; t < kHealthy + length_of(rate_deg) + kAfter; ++t) {
    adaptation.on_sample(arm.observe(t));
    error.push_back(arm.error(adaptation.schema(), t));
  }
  return error;
}

double quantile(std::vector<double> values, double share) {
  std::sort(values.begin(), values.end());
  const double last = static_cast<double>(values.size() - 1);
  return values[static_cast<std::size_t>(std::lround(share * last))];
}

/// "11 (15, 18)": median, 90 %, worst.
std::string three(const std::vector<double>& values, double unit = 1) {
  if (values.empty()) return "–";
  return fmt::format("{:.3g} ({:.3g}, {:.3g})", quantile(values, 0.5) / unit,
                     quantile(values, 0.9) / unit, quantile(values, 1) / unit);
}

Curve curve_of(const std::string& title, const std::vector<double>& error, int colour,
               bool is_dashed = false) {
  Curve curve{.title = title, .colour = colour, .is_dashed = is_dashed};
  for (std::size_t t = 0; t < error.size(); ++t) {
    curve.x.push_back(static_cast<double>(t) - kHealthy);
    curve.y.push_back(std::max(error[t] / kMillimetre, 0.1));
  }
  return curve;
}

/// Lives in which the drift was named, and nothing else.
int num_named_alone(const std::vector<Life>& lives) {
  return static_cast<int>(
      std::ranges::count_if(lives, [](const Life& l) { return l.named && !l.is_wrong; }));
}

/// Of all lives at one rate; `theirs`: errors of the baseline.
void add_row(double rate, const std::vector<Life>& lives,
             const std::vector<std::vector<double>>& theirs, Table* table) {
  const int num_runs = static_cast<int>(lives.size()), end = kHealthy + length_of(rate);
  int num_wrong = 0, num_invalid = 0, num_early_runs = 0, num_early = 0;
  double seconds = 0;
  std::vector<double> until, before, during, worst, after, ended, their_worst;
  for (const Life& life : lives) {
    num_wrong += life.is_wrong;
    num_invalid += life.is_invalid;
    num_early_runs += life.num_too_early > 0;
    num_early += life.num_too_early;
    seconds += life.seconds;
    if (life.named) until.push_back(*life.named);
    if (life.ended) ended.push_back(*life.ended);
    before.push_back(life.error[kHealthy - 1]);
    during.push_back(quantile({life.error.begin() + kHealthy, life.error.begin() + end}, 0.5));
    worst.push_back(life.worst(kHealthy, end));
    after.push_back(life.worst(end + kSettled, end + kAfter));
  }
  for (const std::vector<double>& error : theirs)
    their_worst.push_back(*std::max_element(error.begin() + kHealthy, error.begin() + end));
  table->add({fmt::format("{:g}", rate), "–", std::to_string(num_runs),
              percentage(num_named_alone(lives), num_runs), three(until), std::to_string(num_wrong),
              std::to_string(num_invalid), three(before, kMillimetre), three(during, kMillimetre),
              three(worst, kMillimetre), three(after, kMillimetre), three(ended),
              percentage(static_cast<int>(ended.size()), num_runs),
              fmt::format("{}, {}", num_early_runs, num_early), three(their_worst, kMillimetre),
              fmt::format("{:.2f}", 1e3 * seconds / (num_runs * (end + kAfter)))});
}

}  // namespace

Findings drift(const Setup& setup) {
  Findings findings;
  Table table({"° a sample", "chapter", "runs", "named, and nothing else", "samples until named",
               "runs with a wrong event", "with an invalid edge", "error before, mm",
               "while it drifts: median of a run", "worst of a run",
               fmt::format("from {} samples after its end on", kSettled),
               "samples until its end is told", "of all runs", "told as ended before: runs, times",
               "baseline: worst of a run", "ms a sample"});
  std::vector<Panel> panels;
  const std::vector<double> rates = setup.quick ? std::vector<double>{0.1, 0.5, 1}
                                                : std::vector<double>{0.02, 0.05, 0.1, 0.2, 0.5, 1};
  for (const double rate : rates) {
    const bool is_fast = rate >= kFast_deg;
    const int num_runs = setup.robots(is_fast ? 200 : 50, 3);
    std::vector<Life> lives(static_cast<std::size_t>(num_runs));
    for_each_robot(setup, fmt::format("{:g}° a sample", rate), num_runs,
                   [&](int n) { lives[static_cast<std::size_t>(n)] = live(rate, n + 1); });
    // It learns model upon model: minutes for a slow one.
    const int num_theirs = rate >= 0.2 ? setup.robots(2, 0) : 0;
    std::vector<std::vector<double>> theirs(static_cast<std::size_t>(num_theirs));
    for_each_robot(setup, fmt::format("{:g}° a sample, baseline", rate), num_theirs, [&](int n) {
      theirs[static_cast<std::size_t>(n)] = live_as_the_chapter(rate, n + 1);
    });
    add_row(rate, lives, theirs, &table);
    if (is_fast)
      findings.musts.push_back(
          {fmt::format("{:g}° a sample: named a drift of its edge, and nothing else, ≥ 95 %", rate),
           percentage(num_named_alone(lives), num_runs),
           num_named_alone(lives) >= 0.95 * num_runs});
    Panel panel{.title = fmt::format("{:g}° a sample, run 1", rate),
                .x_label = "samples since its begin",
                .y_label = "mean error of the end effector [mm]",
                .log_y = true,
                .y_range = {1, 500}};
    if (!theirs.empty()) panel.curves.push_back(curve_of("baseline", theirs[0], 4, true));
    panel.curves.push_back(curve_of("ours", lives[0].error, 1));
    panels.push_back(std::move(panel));
  }
  draw(setup, "drift.png", panels, 2);
  findings.markdown = fmt::format(
      "A link in the middle of the arm of Table 1 bends by so much a sample, from sample {} on, "
      "until it is bent by {:g}°; tag_iso, 85 % of the markers seen, {} samples more. The chapter "
      "has no such change. *Named*: a drift, of this edge, while it lasts; *nothing else*: no "
      "event of another edge than this and those beside it, and no drift of another one. A first "
      "guess, as a step of this edge, is taken back. *Invalid*: an edge that is found wrong and "
      "nothing is accepted in its place, at one sample at least. Errors of the end effector by the "
      "noise-free truth; three numbers are median, 90 % and worst of the runs.\n\n{}",
      kHealthy, kMost_deg, kAfter, table.markdown());
  return findings;
}

}  // namespace bodyschema::experiments
