#include "processes/structure_learner/local_model.h"

#include <gtest/gtest.h>

#include "tests/support/synthetic_robot.h"

namespace bodyschema {
namespace {

using test::Rng;

LocalModel random_model(int num_joints, Rng& rng) {
  LocalModel model;
  model.joints.resize(num_joints);
  for (int d = 0; d <= num_joints; ++d) model.transform(d) = test::random_pose(rng, 0.05, 0.2);
  for (int d = 0; d < num_joints; ++d) {
    model.joints[d].signal = d;
    model.joints[d].slide = test::uniform(rng, -0.05, 0.05);
    model.joints[d].turn = test::uniform(rng, 0.5, 1.5);
  }
  return model;
}

std::vector<ActionPoseSample> random_actions(int n, Rng& rng) {
  std::vector<ActionPoseSample> samples(n);
  for (auto& s : samples) {
    s.action.resize(2);
    s.action << test::uniform(rng, -100, 300), test::uniform(rng, 0, 4096);
  }
  return samples;
}

// Parts 1 and 2 seen by a camera, part 2 as the model says, with noise.
void observe(const LocalModel& model, double sigma, std::vector<ActionPoseSample>* samples,
             Rng& rng) {
  const NormalizedActions actions(*samples, 2);
  for (std::size_t t = 0; t < samples->size(); ++t) {
    PartObservation one, two;
    one.part = 1;
    two.part = 2;
    one.X_CB = test::random_pose(rng, 0, 1);
    two.X_CB = one.X_CB * model.predict(actions, static_cast<int>(t));
    one.X_CB = one.X_CB * exp(sigma * test::gaussian6(rng));
    two.X_CB = two.X_CB * exp(sigma * test::gaussian6(rng));
    (*samples)[t].parts = {one, two};
  }
}

TEST(LocalModel, ParameterJacobianAgreesWithCentralDifferences) {
  Rng rng(1);
  const auto samples = random_actions(5, rng);
  const NormalizedActions actions(samples, 2);
  const double h = 1e-6;
  for (int k = 0; k <= 2; ++k) {
    const LocalModel model = random_model(k, rng);
    for (int t = 0; t < 5; ++t) {
      ParameterJacobian J;
      const Pose X = predict_with_jacobian(model, actions, t, &J);
      EXPECT_TRUE(X.isApprox(model.predict(actions, t), 1e-12));
      for (int n = 0; n < model.num_parameters(); ++n) {
        ParameterVector step = ParameterVector::Zero(model.num_parameters());
        step(n) = h;
        const Vector6d numeric = (log(X.inverse() * perturbed(model, step).predict(actions, t)) -
                                  log(X.inverse() * perturbed(model, -step).predict(actions, t))) /
                                 (2 * h);
        EXPECT_LT((J.col(n) - numeric).norm(), 1e-8) << "k " << k << " parameter " << n;
      }
    }
  }
}

TEST(LocalModel, InverseUndoesThePrediction) {
  Rng rng(2);
  const auto samples = random_actions(5, rng);
  const NormalizedActions actions(samples, 2);
  for (int k = 0; k <= 2; ++k) {
    const LocalModel model = random_model(k, rng);
    for (int t = 0; t < 5; ++t)
      EXPECT_TRUE((model.predict(actions, t) * model.inverse().predict(actions, t))
                      .isApprox(Pose::Identity(), 1e-12));
  }
}

TEST(LocalModel, FitFindsTheTruthFromAPerturbedStart) {
  Rng rng(3);
  for (int k = 0; k <= 2; ++k) {
    const LocalModel truth = random_model(k, rng);
    auto samples = random_actions(20, rng);
    observe(truth, 0, &samples, rng);
    const NormalizedActions actions(samples, 2);
    const PairData pair = make_pair_data(samples, 1, 2, {Noise{1e-4, 3e-4}, {}}, 100);
    ParameterVector step(truth.num_parameters());
    for (auto& x : step) x = 0.1 * test::gaussian(rng);
    const Fit fit = fit_local_model(perturbed(truth, step), pair, actions, 60);
    EXPECT_LT(fit.cost, 1e-12);
    for (int t = 0; t < 20; ++t)
      EXPECT_TRUE(fit.model.predict(actions, t).isApprox(truth.predict(actions, t), 1e-9));
  }
}

TEST(LocalModel, ClosedFormLeaveOneOutAgreesWithRefits) {
  Rng rng(4);
  const double sigma = 0.002;
  const LocalModel truth = random_model(1, rng);
  auto samples = random_actions(15, rng);
  observe(truth, sigma, &samples, rng);
  const NormalizedActions actions(samples, 2);
  const PairData pair = make_pair_data(samples, 1, 2, {Noise{sigma, sigma}, {}}, 100);
  const Fit fit = fit_local_model(truth, pair, actions, 60);
  const LeaveOneOut loo = leave_one_out(fit, pair, actions);
  EXPECT_EQ(loo.rank, 12);
  for (int t = 0; t < pair.size(); ++t) {
    PairData others = pair;
    others.frames.erase(others.frames.begin() + t);
    const Fit refit = fit_local_model(fit.model, others, actions, 60);
    const Vector6d r =
        log(refit.model.predict(actions, pair.frames[t].sample).inverse() * pair.primary(t).z);
    // Closed form holds at fixed robust weights, refits change them a little.
    EXPECT_LT((loo.residual[t] - r).norm(), 0.15 * r.norm() + 2e-4);
  }
}

TEST(LocalModel, RankCountsAPrismaticJointsFewerParameters) {
  Rng rng(5);
  LocalModel truth = random_model(1, rng);
  truth.joints[0].turn = 0;
  auto samples = random_actions(15, rng);
  observe(truth, 0, &samples, rng);
  const NormalizedActions actions(samples, 2);
  const PairData pair = make_pair_data(samples, 1, 2, {Noise{1e-3, 1e-3}, {}}, 100);
  // Rigid 6, direction 2, gain 1, and the turn that could be: with its axis unobservable, 1.
  const LeaveOneOut loo = leave_one_out(evaluate(truth, pair, actions), pair, actions);
  EXPECT_LE(loo.rank, 12);
  EXPECT_GE(loo.rank, 9);
}

TEST(LocalModel, TheFitTakesTheLikelierReadingOfAPlanarMarker) {
  Rng rng(6);
  const LocalModel truth = random_model(1, rng);
  auto samples = random_actions(20, rng);
  observe(truth, 0, &samples, rng);
  for (std::size_t t = 0; t < samples.size(); t += 4) {
    PartObservation& o = samples[t].parts[1];
    o.X_CB_other = o.X_CB;
    o.error_ratio = 1.2;
    o.X_CB.linear() = o.X_CB.linear() * exp_so3({0.5, 0, 0});
  }
  const NormalizedActions actions(samples, 2);
  const PairData pair = make_pair_data(samples, 1, 2, {Noise{1e-3, 1e-2}, {}}, 100);
  const Fit fit = fit_local_model(truth, pair, actions, 60);
  for (const FrameFit& frame : fit.frames) EXPECT_LT(frame.squared_distance, 1e-6);
}

TEST(NormalizedActions, TellWhichSignalsMoveAlike) {
  for (const double gain : {0.0, 2.0, -180.0}) {
    Rng rng(3);
    auto samples = random_actions(40, rng);
    for (auto& s : samples)
      if (gain != 0) s.action(1) = 7 + gain * (s.action(0) + test::uniform(rng, -0.05, 0.05));
    const NormalizedActions actions(samples, 2);
    EXPECT_EQ(actions.are_alike(0, 1), gain != 0) << gain;
    if (gain != 0) EXPECT_EQ(std::signbit(actions.correlation(1, 0)), gain < 0);
  }
}

// Of a joint that is held still its encoder's last digits; not a stage of 1 mm in metres, nor a
// joint in radians beside ticks of an encoder.
TEST(NormalizedActions, JitterIsNoMotion) {
  std::vector<ActionPoseSample> samples(20);
  for (int t = 0; t < 20; ++t) {
    const double x = t / 19.0;
    samples[t].action = Eigen::Vector4d(2 * x, 0.5 + 2e-4 * x, 1e-3 * x, 1.0);
  }
  EXPECT_EQ(NormalizedActions(samples, 4).moving(), (std::vector{0, 2}));
  for (int t = 0; t < 20; ++t) samples[t].action(0) = 5000.0 * t;
  for (int t = 0; t < 20; ++t) samples[t].action(3) = 0.05 * t;
  EXPECT_EQ(NormalizedActions(samples, 4).moving(), (std::vector{0, 2, 3}));
}

TEST(NormalizedActions, ConstantSignalsDoNotMove) {
  Rng rng(7);
  auto samples = random_actions(5, rng);
  for (auto& s : samples) s.action(0) = 0.1;
  const NormalizedActions actions(samples, 2);
  EXPECT_EQ(actions.moving(), std::vector<int>{1});
  samples[3].action.resize(1);
  EXPECT_THROW(NormalizedActions(samples, 2), std::invalid_argument);
}

}  // namespace
}  // namespace bodyschema
