// Fig. 5: one local model learned on the signal that moves the joint, and one on another signal.

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "common/geometry/angle.h"
#include "processes/structure_learner/baseline/fit_matrix_gp.h"
#include "processes/structure_learner/screen.h"
#include "processes/structure_learner/validity.h"
#include "tests/experiments/figures/experiment.h"
#include "tests/experiments/figures/robots.h"
#include "tests/experiments/figures/statistics.h"

namespace bodyschema::experiments {
namespace {

using test::Regime;

constexpr double kMillimetre = 1e-3;
/// The pair that q1 moves on robot a; q2 does not move it.
constexpr int kFrom = 2, kTo = 3;
constexpr int kRightSignal = 0, kWrongSignal = 1;

/// A local model of the pair on one signal, of either kind.
struct Learned {
  bool is_valid = false;
  std::vector<Vector6d> residuals;  ///< leave-one-out
  std::function<Pose(double)> predict;
  /// Covariance of a new observation about the prediction (right perturbation).
  std::function<Matrix6d(double)> covariance;

  double position_rms() const {
    return std::sqrt(empirical_covariance(residuals).topLeftCorner<3, 3>().trace());
  }
  double rotation_rms() const {
    return std::sqrt(empirical_covariance(residuals).bottomRightCorner<3, 3>().trace());
  }
};

/// Samples of the pair with one signal alone.
std::vector<ActionPoseSample> reduced(const Trial& trial, int signal) {
  std::vector<ActionPoseSample> samples = trial.samples;
  for (ActionPoseSample& sample : samples) {
    sample.action = Eigen::VectorXd::Constant(1, sample.action(signal));
    std::erase_if(sample.parts, [](const auto& o) { return o.part != kFrom && o.part != kTo; });
  }
  return samples;
}

Learned by_gaussian_processes(const Trial& trial, int signal) {
  const std::vector<ActionPoseSample> samples = reduced(trial, signal);
  Learned result;
  std::vector<double> q;
  std::vector<Pose> z;
  for (const ActionPoseSample& sample : samples) {
    const PartObservation *from = sample.find(kFrom), *to = sample.find(kTo);
    if (!from || !to) continue;
    q.push_back(sample.action(0));
    z.push_back(from->X_CB.inverse() * to->X_CB);
  }
  const auto gp = std::make_shared<const MatrixGp>(fit_matrix_gp(
      {0}, Eigen::Map<const Eigen::RowVectorXd>(q.data(), static_cast<Eigen::Index>(q.size())), z));
  result.residuals = gp->leave_one_out().residual;
  result.predict = [gp](double x) { return gp->predict(Eigen::VectorXd::Constant(1, x)); };
  result.covariance = [gp](double x) {
    const Eigen::VectorXd action = Eigen::VectorXd::Constant(1, x);
    Matrix6d covariance = gp->prediction_covariance(action);
    const Eigen::Matrix3d R = gp->predict(action).linear();
    Eigen::Vector3d noise;  // of the translation's entries, in frame `from`
    for (int n = 0; n < 3; ++n) noise(n) = gp->prior(9 + n).noise_variance;
    covariance.topLeftCorner<3, 3>() += R.transpose() * noise.asDiagonal() * R;
    return covariance;
  };
  // The chapter's own test; the rigid model is counted too.
  BaselineOptions options = baseline_options(trial.regime);
  options.stop_at_first_tree = false;
  const auto count_valid = [&](int max_signals) {
    options.max_signals = max_signals;
    return learn_baseline({trial.robot.signals[signal]}, samples, options).num_valid;
  };
  result.is_valid = count_valid(1) > count_valid(0);
  return result;
}

Learned by_screw(const Trial& trial, int signal) {
  const std::vector<ActionPoseSample> samples = reduced(trial, signal);
  const auto actions = std::make_shared<const NormalizedActions>(samples, 1);
  const PairData pair = make_pair_data(samples, kFrom, kTo, {}, 1000);
  const RelativeMotions motions = relative_motions(pair, 300);
  const Start start = one_joint_start(screen_one_joint(motions, *actions).front(), pair, *actions,
                                      motions.sigma_rad);
  const Fit fit = fit_local_model(start.model, pair, *actions, 100);
  const LeaveOneOut loo = leave_one_out(fit, pair, *actions);
  Learned result;
  result.is_valid = check_validity(fit, loo, pair, *actions, {}).verdict == Verdict::kValid;
  // Outliers apart, unless most are.
  for (std::size_t t = 0; t < loo.residual.size(); ++t)
    if (loo.squared_distance[t] <= kOutlierThreshold) result.residuals.push_back(loo.residual[t]);
  if (2 * result.residuals.size() < loo.residual.size()) result.residuals = loo.residual;
  const Matrix6d about = empirical_covariance(result.residuals);
  result.predict = [model = fit.model, actions](double x) {
    LocalModel at = model;  // of an action that is none of the samples': the normalised value is 1
    const double u = (x - actions->centre(0)) / actions->half_range(0);
    Vector6d screw = Vector6d::Zero();
    screw(2) = at.joints[0].slide * u;
    screw(5) = at.joints[0].turn * u;
    return at.first * exp(screw) * at.joints[0].X_after;
  };
  result.covariance = [about](double) { return about; };
  return result;
}

/// One panel of Fig. 5: x, y, z of the translation over the signal.
Panel panel_of(const Learned& learned, const Trial& trial, int signal, const std::string& title) {
  Panel panel{.title = title,
              .x_label = "q" + std::to_string(signal + 1) + " [°]",
              .y_label = fmt::format("position of part {} in part {} [mm]", kTo, kFrom)};
  const Signal& limits = trial.robot.signals[signal];
  const char* const names[] = {"x", "y", "z"};
  for (int axis = 0; axis < 3; ++axis) {
    Curve curve{.title = std::string(names[axis]) + ", band 2 σ",
                .colour = axis == 0   ? 0
                          : axis == 1 ? 2
                                      : 1,
                .kind = Curve::Kind::kBand};
    Curve dots{.title = "", .colour = curve.colour, .kind = Curve::Kind::kPoints};
    constexpr int kSteps = 120;
    for (int n = 0; n <= kSteps; ++n) {
      const double q = limits.lower + (limits.upper - limits.lower) * n / kSteps;
      const Pose X = learned.predict(q);
      const Eigen::Matrix3d covariance =
          X.linear() * learned.covariance(q).topLeftCorner<3, 3>() * X.linear().transpose();
      curve.x.push_back(q / kDegree);
      curve.y.push_back(X.translation()(axis) / kMillimetre);
      curve.error.push_back(2 * std::sqrt(std::max(0.0, covariance(axis, axis))) / kMillimetre);
    }
    for (const ActionPoseSample& sample : trial.samples) {
      const PartObservation *from = sample.find(kFrom), *to = sample.find(kTo);
      if (!from || !to) continue;
      const Pose z = from->X_CB.inverse() * to->X_CB;
      dots.x.push_back(sample.action(signal) / kDegree);
      dots.y.push_back(z.translation()(axis) / kMillimetre);
    }
    panel.curves.push_back(std::move(curve));
    panel.curves.push_back(std::move(dots));
  }
  return panel;
}

/// A method, by robot.
struct Side {
  std::vector<double> position, rotation;
  std::vector<char> valid;
  explicit Side(int count) : position(count), rotation(count), valid(count) {}
  void set(int n, const Learned& learned) {
    position[n] = learned.position_rms();
    rotation[n] = learned.rotation_rms();
    valid[n] = learned.is_valid;
  }
  int num_valid() const {
    return static_cast<int>(std::count(valid.begin(), valid.end(), char{1}));
  }
  std::string rms() const {
    return mean_and_error(spread_of(position), kMillimetre) + " mm, " +
           mean_and_error(spread_of(rotation), kDegree) + "°";
  }
};

}  // namespace

Findings local_model(const Setup& setup) {
  constexpr int kSamples = 40;
  const int num_robots = setup.robots(200, 5), num_baseline = setup.robots(50, 2);
  Findings findings;
  Table table({"regime", "signal", "chapter", "baseline: valid %", "leave-one-out rms",
               "ours: valid %", "leave-one-out rms"});
  for (const Regime regime : {Regime::kFree, Regime::kChapter, Regime::kTag}) {
    for (const int signal : {kRightSignal, kWrongSignal}) {
      const std::string name = test::name_of(regime);
      const std::string what = signal == kRightSignal ? "q1 (moves it)" : "q2 (does not)";
      Side ours(num_robots), baseline(num_baseline);
      for_each_robot(setup, name + ", " + what, num_robots, [&](int n) {
        const Trial trial = make_trial("a", regime, kSamples, n + 1);
        ours.set(n, by_screw(trial, signal));
        if (n < num_baseline) baseline.set(n, by_gaussian_processes(trial, signal));
      });
      table.add({name, what,
                 signal == kRightSignal ? "accurate, low noise" : "uncertain, likely discarded",
                 percentage(baseline.num_valid(), num_baseline), baseline.rms(),
                 percentage(ours.num_valid(), num_robots), ours.rms()});
      if (signal == kWrongSignal)
        findings.musts.push_back(
            {fmt::format("local model, {}: never valid on the wrong signal", name),
             fmt::format("{} of {}", ours.num_valid(), num_robots), ours.num_valid() == 0});
      if (signal == kRightSignal && regime == Regime::kFree)
        findings.musts.push_back({"local model, free: always valid on the right signal",
                                  fmt::format("{} of {}", ours.num_valid(), num_robots),
                                  ours.num_valid() == num_robots});
    }
  }
  const Trial shown = make_trial("a", Regime::kTag, kSamples, 1);
  draw(setup, "local_model.png",
       {panel_of(by_gaussian_processes(shown, kRightSignal), shown, kRightSignal,
                 "Fig. 5a, baseline (Gaussian processes): the right signal"),
        panel_of(by_gaussian_processes(shown, kWrongSignal), shown, kWrongSignal,
                 "Fig. 5b, baseline (Gaussian processes): the wrong signal"),
        panel_of(by_screw(shown, kRightSignal), shown, kRightSignal,
                 "ours (screw): the right signal"),
        panel_of(by_screw(shown, kWrongSignal), shown, kWrongSignal,
                 "ours (screw): the wrong signal, refuted")},
       2);
  findings.markdown = fmt::format(
      "Pair {}–{} of the 2-DOF robot, {} samples, {} robots (baseline {}); leave-one-out "
      "residuals, "
      "rms over the three axes together (ours: over what is no outlier), mean ± standard error "
      "over "
      "the robots. Plot: seed 1, tag noise (3 % of the markers flipped), bands of two standard "
      "deviations of a new observation.\n\n{}",
      kFrom, kTo, kSamples, num_robots, num_baseline, table.markdown());
  return findings;
}

}  // namespace bodyschema::experiments
