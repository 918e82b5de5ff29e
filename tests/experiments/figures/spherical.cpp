// Fig. 6: two parts on a spherical joint. While q2 rests, q1 alone explains everything; once it
// moves too, only both together do.

#include <fmt/format.h>

#include <algorithm>
#include <set>

#include "tests/experiments/figures/experiment.h"
#include "tests/experiments/figures/robots.h"
#include "tests/experiments/figures/statistics.h"

namespace bodyschema::experiments {
namespace {

using test::Regime;

constexpr int kResting = 15;  ///< samples while q2 = 0

/// Signals that move part 2 against part 1 by a schema.
enum class Said { kOne, kBoth, kNothing, kOther };

Said said_by(const BodySchema& schema) {
  if (schema.edges.empty()) return Said::kNothing;
  const std::vector<int> signals = schema.edges.front().signals();
  const std::set<int> set(signals.begin(), signals.end());
  if (set == std::set<int>{0}) return Said::kOne;
  if (set == std::set<int>{0, 1}) return Said::kBoth;
  return Said::kOther;
}

Trial spherical_trial(Regime regime, int num_samples, int seed) {
  Trial trial = make_trial("b", regime, 0, seed);
  test::Rng rng(static_cast<test::Rng::result_type>(seed) + 1'000'000);
  test::ObservationOptions observation;
  observation.regime = regime;
  observation.with_covariances = true;
  for (int t = 0; t < num_samples; ++t) {
    Eigen::VectorXd action = trial.robot.random_action(rng);
    if (t < kResting) action(1) = 0;
    trial.samples.push_back(test::observe(trial.robot, action, observation, t, rng));
  }
  return trial;
}

std::string shares(const std::vector<Said>& all) {
  const auto share = [&](Said what) {
    return short_number(100.0 * static_cast<double>(std::count(all.begin(), all.end(), what)) /
                        static_cast<double>(all.size()));
  };
  return fmt::format("{} / {} / {} / {}", share(Said::kOne), share(Said::kBoth),
                     share(Said::kNothing), share(Said::kOther));
}

using Answers = std::vector<std::vector<Said>>;  ///< by size, by robot

Panel panel_of(const std::string& name, const std::vector<int>& sizes, const Answers& baseline,
               const Answers& ours) {
  Panel panel{
      .title = "Fig. 6, " + name + fmt::format(": q2 moves from sample {} on", kResting + 1),
      .x_label = "samples N",
      .y_label = "robots [%]",
      .references = {{"chapter: {q1}, then both", 100}},
      .y_range = {-5, 105},
      .shift = 0.008};
  for (const auto* side : {&baseline, &ours}) {
    for (const Said what : {Said::kOne, Said::kBoth}) {
      Curve curve{.title = std::string(side == &ours ? "ours" : "baseline") +
                           (what == Said::kOne ? " {q1}" : " {q1, q2}"),
                  .colour = what == Said::kOne ? 2 : 1};
      curve.is_dashed = side == &baseline;
      for (std::size_t s = 0; s < sizes.size(); ++s) {
        const auto& all = (*side)[s];
        curve.x.push_back(sizes[s]);
        curve.y.push_back(100.0 * static_cast<double>(std::count(all.begin(), all.end(), what)) /
                          static_cast<double>(all.size()));
      }
      panel.curves.push_back(std::move(curve));
    }
  }
  return panel;
}

}  // namespace

Findings spherical(const Setup& setup) {
  const std::vector<int> sizes =
      setup.quick ? std::vector<int>{8, 15, 45}
                  : std::vector<int>{5, 8, 10, 12, 15, 16, 17, 18, 20, 22, 25, 30, 35, 45};
  const int num_robots = setup.robots(200, 10), num_baseline = setup.robots(40, 3);
  Findings findings;
  Table table({"regime", "N", "chapter", "baseline: {q1} / {q1, q2} / nothing valid / other %",
               "ours: {q1} / {q1, q2} / nothing valid / other %"});
  std::vector<Panel> panels;
  for (const Regime regime : {Regime::kFree, Regime::kChapter, Regime::kTag}) {
    const std::string name = test::name_of(regime);
    Answers ours(sizes.size(), std::vector<Said>(num_robots)),
        baseline(sizes.size(), std::vector<Said>(num_baseline));
    for_each_robot(setup, "ours, " + name, num_robots, [&](int n) {
      const Trial trial = spherical_trial(regime, sizes.back(), n + 1);
      for (std::size_t s = 0; s < sizes.size(); ++s)
        ours[s][n] = said_by(learn(trial.robot.signals, trial.first(sizes[s])).schema);
    });
    for_each_robot(setup, "baseline, " + name, num_baseline, [&](int n) {
      const Trial trial = spherical_trial(regime, sizes.back(), n + 1);
      for (std::size_t s = 0; s < sizes.size(); ++s)
        baseline[s][n] = said_by(
            learn_baseline(trial.robot.signals, trial.first(sizes[s]), baseline_options(regime))
                .schema);
    });
    panels.push_back(panel_of(name, sizes, baseline, ours));
    for (std::size_t s = 0; s < sizes.size(); ++s) {
      const int N = sizes[s];
      table.add({name, std::to_string(N), N <= kResting ? "{q1}" : "{q1, q2} in the end",
                 shares(baseline[s]), shares(ours[s])});
      if (regime != Regime::kFree) continue;
      const Said expected = N <= kResting ? Said::kOne : Said::kBoth;
      if (N != kResting && N != sizes.back()) continue;
      const auto right = std::count(ours[s].begin(), ours[s].end(), expected);
      findings.musts.push_back({fmt::format("spherical, free, N = {}: {} in all robots", N,
                                            expected == Said::kOne ? "{q1}" : "{q1, q2}"),
                                fmt::format("{} of {}", right, num_robots), right == num_robots});
    }
  }
  draw(setup, "spherical.png", panels, 3);
  findings.markdown = fmt::format("{} robots (baseline {}); q2 = 0 for the first {} samples.\n\n{}",
                                  num_robots, num_baseline, kResting, table.markdown());
  return findings;
}

}  // namespace bodyschema::experiments
