// Cost of learning and predicting: local models, structure search, a new sample online, beside the
// chapter's method with all models enumerated; forward kinematics and Jacobian beside Orocos
// KDL on the same learned arm. All on synthetic robots, seeded.

#include <benchmark/benchmark.h>

#include <kdl/chain.hpp>
#include <kdl/chainfksolverpos_recursive.hpp>
#include <kdl/chainjnttojacsolver.hpp>
#include <limits>
#include <stdexcept>

#include "common/kinematics/kinematic_path.h"
#ifdef BODYSCHEMA_HAS_REFINER
#include "processes/refiner/refine.h"
#endif
#include "processes/structure_learner/baseline/fit_matrix_gp.h"
#include "processes/structure_learner/baseline/learn_baseline.h"
#include "processes/structure_learner/online_learner.h"
#include "tests/benchmarks/ratio_reporter.h"
#include "tests/support/synthetic_robot.h"

namespace bodyschema::test {
namespace {

constexpr int kRoot = 1, kFinger = 9;
constexpr ObservationOptions kTag{.regime = Regime::kTag, .with_covariances = true};

struct Recording {
  SyntheticRobot robot;
  std::vector<ActionPoseSample> samples;
};

/// The chapter's 7-DOF robot, as it babbles.
Recording seven_dof(int num_samples, const ObservationOptions& observation = kTag) {
  Rng rng(1);
  Recording result{chapter_robot("d", rng), {}};
  result.samples = babble(result.robot, num_samples, observation, rng);
  return result;
}

/// 40 parts, 3 of them hidden, about 30 signals.
Recording forty_parts(int num_samples) {
  Rng rng(1);
  RandomTreeOptions options;
  options.num_parts = 40;
  options.num_hidden = 3;
  options.share_fixed = 0.25;
  Recording result{random_tree(options, rng), {}};
  result.samples = babble(result.robot, num_samples, kTag, rng);
  return result;
}

// ---- prediction

/// A robot that was learned from exact samples, so that its joints turn and do not slide; the path
/// from its root to a finger by seven joints; random actions.
struct Arm {
  BodySchema schema;
  KinematicPath path;
  Eigen::MatrixXd actions;
};

const Arm& arm() {
  static const Arm arm = [] {
    const Recording run = seven_dof(50, {.regime = Regime::kFree});
    BodySchema schema = learn(run.robot.signals, run.samples).schema;
    if (!is_right(schema, run.robot)) throw std::logic_error("the arm was not learned");
    auto path = KinematicPath::between(schema, kRoot, kFinger);
    Rng rng(2);
    Eigen::MatrixXd actions(7, 256);
    for (auto action : actions.colwise()) action = run.robot.random_action(rng);
    return Arm{std::move(schema), std::move(*path), std::move(actions)};
  }();
  return arm;
}

KDL::Frame to_kdl(const Pose& X) {
  const auto& R = X.linear();
  const auto& p = X.translation();
  return {{R(0, 0), R(0, 1), R(0, 2), R(1, 0), R(1, 1), R(1, 2), R(2, 0), R(2, 1), R(2, 2)},
          {p.x(), p.y(), p.z()}};
}

/// The same path as a KDL chain: joints about z, which cost it least, and all constant transforms
/// between two joints in one frame.
struct KdlArm {
  KDL::Chain chain;
  std::vector<int> signals;  ///< of its joints

  KdlArm() {
    std::vector<const Edge*> edges;
    for (int part = kFinger; part != kRoot; part = edges.back()->from)
      for (const Edge& edge : arm().schema.edges)
        if (edge.to == part) edges.push_back(&edge);
    Pose constant = Pose::Identity();
    KDL::Joint joint;
    const auto close_segment = [&] {
      chain.addSegment(KDL::Segment(joint, to_kdl(constant)));
      constant = Pose::Identity();
    };
    for (auto edge = edges.rbegin(); edge != edges.rend(); ++edge) {
      constant = constant * (*edge)->left;
      for (const ScrewJoint& screw : (*edge)->joints) {
        if (std::abs(screw.slide) > 1e-9) throw std::logic_error("a hinge that slides");
        close_segment();
        joint = KDL::Joint(KDL::Joint::RotZ, screw.turn * screw.gain);
        signals.push_back(screw.signal);
        Vector6d offset = Vector6d::Zero();
        offset(5) = screw.turn * screw.offset;
        constant = exp(offset) * screw.X_after;
      }
      constant = constant * (*edge)->right;
    }
    close_segment();
    check();
  }

  KDL::JntArray joints(const Eigen::VectorXd& action) const {
    KDL::JntArray q(static_cast<unsigned>(signals.size()));
    for (std::size_t j = 0; j < signals.size(); ++j)
      q(static_cast<unsigned>(j)) = action(signals[j]);
    return q;
  }

  /// Both arms are the same arm. @throws std::logic_error if not.
  void check() const {
    KDL::ChainFkSolverPos_recursive kinematics(chain);
    KDL::ChainJntToJacSolver derivative(chain);
    for (const auto& action : arm().actions.colwise()) {
      KDL::Frame frame;
      KDL::Jacobian J_kdl(static_cast<unsigned>(signals.size()));
      kinematics.JntToCart(joints(action), frame);
      derivative.JntToJac(joints(action), J_kdl);
      PoseJacobian J;
      const Pose X = arm().path.predict(action, &J);
      // KDL's: of the reference point, in the base frame.
      Eigen::MatrixXd expected = Eigen::MatrixXd::Zero(6, 7);
      for (std::size_t j = 0; j < signals.size(); ++j)
        expected.col(signals[j]) += J_kdl.data.col(static_cast<Eigen::Index>(j));
      Matrix6d turn = Matrix6d::Zero();
      turn.topLeftCorner<3, 3>() = turn.bottomRightCorner<3, 3>() = X.linear();
      double worst = (turn * J - expected).cwiseAbs().maxCoeff();
      for (int i = 0; i < 3; ++i) {
        worst = std::max(worst, std::abs(frame.p(i) - X.translation()(i)));
        for (int j = 0; j < 3; ++j)
          worst = std::max(worst, std::abs(frame.M(i, j) - X.linear()(i, j)));
      }
      if (!(worst < 1e-8))
        throw std::logic_error("KDL's arm is another: off by " + std::to_string(worst));
    }
  }
};

const KdlArm& kdl_arm() {
  static const KdlArm kdl;
  return kdl;
}

void Predict(benchmark::State& state) {
  const Eigen::MatrixXd& actions = arm().actions;
  for (Eigen::Index t = 0; auto _ : state)
    benchmark::DoNotOptimize(arm().path.predict(actions.col(t++ % actions.cols())));
}

#ifdef BODYSCHEMA_HAS_REFINER
/// The same path of a schema refined from 100 noisy samples: its joints turn and slide.
void PredictRefined(benchmark::State& state) {
  static const BodySchema schema = [] {
    const Recording run = seven_dof(100);
    return refine(learn(run.robot.signals, run.samples).schema, refiner_samples(run.samples), {},
                  {})
        .schema;
  }();
  const auto path = KinematicPath::between(schema, kRoot, kFinger);
  const Eigen::MatrixXd& actions = arm().actions;
  for (Eigen::Index t = 0; auto _ : state)
    benchmark::DoNotOptimize(path->predict(actions.col(t++ % actions.cols())));
}
BENCHMARK(PredictRefined);
#endif

void PredictByKdl(benchmark::State& state) {
  KDL::ChainFkSolverPos_recursive solver(kdl_arm().chain);
  std::vector<KDL::JntArray> actions;
  for (const auto& action : arm().actions.colwise()) actions.push_back(kdl_arm().joints(action));
  KDL::Frame frame;
  for (std::size_t t = 0; auto _ : state) {
    solver.JntToCart(actions[t++ % actions.size()], frame);
    benchmark::DoNotOptimize(frame);
  }
}

void PredictAndJacobian(benchmark::State& state) {
  const Eigen::MatrixXd& actions = arm().actions;
  PoseJacobian J;
  for (Eigen::Index t = 0; auto _ : state) {
    benchmark::DoNotOptimize(arm().path.predict(actions.col(t++ % actions.cols()), &J));
    benchmark::DoNotOptimize(J.data());
  }
}

/// KDL's solver for the Jacobian walks the chain but gives no pose: pose and Jacobian are two
/// calls.
void PredictAndJacobianByKdl(benchmark::State& state) {
  KDL::ChainFkSolverPos_recursive kinematics(kdl_arm().chain);
  KDL::ChainJntToJacSolver derivative(kdl_arm().chain);
  std::vector<KDL::JntArray> actions;
  for (const auto& action : arm().actions.colwise()) actions.push_back(kdl_arm().joints(action));
  KDL::Frame frame;
  KDL::Jacobian J(7);
  for (std::size_t t = 0; auto _ : state) {
    const KDL::JntArray& q = actions[t++ % actions.size()];
    kinematics.JntToCart(q, frame);
    derivative.JntToJac(q, J);
    benchmark::DoNotOptimize(frame);
    benchmark::DoNotOptimize(J.data.data());
  }
}

void JacobianByKdl(benchmark::State& state) {
  KDL::ChainJntToJacSolver derivative(kdl_arm().chain);
  std::vector<KDL::JntArray> actions;
  for (const auto& action : arm().actions.colwise()) actions.push_back(kdl_arm().joints(action));
  KDL::Jacobian J(7);
  for (std::size_t t = 0; auto _ : state) {
    derivative.JntToJac(actions[t++ % actions.size()], J);
    benchmark::DoNotOptimize(J.data.data());
  }
}

/// A pose of the trajectory.
void PredictTrajectory(benchmark::State& state) {
  for (auto _ : state) benchmark::DoNotOptimize(arm().path.predict_trajectory(arm().actions));
  state.SetItemsProcessed(state.iterations() * arm().actions.cols());
}

void PredictCovariance(benchmark::State& state) {
  const Eigen::MatrixXd& actions = arm().actions;
  for (Eigen::Index t = 0; auto _ : state)
    benchmark::DoNotOptimize(
        arm().path.covariance(actions.col(t++ % actions.cols()), Variance::kFirstOrder));
}

/// With the path found anew each time.
void PredictOnce(benchmark::State& state) {
  const Eigen::MatrixXd& actions = arm().actions;
  for (Eigen::Index t = 0; auto _ : state)
    benchmark::DoNotOptimize(
        arm().schema.predict(kRoot, kFinger, actions.col(t++ % actions.cols())));
}

// ---- learning

/// One screw of one signal, from its closed-form start.
void FitScrew(benchmark::State& state) {
  const Recording run = seven_dof(static_cast<int>(state.range(0)));
  const NormalizedActions actions(run.samples, 7);
  const PairData pair =
      make_pair_data(run.samples, 1, 2, MeasurementModel{}, std::numeric_limits<int>::max());
  const RelativeMotions motions = relative_motions(pair, 300);
  const Start start =
      one_joint_start(screen_one_joint(motions, actions).front(), pair, actions, motions.sigma_rad);
  for (auto _ : state) {
    const Fit fit = fit_local_model(start.model, pair, actions, 40, 1e-4);
    benchmark::DoNotOptimize(leave_one_out(fit, pair, actions));
  }
}

/// The chapter's twelve Gaussian processes of one signal, on the same poses.
void FitMatrixGp(benchmark::State& state) {
  const Recording run = seven_dof(static_cast<int>(state.range(0)));
  std::vector<double> inputs;
  std::vector<Pose> poses;
  for (const ActionPoseSample& sample : run.samples) {
    const PartObservation *from = sample.find(1), *to = sample.find(2);
    if (!from || !to) continue;
    inputs.push_back(sample.action(0));
    poses.push_back(from->X_CB.inverse() * to->X_CB);
  }
  const Eigen::Map<const Eigen::RowVectorXd> row(inputs.data(),
                                                 static_cast<Eigen::Index>(inputs.size()));
  for (auto _ : state) benchmark::DoNotOptimize(fit_matrix_gp({0}, row, poses));
}

void report(benchmark::State& state, const Recording& run, const LearnResult& result) {
  state.counters["fits"] = result.num_fits;
  state.counters["screens"] = result.num_screens;
  state.counters["signals"] = static_cast<double>(run.robot.signals.size());
  state.counters["right"] = is_right(result.schema, run.robot);
}

void learn_all(benchmark::State& state, const Recording& run) {
  LearnResult result;
  for (auto _ : state) result = learn(run.robot.signals, run.samples);
  report(state, run, result);
}

void Learn(benchmark::State& state) { learn_all(state, seven_dof(state.range(0))); }
void LearnFortyParts(benchmark::State& state) { learn_all(state, forty_parts(state.range(0))); }

/// The chapter's method, all models of all layers.
void learn_baseline_all(benchmark::State& state, const Recording& run) {
  BaselineOptions options;
  options.set_noise(nominal_noise(Regime::kTag));
  options.stop_at_first_tree = false;
  BaselineResult result;
  for (auto _ : state) result = learn_baseline(run.robot.signals, run.samples, options);
  state.counters["fits"] = result.num_fits;
  state.counters["signals"] = static_cast<double>(run.robot.signals.size());
  state.counters["right"] = is_right(result.schema, run.robot);
}
void LearnAsTheChapter(benchmark::State& state) {
  learn_baseline_all(state, seven_dof(state.range(0)));
}
void LearnFortyPartsAsTheChapter(benchmark::State& state) {
  learn_baseline_all(state, forty_parts(state.range(0)));
}

/// Sample N, with the structure found before it comes.
void LearnOneMore(benchmark::State& state) {
  const Recording run = seven_dof(state.range(0));
  SharedSamples samples;
  for (const auto& sample : run.samples)
    samples.push_back(std::make_shared<const ActionPoseSample>(sample));
  OnlineLearner online(run.robot.signals, {});
  const int before = static_cast<int>(samples.size()) - 1;
  online.prepare({samples.begin(), samples.end() - 1});
  bool is_right_one = true;
  for (auto _ : state) is_right_one &= is_right(online.learn(samples, before), run.robot);
  state.counters["right"] = is_right_one;
}

BENCHMARK(Predict);
BENCHMARK(PredictByKdl);
BENCHMARK(PredictAndJacobian);
BENCHMARK(PredictAndJacobianByKdl);
BENCHMARK(JacobianByKdl);
BENCHMARK(PredictTrajectory);
BENCHMARK(PredictCovariance);
BENCHMARK(PredictOnce);
BENCHMARK(FitScrew)->Arg(25)->Arg(100)->Unit(benchmark::kMillisecond);
BENCHMARK(FitMatrixGp)->Arg(25)->Arg(100)->Unit(benchmark::kMillisecond);
BENCHMARK(Learn)->Arg(25)->Arg(50)->Arg(100)->Arg(200)->Unit(benchmark::kMillisecond);
BENCHMARK(LearnOneMore)->Arg(25)->Arg(100)->Arg(190)->Arg(2000)->Unit(benchmark::kMillisecond);
BENCHMARK(LearnFortyParts)->Arg(5)->Arg(25)->Unit(benchmark::kMillisecond);
BENCHMARK(LearnAsTheChapter)->Arg(25)->Unit(benchmark::kMillisecond)->Iterations(1);
BENCHMARK(LearnFortyPartsAsTheChapter)  // at 25 samples it takes a quarter of an hour
    ->Arg(5)
    ->Unit(benchmark::kMillisecond)
    ->Iterations(1)
    ->Repetitions(1);

}  // namespace
}  // namespace bodyschema::test

int main(int argc, char** argv) {
  benchmark::Initialize(&argc, argv);
  bodyschema::test::kdl_arm();  // or say that it is not the same arm
  bodyschema::test::RatioReporter reporter({{"Predict", "PredictByKdl"},
                                            {"PredictRefined", "PredictByKdl"},
                                            {"PredictAndJacobian", "PredictAndJacobianByKdl"},
                                            {"PredictAndJacobian", "JacobianByKdl"},
                                            {"FitMatrixGp/25", "FitScrew/25"},
                                            {"FitMatrixGp/100", "FitScrew/100"},
                                            {"LearnAsTheChapter/25", "Learn/25"},
                                            {"LearnFortyPartsAsTheChapter/5", "LearnFortyParts/5"},
                                            {"Learn/100", "LearnOneMore/100"}});
  benchmark::RunSpecifiedBenchmarks(&reporter);
}
