// reach: how many targets solve_pose() reaches by models learned from 100 samples, and in what
// time; full poses beside KDL's ChainIkSolverPos_NR_JL on the true arms, with as many starts,
// iterations and the same tolerance. Targets out of reach beside the nearest of ten times as many
// starts. Prints Markdown.
//
//   reach [--arms 10] [--targets 100] [--joints 7]

#include <fmt/format.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <ctime>
#include <kdl/chainfksolverpos_recursive.hpp>
#include <kdl/chainiksolverpos_nr_jl.hpp>
#include <kdl/chainiksolvervel_pinv.hpp>
#include <vector>

#include "common/estimation/quantile.h"
#include "common/geometry/angle.h"
#include "processes/controller/inverse_kinematics.h"
#include "processes/structure_learner/learn.h"
#include "tests/support/random_arm.h"

using namespace bodyschema;
using namespace bodyschema::test;

namespace {

constexpr Noise kNoise{0.001, 0.3 * kDegree};
constexpr int kSamples = 100, kStarts = 100, kIterations = 100;
constexpr double kTolerance = 1e-4;  // m and rad
constexpr InverseKinematicsOptions kOptions{.tolerance_m = kTolerance,
                                            .damping_m = 0.05,
                                            .max_iterations = kIterations,
                                            .max_starts = kStarts,
                                            .tolerance_rad = kTolerance};

struct Count {
  int num_targets = 0, num_reached = 0;
  double cpu_s = 0, largest_s = 0;

  template <class Solve>
  void add(const Solve& solve) {
    const std::clock_t start = std::clock();
    num_reached += solve();
    const double took = static_cast<double>(std::clock() - start) / CLOCKS_PER_SEC;
    ++num_targets;
    cpu_s += took;
    largest_s = std::max(largest_s, took);
  }
  std::string row(const char* name) const {
    return fmt::format("| {} | {} | {:.1f} % | {:.2f} | {:.0f} |\n", name, num_targets,
                       100.0 * num_reached / num_targets, 1e3 * cpu_s / num_targets,
                       1e3 * largest_s);
  }
};

Eigen::VectorXd centre_of(const std::vector<Signal>& signals) {
  Eigen::VectorXd centre(static_cast<Eigen::Index>(signals.size()));
  for (std::size_t s = 0; s < signals.size(); ++s)
    centre(static_cast<Eigen::Index>(s)) = 0.5 * (signals[s].lower + signals[s].upper);
  return centre;
}

PoseTarget target_at(const BodySchema& schema, int part, const Eigen::VectorXd& action) {
  const Pose X_RB = schema.predict(schema.root, part, action)->X_AB;
  return {X_RB.translation(), Eigen::Quaterniond(X_RB.linear())};
}

KDL::Frame to_kdl(const Pose& X) {
  const Eigen::Quaterniond q(X.linear());
  const Eigen::Vector3d p = X.translation();
  return {KDL::Rotation::Quaternion(q.x(), q.y(), q.z(), q.w()), {p.x(), p.y(), p.z()}};
}

/// The hand of an arm in its base, an angle a joint.
class KdlArm {
 public:
  KdlArm(const Edge& edge, const std::vector<Signal>& signals)
      : lower_(static_cast<unsigned>(edge.joints.size())), upper_(lower_), centre_(lower_) {
    chain_.addSegment(KDL::Segment(KDL::Joint(KDL::Joint::None), to_kdl(edge.left)));
    for (unsigned d = 0; d < edge.joints.size(); ++d) {
      const ScrewJoint& joint = edge.joints[d];
      const bool is_last = d + 1 == edge.joints.size();
      chain_.addSegment(KDL::Segment(KDL::Joint(KDL::Joint::RotZ),
                                     to_kdl(is_last ? joint.X_after * edge.right : joint.X_after)));
      const Signal& signal = signals[static_cast<std::size_t>(joint.signal)];
      const auto angle = [&](double q) { return joint.turn * (joint.gain * q + joint.offset); };
      lower_(d) = std::min(angle(signal.lower), angle(signal.upper));
      upper_(d) = std::max(angle(signal.lower), angle(signal.upper));
      centre_(d) = 0.5 * (lower_(d) + upper_(d));
    }
  }

  bool reaches(const Pose& X_RB) {
    KDL::ChainFkSolverPos_recursive forward(chain_);
    KDL::ChainIkSolverVel_pinv velocity(chain_);
    KDL::ChainIkSolverPos_NR_JL solver(chain_, lower_, upper_, forward, velocity, kIterations,
                                       kTolerance);
    KDL::JntArray start = centre_, found(centre_.rows());
    for (int n = 0; n < kStarts; ++n) {
      if (n > 0) {
        Rng rng(static_cast<Rng::result_type>(n));
        for (unsigned d = 0; d < start.rows(); ++d) start(d) = uniform(rng, lower_(d), upper_(d));
      }
      if (solver.CartToJnt(start, to_kdl(X_RB), found) >= 0) return true;
    }
    return false;
  }

 private:
  KDL::Chain chain_;
  KDL::JntArray lower_, upper_, centre_;
};

/// A point that no action of an arm reaches: well beyond the farthest of many.
Eigen::Vector3d beyond_reach(const BodySchema& schema, int part, const SyntheticRobot& robot,
                             Rng& rng) {
  double farthest = 0;
  for (int n = 0; n < 1000; ++n)
    farthest = std::max(farthest, target_at(schema, part, robot.random_action(rng)).p_RT.norm());
  return random_vector(rng, 1.2 * farthest, 2 * farthest);
}

}  // namespace

int main(int argc, char** argv) {
  int num_arms = 10, num_targets = 100, num_joints = 7;
  CLI::App app("Targets that solve_pose() reaches");
  app.add_option("--arms", num_arms, "Each learned from 100 samples")->check(CLI::PositiveNumber);
  app.add_option("--targets", num_targets, "An arm and kind")->check(CLI::PositiveNumber);
  app.add_option("--joints", num_joints, "Of each arm")->check(CLI::Range(1, 10));
  CLI11_PARSE(app, argc, argv);

  Count positions, poses, of_kdl;
  std::vector<double> farther_m;
  int num_not_learned = 0;
  for (int seed = 1; seed <= num_arms; ++seed) {
    Rng rng(static_cast<Rng::result_type>(seed));
    const SyntheticRobot robot = random_arm({.num_joints = num_joints, .share_sliding = 0}, rng);
    LearnOptions learning;
    learning.measurement.noise = kNoise;
    const BodySchema schema =
        learn(robot.signals, noisy_babble(robot, kSamples, kNoise, rng), learning).schema;
    const int base = 1, hand = num_joints + 1;
    if (!schema.complete) {
      ++num_not_learned;
      continue;
    }
    const BodySchema truth = true_schema(robot);
    KdlArm kdl(robot.true_edge(base, hand), robot.signals);
    const Eigen::VectorXd centre = centre_of(schema.signals);
    const auto reaches = [&](const PoseTarget& target) {
      return solve_pose(schema, hand, target, schema.signals, centre, kOptions).is_within_tolerance;
    };
    for (int n = 0; n < num_targets; ++n) {
      const Eigen::VectorXd action = robot.random_action(rng);
      const PoseTarget target = target_at(schema, hand, action);
      positions.add([&] { return reaches({.p_RT = target.p_RT}); });
      poses.add([&] { return reaches(target); });
      const auto X = truth.predict(base, hand, action)->X_AB;
      of_kdl.add([&] { return kdl.reaches(X); });
    }
    InverseKinematicsOptions more = kOptions;
    more.max_starts = 10 * kStarts;
    for (int n = 0; n < num_targets; ++n) {
      const PoseTarget target{.p_RT = beyond_reach(schema, hand, robot, rng)};
      const auto nearest = [&](const InverseKinematicsOptions& options) {
        return solve_pose(schema, hand, target, schema.signals, centre, options).error_m;
      };
      farther_m.push_back(nearest(kOptions) - nearest(more));
    }
  }
  fmt::print("| targets | number | reached | ms of CPU, mean | largest |\n|---|---|---|---|---|\n");
  fmt::print("{}{}{}", positions.row("positions"), poses.row("full poses"),
             of_kdl.row("full poses, KDL on the true arm"));
  fmt::print(
      "\nOf {} positions out of reach {} are met within 1 mm of the nearest of ten times as many "
      "starts, the worst within {:.1f} mm. {} of {} arms were not learned.\n",
      farther_m.size(),
      std::count_if(farther_m.begin(), farther_m.end(), [](double m) { return m < 1e-3; }),
      1e3 * *std::max_element(farther_m.begin(), farther_m.end()), num_not_learned, num_arms);
}
