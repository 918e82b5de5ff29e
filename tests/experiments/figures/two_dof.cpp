// Fig. 10 and the noise-free figures of Section 5.1: the 2-DOF robot with five parts.

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <utility>

#include "common/geometry/angle.h"
#include "processes/controller/inverse_kinematics.h"
#include "tests/experiments/figures/cramer_rao.h"
#include "tests/experiments/figures/experiment.h"
#include "tests/experiments/figures/robots.h"
#include "tests/experiments/figures/statistics.h"

namespace bodyschema::experiments {
namespace {

using test::Regime;

constexpr double kMillimetre = 1e-3;
/// σ_markers of the chapter, rms over the three axes.
constexpr double kMarkerNoise = 0.044;

/// Rms distance between targets and the end effector's true positions after control [m].
/// Targets are the true positions at the first `count` test actions, as if seen without noise.
double control_error_rms(const BodySchema& schema, const Trial& trial, int count) {
  const InverseKinematicsOptions options{
      .tolerance_m = 1e-4, .damping_m = 0.05, .max_iterations = 100, .max_starts = 20};
  const int from = trial.root(), to = trial.end_effector();
  const auto position = [&](const Eigen::VectorXd& action) {
    const auto X = trial.robot.poses_in_camera(action);
    return Eigen::Vector3d((X.at(from).inverse() * X.at(to)).translation());
  };
  const Eigen::VectorXd rest =
      Eigen::VectorXd::Zero(static_cast<Eigen::Index>(trial.robot.signals.size()));
  double sum = 0;
  for (int n = 0; n < count; ++n) {
    const Eigen::Vector3d target = position(trial.test_actions[n]);
    const auto solution =
        solve_pose(schema, to, {.p_RT = target}, trial.robot.signals, rest, options);
    sum += (position(solution.action) - target).squaredNorm();
  }
  return std::sqrt(sum / count);
}

/// The chapter's search learns all models anew at each N; beyond this it takes seconds.
constexpr int kLargestSearch = 30;

/// Results of all robots at one N.
struct Column {
  std::vector<double> mean, rms, angle, control;
  Judgements structure;

  /// "97.5 % (≥ 90.1)", or a dash if no structure was searched.
  std::string right() const {
    return structure.total() > 0 ? percentage(structure.right, structure.total()) : "–";
  }

  void add(const std::optional<PoseErrors>& errors) {
    if (!errors) return;
    mean.push_back(errors->position_mean_m);
    rms.push_back(errors->position_rms_m);
    angle.push_back(errors->rotation_mean_rad);
  }
};

/// Both methods at one N, of one robot.
struct Result {
  std::optional<PoseErrors> errors;
  double control_m = NAN;
  std::optional<test::Rightness> rightness;
};

test::Rightness rightness_of_baseline(const Trial& trial,
                                      const std::vector<ActionPoseSample>& samples) {
  return test::judge(
      learn_baseline(trial.robot.signals, samples, baseline_options(trial.regime)).schema,
      trial.robot);
}

std::string errors_text(const Column& column, int num_robots) {
  if (column.mean.empty()) return "–";
  const std::string of = num_robots > static_cast<int>(column.mean.size())
                             ? fmt::format(" ({} of {} robots)", column.mean.size(), num_robots)
                             : "";
  return mean_and_error(spread_of(column.mean), kMillimetre) + " mm, " +
         mean_and_error(spread_of(column.angle), kDegree) + "°" + of;
}

/// By robot, by size.
using Results = std::vector<std::vector<Result>>;

Column column_of(const Results& results, std::size_t s) {
  Column c;
  for (const auto& robot : results) {
    if (robot[s].rightness) c.structure.add(*robot[s].rightness);
    c.add(robot[s].errors);
    if (std::isfinite(robot[s].control_m)) c.control.push_back(robot[s].control_m);
  }
  return c;
}

/// `bounds`: Cramér–Rao, by robot, by size [m].
Results ours_in_noise(const Setup& setup, const std::vector<int>& sizes, int num_robots,
                      int num_targets, std::vector<std::vector<double>>* bounds) {
  Results ours(num_robots, std::vector<Result>(sizes.size()));
  bounds->assign(num_robots, std::vector<double>(sizes.size()));
  for_each_robot(setup, "ours", num_robots, [&](int n) {
    const Trial trial = make_trial("a", Regime::kChapter, sizes.back(), n + 1);
    CramerRao bound(trial.robot);
    int added = 0;
    for (std::size_t s = 0; s < sizes.size(); ++s) {
      for (; added < sizes[s]; ++added) bound.add(trial.samples[added]);
      (*bounds)[n][s] =
          position_bound_rms(bound, trial.root(), trial.end_effector(), trial.test_actions);
      const BodySchema schema = learn(trial.robot.signals, trial.first(sizes[s])).schema;
      Result& result = ours[n][s];
      result.rightness = test::judge(schema, trial.robot);
      result.errors = end_effector_errors(schema, trial);
      if (result.errors) result.control_m = control_error_rms(schema, trial, num_targets);
    }
  });
  return ours;
}

Results baseline_in_noise(const Setup& setup, const std::vector<int>& sizes, int num_robots,
                          int num_targets) {
  Results baseline(num_robots, std::vector<Result>(sizes.size()));
  for_each_robot(setup, "baseline", num_robots, [&](int n) {
    const Trial trial = make_trial("a", Regime::kChapter, sizes.back(), n + 1);
    for (std::size_t s = 0; s < sizes.size(); ++s) {
      const auto samples = trial.first(sizes[s]);
      Result& result = baseline[n][s];
      if (sizes[s] <= kLargestSearch) result.rightness = rightness_of_baseline(trial, samples);
      const BodySchema schema = baseline_on_true_structure(trial, samples);
      result.errors = end_effector_errors(schema, trial);
      if (result.errors) result.control_m = control_error_rms(schema, trial, num_targets);
    }
  });
  return baseline;
}

void add_musts_in_noise(int N, const Spread& rms, const Spread& bound, Findings* findings) {
  if (N == 12)
    findings->musts.push_back({"2-DOF, chapter noise, N = 12: rms below the markers' 44 mm",
                               short_number(rms.mean / kMillimetre) + " mm",
                               rms.mean < kMarkerNoise});
  if (N == 100)
    findings->musts.push_back(
        {"2-DOF, chapter noise, N = 100: within 1.6 × the Cramér–Rao bound",
         fmt::format("rms {} mm, bound {} mm: {} ×", short_number(rms.mean / kMillimetre),
                     short_number(bound.mean / kMillimetre), short_number(rms.mean / bound.mean)),
         rms.mean < 1.6 * bound.mean});
}

/// The curves of the figure, and a row of the table for each N.
std::vector<Curve> curves_in_noise(const std::vector<int>& sizes, const Results& ours,
                                   const Results& baseline,
                                   const std::vector<std::vector<double>>& bounds, Table* table,
                                   Findings* findings) {
  Curve prediction{.title = "ours, prediction", .colour = 1},
      control{.title = "ours, control", .colour = 5},
      base_prediction{.title = "baseline, prediction", .colour = 0},
      base_control{.title = "baseline, control", .colour = 4},
      bound_curve{.title = "Cramér–Rao bound", .colour = 3};
  for (std::size_t s = 0; s < sizes.size(); ++s) {
    const Column us = column_of(ours, s), them = column_of(baseline, s);
    std::vector<double> bound;
    for (const auto& robot : bounds) bound.push_back(robot[s]);
    const Spread rms = spread_of(us.rms), limit = spread_of(bound);
    const int N = sizes[s];
    table->add({std::to_string(N),
                N < 15    ? "converges within 10"
                : N == 15 ? "below marker noise (44 mm)"
                          : "control about 50 mm",
                them.right(), mean_and_error(spread_of(them.rms), kMillimetre),
                mean_and_error(spread_of(them.control), kMillimetre), us.structure.text(),
                mean_and_error(rms, kMillimetre), mean_and_error(spread_of(us.mean), kMillimetre),
                mean_and_error(spread_of(us.control), kMillimetre),
                mean_and_error(limit, kMillimetre), short_number(rms.mean / limit.mean)});
    const auto also = [N](Curve& curve, const std::vector<double>& values) {
      const Spread spread = spread_of(values);
      curve.x.push_back(N);
      curve.y.push_back(spread.mean / kMillimetre);
      curve.error.push_back(spread.standard_error() / kMillimetre);
    };
    also(prediction, us.rms);
    also(control, us.control);
    also(base_prediction, them.rms);
    also(base_control, them.control);
    also(bound_curve, bound);
    add_musts_in_noise(N, rms, limit, findings);
  }
  return {base_prediction, base_control, prediction, control, bound_curve};
}

/// Ours and the baseline without noise.
std::pair<Results, Results> measure_free(const Setup& setup, const std::vector<int>& sizes,
                                         double bend, const std::string& command, int num_robots,
                                         int num_baseline) {
  Results ours(num_robots, std::vector<Result>(sizes.size())),
      baseline(num_baseline, std::vector<Result>(sizes.size()));
  const auto trial_of = [&](int n) {
    return make_trial("a", Regime::kFree, sizes.back(), n + 1, bend);
  };
  for_each_robot(setup, "ours, " + command, num_robots, [&](int n) {
    const Trial trial = trial_of(n);
    for (std::size_t s = 0; s < sizes.size(); ++s) {
      const BodySchema schema = learn(trial.robot.signals, trial.first(sizes[s])).schema;
      ours[n][s] = {end_effector_errors(schema, trial), NAN, test::judge(schema, trial.robot)};
    }
  });
  for_each_robot(setup, "baseline, " + command, num_baseline, [&](int n) {
    const Trial trial = trial_of(n);
    for (std::size_t s = 0; s < sizes.size(); ++s) {
      const auto samples = trial.first(sizes[s]);
      Result& result = baseline[n][s];
      if (sizes[s] <= kLargestSearch) result.rightness = rightness_of_baseline(trial, samples);
      result.errors = end_effector_errors(baseline_on_true_structure(trial, samples), trial);
    }
  });
  return {ours, baseline};
}

void add_musts_free(double bend, int N, const Column& ours, int num_robots, Findings* findings) {
  const Spread position = spread_of(ours.mean), angle = spread_of(ours.angle);
  const bool all = position.count == num_robots;
  const std::string measured = errors_text(ours, num_robots);
  if (bend == 0 && N == 5) {
    const double worst = *std::max_element(ours.mean.begin(), ours.mean.end());
    findings->musts.push_back({"2-DOF, free, straight commands, N = 5: < 1e-9 m",
                               fmt::format("{}, worst robot {:.1e} m", measured, worst),
                               all && position.mean < 1e-9});
  }
  if (bend != 0 && N == 20)
    findings->musts.push_back({"2-DOF, free, bent commands, N = 20: < 1 mm, 0.2°", measured,
                               all && position.mean < kMillimetre && angle.mean < 0.2 * kDegree});
}

}  // namespace

Findings two_dof_noise(const Setup& setup) {
  const std::vector<int> sizes = setup.quick ? std::vector<int>{5, 12, 30}
                                             : std::vector<int>{5, 8, 10, 12, 15, 20, 30, 50, 100};
  const int num_robots = setup.robots(200, 6), num_baseline = setup.robots(40, 2);
  const int num_targets = setup.robots(20, 5), num_baseline_targets = setup.robots(5, 2);
  std::vector<std::vector<double>> bounds;
  const Results ours = ours_in_noise(setup, sizes, num_robots, num_targets, &bounds);
  const Results baseline = baseline_in_noise(setup, sizes, num_baseline, num_baseline_targets);
  Findings findings;
  Table table({"N", "chapter", "baseline: structure right %",
               "baseline on the true structure: rms mm", "control mm", "ours: structure right %",
               "ours: rms mm", "ours: mean mm", "control mm", "Cramér–Rao rms mm",
               "ours over the bound"});
  const std::vector<Curve> curves =
      curves_in_noise(sizes, ours, baseline, bounds, &table, &findings);
  draw(setup, "two_dof_noise.png",
       {{.title = "Fig. 10: 2-DOF robot, 44 mm of noise; baseline on the true structure",
         .x_label = "samples N",
         .y_label = "position error of the end effector, rms [mm]",
         .curves = curves,
         .references = {{"chapter: 44 mm, after 15", 44}, {"chapter: control 50 mm", 50}},
         .log_x = true,
         .log_y = true}},
       1);
  findings.markdown = fmt::format(
      "{} robots (baseline {}), {} test poses each; per robot the rms of the end effector's "
      "position "
      "error, then mean ± standard error over the robots that connect it with the root. Control: "
      "the position that inverse "
      "kinematics on the learned model reaches by the robot's truth, {} targets a robot (baseline "
      "{}). "
      "Structure: right with its Wilson lower bound (95 %) / incomplete / wrong. The chapter's "
      "robot "
      "was a real one; its curve is known at the points named.\n\n{}",
      num_robots, num_baseline, kTestPoses, num_targets, num_baseline_targets, table.markdown());
  return findings;
}

Findings two_dof_free(const Setup& setup) {
  const std::vector<int> sizes =
      setup.quick ? std::vector<int>{5, 20} : std::vector<int>{3, 4, 5, 10, 20, 50, 100};
  const int num_robots = setup.robots(200, 10), num_baseline = setup.robots(40, 3);
  Findings findings;
  Table table({"command", "N", "chapter", "baseline: structure right %",
               "baseline on the true structure", "ours: structure right %", "ours"});
  std::vector<Panel> panels;
  for (const double bend : {0.0, 0.1}) {
    const char* command = bend == 0 ? "θ = q" : "θ = q + 0.1 sin 3q";
    const auto [ours, baseline] =
        measure_free(setup, sizes, bend, command, num_robots, num_baseline);
    Curve us{.title = "ours", .colour = 1}, them{.title = "baseline", .colour = 0};
    for (std::size_t s = 0; s < sizes.size(); ++s) {
      const Column our_column = column_of(ours, s), their_column = column_of(baseline, s);
      const int N = sizes[s];
      table.add({command, std::to_string(N),
                 N == 20    ? "< 2 mm, 1°"
                 : N == 100 ? "< 1 mm, 0.2°"
                            : "–",
                 their_column.right(), errors_text(their_column, num_baseline),
                 our_column.structure.text(), errors_text(our_column, num_robots)});
      us.x.push_back(N);
      us.y.push_back(spread_of(our_column.mean).mean / kMillimetre);
      them.x.push_back(N);
      them.y.push_back(spread_of(their_column.mean).mean / kMillimetre);
      add_musts_free(bend, N, our_column, num_robots, &findings);
    }
    panels.push_back(
        {.title = std::string("2-DOF, noise-free, ") + command + "; baseline on the true structure",
         .x_label = "samples N",
         .y_label = "mean position error of the end effector [mm]",
         .curves = {them, us},
         .references = {{"chapter, N = 20: 2 mm", 2}, {"chapter, N = 100: 1 mm", 1}},
         .log_x = true,
         .log_y = true});
  }
  draw(setup, "two_dof_free.png", panels, 2);
  findings.markdown = fmt::format(
      "{} robots (baseline {}), {} test poses each: mean error of the end effector's position and "
      "angle, mean ± standard error over the robots that connect it with the root.\n\n{}",
      num_robots, num_baseline, kTestPoses, table.markdown());
  return findings;
}

}  // namespace bodyschema::experiments
