// Figs. 7, 8 and 11: structure and accuracy of the chapter's robots against the number of samples.

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "common/geometry/angle.h"
#include "tests/experiments/figures/experiment.h"
#include "tests/experiments/figures/robots.h"
#include "tests/experiments/figures/statistics.h"

namespace bodyschema::experiments {
namespace {

using test::Regime;

constexpr double kMillimetre = 1e-3;

/// One learning method at one N, over all robots.
struct Cell {
  Judgements structure;
  int false_complete = 0;  ///< wrong, but called complete
  long fits = 0;
  std::vector<double> position_m, angle_rad;

  int num_robots = 0;

  void add(const std::optional<PoseErrors>& errors) {
    ++num_robots;
    if (!errors) return;
    position_m.push_back(errors->position_mean_m);
    angle_rad.push_back(errors->rotation_mean_rad);
  }
  std::string errors_text() const {
    if (position_m.empty()) return "–";
    const std::string of = num_robots > static_cast<int>(position_m.size())
                               ? fmt::format(" ({} of {} robots)", position_m.size(), num_robots)
                               : "";
    return mean_and_error(spread_of(position_m), kMillimetre) + " mm, " +
           mean_and_error(spread_of(angle_rad), kDegree) + "°" + of;
  }
};

/// Result of one robot.
struct Answer {
  test::Rightness rightness = test::Rightness::kIncomplete;
  bool is_complete = false;
  int fits = 0;
  std::optional<PoseErrors> errors;
  std::string structure;
};

/// A curve of learning: sizes × robots.
struct Measurement {
  std::vector<int> sizes;
  std::vector<std::vector<Answer>> answers;  ///< by size, by robot

  Cell cell(int N) const {
    Cell result;
    const auto at = std::find(sizes.begin(), sizes.end(), N);
    if (at == sizes.end()) return result;
    for (const Answer& a : answers[at - sizes.begin()]) {
      result.structure.add(a.rightness);
      result.false_complete += a.is_complete && a.rightness == test::Rightness::kWrong;
      result.fits += a.fits;
      result.add(a.errors);
    }
    return result;
  }
};

using Learner = std::function<Answer(const Trial&, const std::vector<ActionPoseSample>&)>;

Answer answer_of(const BodySchema& schema, int fits, const Trial& trial) {
  return {test::judge(schema, trial.robot), schema.complete, fits,
          end_effector_errors(schema, trial), structure_of(schema)};
}

Answer ask_ours(const Trial& trial, const std::vector<ActionPoseSample>& samples) {
  const LearnResult result = learn(trial.robot.signals, samples);
  return answer_of(result.schema, result.num_fits, trial);
}

/// The chapter's search; its errors are those of its local models on the true structure.
Answer ask_baseline(const Trial& trial, const std::vector<ActionPoseSample>& samples) {
  const BaselineResult result =
      learn_baseline(trial.robot.signals, samples, baseline_options(trial.regime));
  Answer answer = answer_of(result.schema, result.num_fits, trial);
  answer.errors = end_effector_errors(baseline_on_true_structure(trial, samples), trial);
  return answer;
}

/// Its local models on the true structure alone.
Answer ask_baseline_models(const Trial& trial, const std::vector<ActionPoseSample>& samples) {
  Answer answer;
  answer.errors = end_effector_errors(baseline_on_true_structure(trial, samples), trial);
  return answer;
}

Measurement measure(const Setup& setup, const std::string& what, const std::string& robot,
                    Regime regime, const std::vector<int>& sizes, int num_robots,
                    const Learner& learner) {
  Measurement result;
  result.sizes = sizes;
  result.answers.assign(sizes.size(), std::vector<Answer>(num_robots));
  for_each_robot(setup, what + ", " + test::name_of(regime), num_robots, [&](int n) {
    const Trial trial = make_trial(robot, regime, sizes.back(), n + 1);
    for (std::size_t s = 0; s < sizes.size(); ++s)
      result.answers[s][n] = learner(trial, trial.first(sizes[s]));
  });
  return result;
}

/// Share of right structures.
Curve right_curve(const Measurement& m, const std::string& title, int colour) {
  Curve curve{.title = title, .colour = colour};
  for (const int N : m.sizes) {
    const Judgements j = m.cell(N).structure;
    curve.x.push_back(N);
    curve.y.push_back(100.0 * j.right / j.total());
  }
  return curve;
}

Curve position_curve(const Measurement& m, const std::string& title, int colour) {
  Curve curve{.title = title, .colour = colour};
  for (const int N : m.sizes) {
    const Spread spread = spread_of(m.cell(N).position_m);
    curve.x.push_back(N);
    curve.y.push_back(spread.mean / kMillimetre);
    curve.error.push_back(spread.standard_error() / kMillimetre);
  }
  return curve;
}

Curve angle_curve(const Measurement& m, const std::string& title, int colour) {
  Curve curve{.title = title, .colour = colour};
  for (const int N : m.sizes) {
    const Spread spread = spread_of(m.cell(N).angle_rad);
    curve.x.push_back(N);
    curve.y.push_back(spread.mean / kDegree);
    curve.error.push_back(spread.standard_error() / kDegree);
  }
  return curve;
}

void add(Panel* panel, Curve curve, bool is_dashed = false) {
  curve.is_dashed = is_dashed;
  panel->curves.push_back(std::move(curve));
}

constexpr Regime kRegimes[] = {Regime::kFree, Regime::kChapter, Regime::kTag, Regime::kTagIso};

/// Figs. 7 and 8: robot c, or co.
Findings four_dof(const Setup& setup, const std::string& robot, const std::string& chapter,
                  const std::string& file, const std::string& title) {
  const std::vector<int> sizes =
      setup.quick ? std::vector<int>{10, 30} : std::vector<int>{5, 8, 10, 15, 20, 30};
  const int num_robots = setup.robots(200, 5), num_baseline = setup.robots(20, 1);
  Findings findings;
  Table table({"regime", "N", "chapter", "baseline: structure right %", "fits",
               "baseline on the true structure", "ours: structure right %", "fits", "ours"});
  Panel structure{.title = title + ": structure",
                  .x_label = "samples N",
                  .y_label = "structure right [% of robots]",
                  .references = {{"chapter: found", 100}},
                  .log_x = true,
                  .y_range = {-5, 105},
                  .shift = 0.007};
  Panel accuracy{.title = title + ": accuracy; baseline on the true structure",
                 .x_label = "samples N",
                 .y_label = "mean position error of the end effector [mm]",
                 .log_x = true,
                 .log_y = true};
  std::string examples;
  int colour = 1;
  for (const Regime regime : {Regime::kFree, Regime::kChapter, Regime::kTag}) {
    const Measurement us = measure(setup, "ours", robot, regime, sizes, num_robots, ask_ours);
    const Measurement them =
        measure(setup, "baseline", robot, regime, sizes, num_baseline, ask_baseline);
    for (std::size_t s = 0; s < sizes.size(); ++s) {
      const int N = sizes[s];
      const Cell u = us.cell(N), t = them.cell(N);
      table.add({test::name_of(regime), std::to_string(N), s + 1 == sizes.size() ? chapter : "–",
                 t.structure.text(), std::to_string(t.fits / num_baseline), t.errors_text(),
                 u.structure.text(), std::to_string(u.fits / num_robots), u.errors_text()});
      if (regime == Regime::kFree && N >= 10)
        findings.musts.push_back({fmt::format("{}, free, N = {}: structure right", title, N),
                                  u.structure.text(), u.structure.right == num_robots});
    }
    examples +=
        fmt::format("- {}, seed 1, N = {}: ours {}; baseline {}\n", test::name_of(regime),
                    sizes.back(), us.answers.back()[0].structure, them.answers.back()[0].structure);
    const std::string name = test::name_of(regime);
    add(&structure, right_curve(us, "ours, " + name, colour));
    add(&structure, right_curve(them, "baseline, " + name, colour), true);
    add(&accuracy, position_curve(us, "ours, " + name, colour));
    add(&accuracy, position_curve(them, "baseline, " + name, colour), true);
    ++colour;
  }
  draw(setup, file, {structure, accuracy}, 2);
  findings.markdown = fmt::format(
      "{} robots (baseline {}). Structure: right with its Wilson lower bound (95 %) / incomplete / "
      "wrong; the local models learned until then (fits); mean error of the end effector over {} "
      "test "
      "poses, mean ± standard error over the robots (baseline: on the true structure, whatever it "
      "found).\n\n{}\n{}",
      num_robots, num_baseline, kTestPoses, table.markdown(), examples);
  return findings;
}

struct SevenDofPanels {
  Panel structure{.title = "Fig. 11: 7-DOF robot, 10 parts, x4 never seen: structure",
                  .x_label = "samples N",
                  .y_label = "structure right [% of robots]",
                  .references = {{"chapter: after 10, free", 100}},
                  .log_x = true,
                  .y_range = {-5, 105},
                  .shift = 0.007};
  Panel position{.title = "position, noise-free; baseline on the true structure",
                 .x_label = "samples N",
                 .y_label = "mean position error of the end effector [mm]",
                 .references = {{"chapter: 1 mm after 100", 1}},
                 .log_x = true,
                 .log_y = true};
  Panel noisy{.title = "position, in noise; baseline on the true structure",
              .x_label = position.x_label,
              .y_label = position.y_label,
              .log_x = true,
              .log_y = true};
  Panel angle{.title = "angle, in noise; baseline on the true structure",
              .x_label = "samples N",
              .y_label = "mean angle error of the end effector [°]",
              .log_x = true,
              .log_y = true};

  void add_curves(Regime regime, const Measurement& us, const Measurement& found,
                  const Measurement& models, int colour) {
    const std::string name = test::name_of(regime);
    add(&structure, right_curve(us, "ours, " + name, colour));
    add(&structure, right_curve(found, "baseline, " + name, colour), true);
    Panel* const of_position = regime == Regime::kFree ? &position : &noisy;
    add(of_position, position_curve(us, "ours, " + name, colour));
    add(of_position, position_curve(models, "baseline, " + name, colour), true);
    if (regime == Regime::kFree) return;
    add(&angle, angle_curve(us, "ours, " + name, colour));
    add(&angle, angle_curve(models, "baseline, " + name, colour), true);
  }
};

/// Of the 7-DOF robot.
void add_musts(const Setup& setup, Regime regime, int N, const Cell& u, Findings* findings) {
  const std::string name = test::name_of(regime);
  const Spread p = spread_of(u.position_m), a = spread_of(u.angle_rad);
  const auto must_be_right = [&](double share) {
    findings->musts.push_back(
        {fmt::format("7-DOF, {}, N = {}: structure right ≥ {:.0f} %", name, N, 100 * share),
         u.structure.text(),
         share == 1 ? u.structure.right == u.num_robots
                    : wilson_lower_bound(u.structure.right, u.num_robots) >= share});
  };
  const auto must_be_near = [&](double position_m, double angle_deg) {
    findings->musts.push_back(
        {angle_deg > 0 ? fmt::format("7-DOF, {}, N = {}: ≤ {:g} mm, {:g}°", name, N,
                                     position_m * 1e3, angle_deg)
                       : fmt::format("7-DOF, {}, N = {}: ≤ {:g} mm", name, N, position_m * 1e3),
         u.errors_text(),
         p.count > 0 && p.mean <= position_m && (angle_deg == 0 || a.mean <= angle_deg * kDegree)});
  };
  if (regime == Regime::kFree && N == 5) must_be_right(1);
  if (regime == Regime::kFree && N == 10) must_be_near(1e-9, 0);
  if (setup.quick) return;  // five robots prove no percentage
  if (regime == Regime::kChapter) {
    if (N == 15) must_be_right(0.97);
    if (N == 20) must_be_near(0.050, 0);
    if (N == 100) must_be_near(0.022, 0);
  }
  if (regime == Regime::kTag) {
    if (N == 15) must_be_right(0.93);
    if (N == 20) must_be_right(0.97);
    if (N == 20) must_be_near(0.004, 1.1);
    if (N == 100) must_be_near(0.0018, 0.5);
    if (N >= 20)
      findings->musts.push_back(
          {fmt::format("7-DOF, tag, N = {}: wrong but called complete ≤ 2 %", N),
           short_number(100.0 * u.false_complete / u.num_robots) + " %",
           u.false_complete <= 0.02 * u.num_robots});
  }
}

}  // namespace

Findings chain(const Setup& setup) {
  return four_dof(setup, "c", "found by layers 0 and 1", "chain.png", "Fig. 7, 4-DOF chain");
}

Findings occluded(const Setup& setup) {
  return four_dof(setup, "co", "2–4 {q2, q3}", "occluded.png", "Fig. 8, x3 never seen");
}

Findings seven_dof(const Setup& setup) {
  const std::vector<int> sizes =
      setup.quick ? std::vector<int>{5, 10, 20} : std::vector<int>{5, 10, 15, 20, 50, 100};
  const std::vector<int> search_sizes =
      setup.quick ? std::vector<int>{10} : std::vector<int>{5, 10, 20};
  const std::vector<int> model_sizes =
      setup.quick ? std::vector<int>{10, 20} : std::vector<int>{5, 10, 20, 50, 100};
  const int num_robots = setup.robots(200, 5), num_search = setup.robots(8, 1),
            num_models = setup.robots(20, 1);
  Findings findings;
  Table table({"regime", "N", "chapter", "baseline: structure right %", "fits",
               "baseline on the true structure", "ours: structure right %", "wrong but complete %",
               "fits", "ours"});
  SevenDofPanels panels;
  int colour = 1;
  for (const Regime regime : kRegimes) {
    const std::string name = test::name_of(regime);
    const Measurement us = measure(setup, "ours", "d", regime, sizes, num_robots, ask_ours);
    const Measurement found =
        measure(setup, "baseline, search", "d", regime, search_sizes, num_search, ask_baseline);
    const Measurement models = measure(setup, "baseline, local models", "d", regime, model_sizes,
                                       num_models, ask_baseline_models);
    for (const int N : sizes) {
      const Cell u = us.cell(N), f = found.cell(N), m = models.cell(N);
      table.add(
          {name, std::to_string(N),
           N == 10    ? "structure right (noise-free)"
           : N == 100 ? "< 1 mm (noise-free)"
                      : "–",
           f.structure.text(), f.structure.total() > 0 ? std::to_string(f.fits / num_search) : "–",
           m.errors_text(), u.structure.text(), short_number(100.0 * u.false_complete / num_robots),
           std::to_string(u.fits / num_robots), u.errors_text()});
      add_musts(setup, regime, N, u, &findings);
    }
    panels.add_curves(regime, us, found, models, colour);
    ++colour;
  }
  draw(setup, "seven_dof.png", {panels.structure, panels.position, panels.noisy, panels.angle}, 2);
  findings.markdown = fmt::format(
      "{} robots (baseline: search {}, local models on the true structure {}). Structure: right "
      "with "
      "its Wilson lower bound (95 %) / incomplete / wrong. Mean error of the end effector (a "
      "finger) "
      "over {} test poses, mean ± standard error over the robots that connect it with the "
      "root.\n\n{}",
      num_robots, num_search, num_models, kTestPoses, table.markdown());
  return findings;
}

}  // namespace bodyschema::experiments
