// What the refiner's accuracy and cost depend on: joints that give way to gravity, bent commands,
// the numbers of samples and of parts. Prints Markdown.
//
//   refinement_limits elastic [--robots 30]
//   refinement_limits bend [--robots 30] [--kinds a c]
//   refinement_limits cost

#include <CLI/CLI.hpp>
#include <cmath>
#include <cstdio>
#include <ctime>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "common/estimation/chi_square.h"
#include "common/estimation/evaluation.h"
#include "common/estimation/quantile.h"
#include "common/geometry/angle.h"
#include "processes/refiner/refine.h"
#include "processes/refiner/refinement_problem.h"
#include "processes/structure_learner/learn.h"
#include "tests/experiments/figures/robots.h"
#include "tests/processes/refiner/tagged_robot.h"
#include "tests/support/elastic_arm.h"

using namespace bodyschema;

namespace {

/// Off by 5 mm and 1° per axis, 1 σ.
Pose as_built(const Pose& X, test::Rng& rng) {
  Vector6d step = test::gaussian6(rng);
  step.head<3>() *= 0.005;
  step.tail<3>() *= kDegree;
  return X * exp(step);
}

// ---- joints that give way

/// The schema of an arm as built, between base and hand, of which positions alone are seen.
BodySchema arm_as_built(const test::SyntheticRobot& robot, test::Rng& rng) {
  const int base = robot.links.front().part, hand = robot.links.back().part;
  BodySchema schema = test::true_schema(robot);
  schema.X_CR = robot.X_CR;
  schema.parts = {base, hand};
  schema.position_parts = {hand};
  schema.edges = {robot.true_edge(base, hand)};
  schema.edges[0].left = as_built(schema.edges[0].left, rng);
  for (ScrewJoint& joint : schema.edges[0].joints) joint.X_after = as_built(joint.X_after, rng);
  return schema;
}

struct ElasticRow {
  double noise = 0, stiff = 0, elastic = 0, sigmas = 0;  ///< sums of squares
  int num = 0, num_joints = 0, num_likelier = 0, num_undetermined = 0;
  double seconds = 0;

  void add(double droop_m, int num_samples, int seed) {
    test::Rng rng(seed);
    const test::ElasticArm arm = test::elastic_arm(7, droop_m, rng);
    const BodySchema built = arm_as_built(arm.robot, rng);
    constexpr int kHeldOut = 100;
    auto samples = test::with_positions_alone(test::babble(arm, num_samples + kHeldOut, rng),
                                              {arm.robot.links.back().part});
    for (int n = 0; n < kHeldOut; ++n) {
      ActionPoseSample& sample = samples[num_samples + n];
      sample.purpose = Purpose::kTest;
      for (const PartObservation& seen : sample.parts) {
        noise += seen.covariance.topLeftCorner<3, 3>().trace();
        ++num;
      }
    }
    RefineOptions options;
    options.joint_loads = [&](const Eigen::VectorXd& action) {
      return arm.loads(built.edges[0], action);
    };
    const std::clock_t begin = std::clock();
    const Refinement result = refine(built, refiner_samples(samples), {}, options);
    seconds += static_cast<double>(std::clock() - begin) / CLOCKS_PER_SEC;
    const auto squares = [](const Elasticity::Errors& errors) {
      const PartErrors& part = errors.held_out.at(0);
      return part.count * part.position_rms_m * part.position_rms_m;
    };
    stiff += squares(result.elasticity->stiff);
    elastic += squares(result.elasticity->elastic);
    num_likelier += result.elasticity->evidence > 0 ? 1 : 0;
    num_undetermined += static_cast<int>(result.undetermined.size());
    for (int d = 0; d < 7; ++d) {
      const JointCompliance& joint = result.elasticity->joints[d];
      if (joint.sd == 0) continue;
      sigmas += std::pow((joint.value - arm.compliance_rad_per_Nm(d)) / joint.sd, 2);
      ++num_joints;
    }
  }
  void print(double droop_m, int num_samples, int num_robots) const {
    const auto rms_mm = [&](double sum) { return 1e3 * std::sqrt(sum / num); };
    std::printf("| %.0f | %d | %d | %.3f | %.3f | %.2f | %.3f | %.2f | %d | %.2f | %d | %.0f |\n",
                droop_m * 1e3, num_samples, num_robots, rms_mm(noise), rms_mm(stiff),
                std::sqrt(stiff / noise), rms_mm(elastic), std::sqrt(elastic / noise), num_likelier,
                std::sqrt(sigmas / std::max(num_joints, 1)), num_undetermined,
                1e3 * seconds / num_robots);
    std::fflush(stdout);
  }
};

void run_elastic(int num_robots) {
  std::printf(
      "Arms of seven joints as built (off by 5 mm and 1° per axis and link), whose hand alone is "
      "seen, its position alone, in tag noise; joints give way to gravity, the hand by so much at "
      "most. Rms over robots and 100 held-out samples of observed minus predicted position; "
      "compliances: rms of their errors in standard deviations; robots where joints that give way "
      "are likelier than stiff ones (BIC).\n\n"
      "| droop mm | N | robots | noise mm | stiff mm | stiff / noise | elastic mm | elastic / "
      "noise "
      "| likelier | compliances σ | undetermined | ms |\n"
      "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |\n");
  for (const auto& [droop_m, num_samples] :
       {std::pair{0.0, 200}, {0.005, 200}, {0.02, 60}, {0.02, 100}, {0.02, 200}}) {
    ElasticRow row;
    for (int seed = 1; seed <= num_robots; ++seed) row.add(droop_m, num_samples, seed);
    row.print(droop_m, num_samples, num_robots);
  }
}

// ---- bent commands

/// Of the robots with straight commands, or of those with bent ones.
struct BendErrors {
  double squares = 0;
  int num_inside = 0, num = 0;  ///< of the ellipsoids of 95 %
  int num_found = 0;            ///< bends where the start had none

  void add(const Refinement& result, const experiments::Trial& trial) {
    const double limit = chi_square_quantile(6, 0.05);
    num_found += static_cast<int>(result.bends.size());
    for (const Eigen::VectorXd& action : trial.test_actions) {
      const auto truth = trial.robot.poses_in_camera(action);
      const auto predicted = result.schema.predict(trial.root(), trial.end_effector(), action);
      const Vector6d error = log(predicted->X_AB.inverse() * (truth.at(trial.root()).inverse() *
                                                              truth.at(trial.end_effector())));
      squares += error.head<3>().squaredNorm();
      num_inside += squared_mahalanobis(error, predicted->covariance) < limit ? 1 : 0;
      ++num;
    }
  }
  double rms_mm() const { return 1e3 * std::sqrt(squares / std::max(num, 1)); }
  double coverage() const { return 100.0 * num_inside / std::max(num, 1); }
};

/// Where the refinement begins: as learned, if that is right, or as built.
std::optional<BodySchema> start_of(const experiments::Trial& trial, bool is_learned, int seed) {
  if (is_learned) {
    BodySchema schema = learn(trial.robot.signals, trial.samples).schema;
    if (!test::is_right(schema, trial.robot)) return std::nullopt;
    return schema;
  }
  test::Rng rng(seed);
  BodySchema schema = test::true_schema(trial.robot);
  schema.X_CR = as_built(trial.robot.X_CR, rng);
  for (Edge& edge : schema.edges) {
    edge.left = as_built(edge.left, rng);
    for (ScrewJoint& joint : edge.joints) joint.X_after = as_built(joint.X_after, rng);
  }
  return schema;
}

/// Of one kind of robot, straight and bent: robots with a start in both.
void compare_bend(const std::string& kind, bool is_learned, int num_samples, int num_robots) {
  BendErrors straight, bent;
  int num_right = 0;
  for (int seed = 1; seed <= num_robots; ++seed) {
    const auto trial_of = [&](double bend) {
      return experiments::make_trial(kind, test::Regime::kTag, num_samples, seed, bend);
    };
    const experiments::Trial straight_trial = trial_of(0), bent_trial = trial_of(0.1);
    const auto straight_start = start_of(straight_trial, is_learned, seed);
    const auto bent_start = start_of(bent_trial, is_learned, seed);
    if (!straight_start || !bent_start) continue;
    ++num_right;
    straight.add(refine(*straight_start, refiner_samples(straight_trial.samples), {}, {}),
                 straight_trial);
    bent.add(refine(*bent_start, refiner_samples(bent_trial.samples), {}, {}), bent_trial);
  }
  std::printf("| %s | %s | %d | %d of %d | %.3f | %.3f | %.2f | %.1f | %.1f | %d | %d |\n",
              kind.c_str(), is_learned ? "as learned" : "as built", num_samples, num_right,
              num_robots, straight.rms_mm(), bent.rms_mm(), bent.rms_mm() / straight.rms_mm(),
              straight.coverage(), bent.coverage(), straight.num_found, bent.num_found);
  std::fflush(stdout);
}

void run_bend(const std::vector<std::string>& kinds, int num_robots) {
  std::printf(
      "Robots whose joints go to q + 0.1 sin 3q, beside the same whose joints go to q; tag noise. "
      "The refinement begins with the learned schema where its structure is right in both, or with "
      "a model as built, off by 5 mm and 1° per axis, whose commands are straight. Rms over robots "
      "and test poses of the end effector's position; coverage of the predicted ellipsoids of "
      "95 %%; bends found that the start did not have.\n\n"
      "| robot | start | N | robots | straight mm | bent mm | bent / straight | coverage straight "
      "%% "
      "| coverage bent %% | found straight | found bent |\n"
      "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |\n");
  for (const std::string& kind : kinds)
    for (const bool is_learned : {true, false})
      for (const int size : {30, 100}) compare_bend(kind, is_learned, size, num_robots);
}

// ---- cost

/// Seconds of processor time, the least of three.
double cost_of(const std::function<void()>& run) {
  double least = INFINITY;
  for (int n = 0; n < 3; ++n) {
    const std::clock_t begin = std::clock();
    run();
    least = std::min(least, static_cast<double>(std::clock() - begin) / CLOCKS_PER_SEC);
  }
  return least;
}

/// Milliseconds: of the fit alone, of the whole answer.
struct Cost {
  double fit_ms = 0, all_ms = 0;
  int num_iterations = 0;
};

Cost cost_of(const BodySchema& schema, const std::vector<RefinerSample>& samples,
             const std::optional<RigCalibration>& rig, const RefineOptions& options) {
  Cost cost;
  cost.fit_ms = 1e3 * cost_of([&] {
                  RefinementProblem problem(schema, samples, rig, options, false);
                  problem.solve();
                  cost.num_iterations = problem.num_iterations();
                });
  cost.all_ms = 1e3 * cost_of([&] { refine(schema, samples, rig, options); });
  return cost;
}

void print_cost(const std::string& body, int num_samples, const test::RandomTreeOptions& tree) {
  test::Rng rng(1);
  const test::SyntheticRobot robot = test::random_tree(tree, rng);
  BodySchema schema = test::true_schema(robot);
  schema.X_CR = robot.X_CR;
  RefineOptions poses;
  poses.config.max_samples = 100'000;
  const auto samples = refiner_samples(test::babble(
      robot, num_samples, {.regime = test::Regime::kTag, .with_covariances = true}, rng));
  const Cost of_poses = cost_of(schema, samples, {}, poses);
  RefineOptions corners = poses;
  corners.placements = corners.intrinsics = true;
  const test::TaggedRobot tagged = test::tagged(robot, 2, rng);
  const RigCalibration claimed = test::claimed(tagged, {.tags = {5e-4, 0.3 * kDegree, 3e-3}}, rng);
  const auto seen = test::seen_corners(tagged, claimed, num_samples, 0.05, rng);
  const Cost of_corners = cost_of(schema, seen, claimed, corners);
  std::printf("| %s | %d | %d |", body.c_str(), tree.num_parts, num_samples);
  for (const Cost& cost : {of_poses, of_corners})
    std::printf(" %.0f | %d | %.1f | %.0f |", cost.fit_ms, cost.num_iterations,
                1e3 * cost.fit_ms / cost.num_iterations / num_samples / tree.num_parts,
                cost.all_ms);
  std::printf("\n");
  std::fflush(stdout);
}

void run_cost() {
  std::printf(
      "Bodies from the true structure, processor time of one core, the least of three: the fit, "
      "and the whole answer with covariances and wanted actions. Poses; corners of two tags a part "
      "with placements and intrinsics, where each joint may be off its command at each sample.\n\n"
      "| body | parts | N | poses: fit ms | iterations | µs / (iteration · N · part) | answer ms | "
      "corners: fit ms | iterations | µs / (iteration · N · part) | answer ms |\n"
      "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |\n");
  for (const int num_samples : {50, 100, 200, 400})
    print_cost("tree", num_samples, {.num_parts = 8});
  for (const int num_limbs : {1, 2, 4, 8})
    print_cost("limbs of 4", 100, {.num_parts = 1 + 4 * num_limbs, .limb_length = 4});
  for (const int num_parts : {4, 16, 32}) print_cost("tree", 100, {.num_parts = num_parts});
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app("what the refiner's accuracy and cost depend on");
  app.require_subcommand(1);
  int num_robots = 30;
  CLI::App* elastic = app.add_subcommand("elastic", "joints that give way to gravity");
  elastic->add_option("--robots", num_robots);
  CLI::App* bend = app.add_subcommand("bend", "bent commands");
  bend->add_option("--robots", num_robots);
  std::vector<std::string> kinds = {"a", "c"};
  bend->add_option("--kinds", kinds, "chapter_robot()");
  CLI::App* cost = app.add_subcommand("cost", "against samples and parts");
  CLI11_PARSE(app, argc, argv);
  if (*elastic) run_elastic(num_robots);
  if (*bend) run_bend(kinds, num_robots);
  if (*cost) run_cost();
}
