// Beyond the chapter: random trees with branches, prismatic and helical joints, gains of either
// sign, a signal on two joints, one that moves nothing, hidden parts.

#include <fmt/format.h>

#include <algorithm>
#include <ctime>

#include "tests/experiments/figures/experiment.h"
#include "tests/experiments/figures/robots.h"
#include "tests/experiments/figures/statistics.h"

namespace bodyschema::experiments {
namespace {

using test::Regime;

double thread_seconds() {
  timespec time{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &time);
  return static_cast<double>(time.tv_sec) + 1e-9 * static_cast<double>(time.tv_nsec);
}

struct Line {
  const char* kind;
  Regime regime;
  std::vector<int> sizes, quick_sizes;
  int robots, quick_robots, baseline_robots;
};

const Line kLines[] = {
    {"tree", Regime::kFree, {5, 10, 20}, {10}, 200, 5, 4},
    {"tree", Regime::kChapter, {10, 15, 20, 25}, {25}, 200, 4, 4},
    {"tree", Regime::kTag, {10, 15, 20, 25}, {25}, 200, 4, 4},
    {"tree3", Regime::kFree, {15, 30}, {20}, 200, 4, 0},
    {"tree3", Regime::kChapter, {15, 30}, {30}, 200, 2, 0},
    {"tree3", Regime::kTag, {15, 30}, {30}, 200, 3, 0},
    {"tree40", Regime::kFree, {25}, {25}, 50, 1, 0},
    {"tree40", Regime::kChapter, {25}, {25}, 50, 0, 0},
    {"tree40", Regime::kTag, {25}, {25}, 50, 1, 0},
};
constexpr int kBaselineSize = 20;

struct Answer {
  test::Rightness rightness{};
  int fits = 0;
  double seconds = 0;
};

/// Ours at each size of each robot.
std::vector<std::vector<Answer>> ask_ours(const Setup& setup, const Line& line,
                                          const std::vector<int>& sizes, int num_robots) {
  std::vector<std::vector<Answer>> answers(sizes.size(), std::vector<Answer>(num_robots));
  for_each_robot(setup, fmt::format("{}, {}", line.kind, test::name_of(line.regime)), num_robots,
                 [&](int n) {
                   const Trial trial = make_trial(line.kind, line.regime, sizes.back(), n + 1);
                   for (std::size_t s = 0; s < sizes.size(); ++s) {
                     const double start = thread_seconds();
                     const LearnResult result = learn(trial.robot.signals, trial.first(sizes[s]));
                     answers[s][n] = {test::judge(result.schema, trial.robot), result.num_fits,
                                      thread_seconds() - start};
                   }
                 });
  return answers;
}

Judgements ask_baseline(const Setup& setup, const Line& line) {
  const int num_robots = setup.robots(line.baseline_robots, 0);
  std::vector<test::Rightness> found(num_robots);
  for_each_robot(setup, fmt::format("baseline, {}, {}", line.kind, test::name_of(line.regime)),
                 num_robots, [&](int n) {
                   const Trial trial = make_trial(line.kind, line.regime, kBaselineSize, n + 1);
                   found[n] = test::judge(learn_baseline(trial.robot.signals, trial.samples,
                                                         baseline_options(line.regime))
                                              .schema,
                                          trial.robot);
                 });
  Judgements judgements;
  for (const test::Rightness r : found) judgements.add(r);
  return judgements;
}

/// Of all robots of a line at one N; `seconds`: mean.
void add_musts(const Setup& setup, const Line& line, int N, const Judgements& judgements,
               int num_robots, double seconds, Findings* findings) {
  const std::string name = test::name_of(line.regime), kind = line.kind;
  const auto must_be_right = [&](double share) {
    findings->musts.push_back(
        {fmt::format("random trees, {}, N = {}: structure right ≥ {:.0f} %", name, N, 100 * share),
         judgements.text(),
         share == 1 ? judgements.right == num_robots
                    : wilson_lower_bound(judgements.right, num_robots) >= share});
  };
  const bool is_tree = kind == "tree";
  if (is_tree && line.regime == Regime::kFree && N == 10) must_be_right(1);
  if (setup.quick) return;
  if (is_tree && line.regime == Regime::kChapter && N == 20) must_be_right(0.97);
  if (is_tree && line.regime == Regime::kTag && N == 20) must_be_right(0.93);
  if (is_tree && line.regime == Regime::kTag && N == 25) must_be_right(0.97);
  if (kind == "tree3")
    findings->musts.push_back(
        {fmt::format("two hidden parts in a row, {}, N = {}: never wrong", name, N),
         judgements.text(), judgements.wrong == 0});
  if (kind == "tree40" && N == 25) {
    findings->musts.push_back(
        {fmt::format("40 parts, 30 signals, 3 hidden, {}, N = {}: right ≥ 90 %, else incomplete",
                     name, N),
         judgements.text(), judgements.right >= 0.9 * num_robots && judgements.wrong == 0});
    findings->musts.push_back({fmt::format("40 parts, {}, N = {}: < 1 s on one core", name, N),
                               short_number(seconds) + " s", seconds < 1});
  }
}

/// Adds a row for each N. Shares of right structures, or of wrong ones of tree3.
Curve curve_of(const Setup& setup, const Line& line, int num_robots, Table* table,
               Findings* findings) {
  const std::vector<int>& sizes = setup.quick ? line.quick_sizes : line.sizes;
  const std::string name = test::name_of(line.regime);
  const auto answers = ask_ours(setup, line, sizes, num_robots);
  const Judgements baseline = ask_baseline(setup, line);
  Curve curve{.title = "ours, " + name,
              .colour = line.regime == Regime::kFree      ? 1
                        : line.regime == Regime::kChapter ? 2
                                                          : 3};
  for (std::size_t s = 0; s < sizes.size(); ++s) {
    const int N = sizes[s];
    Judgements judgements;
    long fits = 0;
    double seconds = 0, largest = 0;
    for (const Answer& a : answers[s]) {
      judgements.add(a.rightness);
      fits += a.fits;
      seconds += a.seconds / num_robots;
      largest = std::max(largest, a.seconds);
    }
    table->add({line.kind, name, std::to_string(N), std::to_string(num_robots), "–",
                (N == kBaselineSize ? baseline : Judgements{}).text(), judgements.text(),
                std::to_string(fits / num_robots),
                fmt::format("{} ({})", short_number(seconds), short_number(largest))});
    curve.x.push_back(N);
    const bool is_tree3 = line.kind == std::string("tree3");
    curve.y.push_back(100.0 * (is_tree3 ? judgements.wrong : judgements.right) / num_robots);
    add_musts(setup, line, N, judgements, num_robots, seconds, findings);
  }
  return curve;
}

}  // namespace

Findings trees(const Setup& setup) {
  Findings findings;
  Table table({"robot", "regime", "N", "robots", "chapter", "baseline: structure right %",
               "ours: structure right %", "fits", "CPU s (largest)"});
  Panel trees_panel{.title = "random trees",
                    .x_label = "samples N",
                    .y_label = "structure right [% of robots]",
                    .y_range = {-5, 105},
                    .shift = 0.01};
  Panel hidden_panel = trees_panel;
  hidden_panel.title = "two hidden parts in a row: wrong (k = 3: incomplete is the best answer)";
  hidden_panel.y_label = "structure wrong [% of robots]";
  hidden_panel.y_range = {-5, 105};
  for (const Line& line : kLines) {
    const int num_robots = setup.robots(line.robots, line.quick_robots);
    if (num_robots == 0) continue;
    const Curve curve = curve_of(setup, line, num_robots, &table, &findings);
    if (line.kind == std::string("tree")) trees_panel.curves.push_back(curve);
    if (line.kind == std::string("tree3")) hidden_panel.curves.push_back(curve);
  }
  draw(setup, "trees.png", {trees_panel, hidden_panel}, 2);
  findings.markdown = fmt::format(
      "tree: 9 parts, one hidden; tree3: two hidden in a row; tree40: 40 parts, 3 hidden. "
      "Structure: "
      "right with its Wilson lower bound (95 %) / incomplete / wrong. The baseline is asked once, "
      "at N "
      "= {}, of 4 robots; of 40 parts it would learn some 600 000 local models.\n\n{}",
      kBaselineSize, table.markdown());
  return findings;
}

}  // namespace bodyschema::experiments
