// reach: how many targets solve_pose() reaches by models learned from 100 samples, and in what
// time, beside KDL's ChainIkSolverPos_NR_JL on the true arms, with as many starts, iterations and
// the same tolerance. Of positions out of reach, how far the answer is from the
// nearest point that a dense search finds; there KDL has no answer: of NR_JL the best of its last
// iterates counts, with a velocity solver that leaves the rotation free, as it is and with the
// damping by which it comes nearest, and of LMA, which knows no
// limits, the best of its results moved to the limits. Prints Markdown; exit code 1 where something must
// be reached that is not.
//
//   reach [--arms 10] [--targets 100] [--joints 7] [--seed 1]

#include <fmt/format.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <ctime>
#include <kdl/chainfksolverpos_recursive.hpp>
#include <kdl/chainiksolverpos_lma.hpp>
#include <kdl/chainiksolverpos_nr_jl.hpp>
#include <kdl/chainiksolvervel_pinv.hpp>
#include <kdl/chainiksolvervel_wdls.hpp>
#include <limits>
#include <numeric>
#include <optional>
#include <vector>

#include "common/estimation/quantile.h"
#include "common/geometry/angle.h"
#include "common/kinematics/kinematic_path.h"
#include "processes/controller/inverse_kinematics.h"
#include "processes/structure_learner/learn.h"
#include "tests/support/random_arm.h"

using namespace bodyschema;
using namespace bodyschema::test;

namespace {

constexpr Noise kNoise{0.001, 0.3 * kDegree};
constexpr int kSamples = 100, kStarts = 100, kIterations = 100;
constexpr double kTolerance = 1e-4;  // m and rad
/// By which KDL's solver comes nearest: of 0.05, 0.3, 0.6, 0.8, 1, 1.25, 1.5, 2, 3 and 10 m/rad on
/// the first two arms.
constexpr double kBestDamping = 1.25;
constexpr InverseKinematicsOptions kOptions{.tolerance_m = kTolerance,
                                            .damping_m = 0.05,
                                            .max_iterations = kIterations,
                                            .max_starts = kStarts,
                                            .tolerance_rad = kTolerance};

struct Time {
  int num_targets = 0;
  double cpu_s = 0, largest_s = 0;

  template <class Solve>
  auto of(const Solve& solve) {
    const std::clock_t start = std::clock();
    const auto result = solve();
    const double took = static_cast<double>(std::clock() - start) / CLOCKS_PER_SEC;
    ++num_targets;
    cpu_s += took;
    largest_s = std::max(largest_s, took);
    return result;
  }
  std::string mean_ms() const { return fmt::format("{:.2f}", 1e3 * cpu_s / num_targets); }
};

struct Count {
  Time time;
  int num_reached = 0;

  template <class Solve>
  void add(const Solve& solve) {
    num_reached += time.of(solve);
  }
  std::string row(const char* name) const {
    return fmt::format("| {} | {} | {:.1f} % | {} | {:.0f} |\n", name, time.num_targets,
                       100.0 * num_reached / time.num_targets, time.mean_ms(),
                       1e3 * time.largest_s);
  }
  /// So large a share, and as many as another one in no more time.
  bool reaches(double share, const Count& other) const {
    return num_reached >= share * time.num_targets && num_reached >= other.num_reached &&
           time.cpu_s <= other.time.cpu_s;
  }
};

/// Distances that answers are beyond the nearest point.
struct Farther {
  Time time;
  std::vector<double> by_m;
  /// Of answers that are asked again from there, where it was asked: in another place, by more than
  /// a tenth of a range, and farther from the target.
  std::optional<int> num_elsewhere;
  int num_farther = 0;

  std::string row(const char* name) const {
    const auto near = std::ranges::count_if(by_m, [](double m) { return m < 1e-3; });
    return fmt::format("| {} | {} | {} | {:.3f} | {:.1f} | {} | {} |\n", name, by_m.size(), near,
                       1e3 * median(by_m), 1e3 * std::ranges::max(by_m), time.mean_ms(),
                       num_elsewhere ? fmt::format("{} / {}", *num_elsewhere, num_farther) : "–");
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

  bool reaches(const Pose& X_RB) const {
    KDL::ChainFkSolverPos_recursive forward(chain_);
    KDL::ChainIkSolverVel_pinv velocity(chain_);
    KDL::ChainIkSolverPos_NR_JL solver(chain_, lower_, upper_, forward, velocity, kIterations,
                                       kTolerance);
    KDL::JntArray found(centre_.rows());
    for (int n = 0; n < kStarts; ++n)
      if (solver.CartToJnt(start(n), to_kdl(X_RB), found) >= 0) return true;
    return false;
  }
  /// NR_JL ends at a pose only: it is asked for the least number of iterations, and the position
  /// judged after each.
  bool reaches(const Eigen::Vector3d& p_RT) const {
    KDL::ChainFkSolverPos_recursive forward(chain_);
    KDL::ChainIkSolverVel_wdls velocity(chain_);
    velocity.setWeightTS(position_alone().asDiagonal().toDenseMatrix());
    velocity.setLambda(kOptions.damping_m);  // in singular directions
    KDL::ChainIkSolverPos_NR_JL solver(chain_, lower_, upper_, forward, velocity, 1, kTolerance);
    const KDL::Vector wanted(p_RT.x(), p_RT.y(), p_RT.z());
    for (int n = 0; n < kStarts; ++n) {
      KDL::JntArray at = start(n), next(centre_.rows());
      KDL::Frame X_RB;
      for (int i = 0; i <= kIterations; ++i) {
        forward.JntToCart(at, X_RB);
        if ((X_RB.p - wanted).Norm() <= kTolerance) return true;
        solver.CartToJnt(at, KDL::Frame(X_RB.M, wanted), next);
        at = next;
      }
    }
    return false;
  }
  /// Of the last iterates. `damping` [m/rad]: of the velocity solver, in singular directions or
  /// everywhere.
  double nearest_by_nr_jl_m(const Eigen::Vector3d& p_RT, double damping, bool everywhere) const {
    KDL::ChainFkSolverPos_recursive forward(chain_);
    KDL::ChainIkSolverVel_wdls velocity(chain_);
    velocity.setWeightTS(position_alone().asDiagonal().toDenseMatrix());
    velocity.setLambda(damping);
    if (everywhere) velocity.setEps(std::numeric_limits<double>::max());
    KDL::ChainIkSolverPos_NR_JL solver(chain_, lower_, upper_, forward, velocity, kIterations,
                                       kTolerance);
    return nearest_m(solver, p_RT);
  }
  /// Of the results at the nearest angles within the limits.
  double nearest_by_lma_m(const Eigen::Vector3d& p_RT) const {
    KDL::ChainIkSolverPos_LMA solver(chain_, position_alone(), kTolerance, kIterations);
    return nearest_m(solver, p_RT);
  }

 private:
  static Eigen::Matrix<double, 6, 1> position_alone() {
    return (Eigen::Matrix<double, 6, 1>() << 1, 1, 1, 0, 0, 0).finished();
  }
  KDL::JntArray start(int n) const {
    KDL::JntArray start = centre_;
    Rng rng(static_cast<Rng::result_type>(n));
    for (unsigned d = 0; n > 0 && d < start.rows(); ++d)
      start(d) = uniform(rng, lower_(d), upper_(d));
    return start;
  }
  double nearest_m(KDL::ChainIkSolverPos& solver, const Eigen::Vector3d& p_RT) const {
    KDL::ChainFkSolverPos_recursive forward(chain_);
    const KDL::Vector wanted(p_RT.x(), p_RT.y(), p_RT.z());
    double nearest = std::numeric_limits<double>::infinity();
    for (int n = 0; n < kStarts; ++n) {
      KDL::JntArray found(centre_.rows());
      solver.CartToJnt(start(n), KDL::Frame(wanted), found);
      for (unsigned d = 0; d < found.rows(); ++d) {
        const double turned = std::remainder(found(d) - centre_(d), 2 * M_PI);
        found(d) = std::clamp(centre_(d) + turned, lower_(d), upper_(d));
      }
      KDL::Frame X_RB;
      forward.JntToCart(found, X_RB);
      if (const double left = (X_RB.p - wanted).Norm(); left < nearest) nearest = left;
    }
    return nearest;
  }

  KDL::Chain chain_;
  KDL::JntArray lower_, upper_, centre_;
};

/// The nearest that a part comes to a position: of many actions over the ranges and at their ends,
/// the best go downhill one signal at a time.
class DenseSearch {
 public:
  DenseSearch(const BodySchema& schema, int part, Rng& rng)
      : path_(*KinematicPath::between(schema, schema.root, part)),
        signals_(schema.signals),
        shares_(static_cast<Eigen::Index>(signals_.size()), kActions),
        positions_m_(3, kActions) {
    for (Eigen::Index n = 0; n < kActions; ++n) {
      for (double& share : shares_.col(n)) {
        const double drawn = n % 2 ? uniform(rng, 0, 1) : uniform(rng, -0.3, 1.3);
        share = std::clamp(drawn, 0.0, 1.0);
      }
      positions_m_.col(n) = position_m(shares_.col(n));
    }
  }

  double nearest_m(const Eigen::Vector3d& p_RT) const {
    const Eigen::VectorXd left_m = (positions_m_.colwise() - p_RT).colwise().norm();
    std::vector<Eigen::Index> best(kActions);
    std::iota(best.begin(), best.end(), 0);
    std::ranges::partial_sort(best, best.begin() + kRefined, {},
                              [&](Eigen::Index n) { return left_m[n]; });
    double nearest = left_m[best[0]];
    for (int n = 0; n < kRefined; ++n)
      nearest = std::min(nearest, downhill(shares_.col(best[static_cast<std::size_t>(n)]), p_RT));
    return nearest;
  }

 private:
  static constexpr Eigen::Index kActions = 100'000;
  static constexpr int kRefined = 30;

  Eigen::Vector3d position_m(Eigen::VectorXd share) const {
    for (std::size_t s = 0; s < signals_.size(); ++s) {
      double& value = share[static_cast<Eigen::Index>(s)];
      value = signals_[s].lower + value * (signals_[s].upper - signals_[s].lower);
    }
    return path_.predict(share).translation();
  }
  double downhill(Eigen::VectorXd share, const Eigen::Vector3d& p_RT) const {
    double left_m = (position_m(share) - p_RT).norm();
    for (double step = 0.02; step > 1e-5;) {
      bool is_nearer = false;
      for (double& value : share) {
        for (const double other : {value - step, value + step}) {
          const double before = std::exchange(value, std::clamp(other, 0.0, 1.0));
          const double there_m = (position_m(share) - p_RT).norm();
          if (there_m < left_m - 1e-9) {
            left_m = there_m;
            is_nearer = true;
          } else {
            value = before;
          }
        }
      }
      if (!is_nearer) step /= 2;
    }
    return left_m;
  }

  KinematicPath path_;
  std::vector<Signal> signals_;
  Eigen::MatrixXd shares_;
  Eigen::Matrix3Xd positions_m_;
};

/// How far the farthest of many actions brings the part [m].
double reach_of(const BodySchema& schema, int part, const SyntheticRobot& robot, Rng& rng) {
  double farthest = 0;
  for (int n = 0; n < 1000; ++n)
    farthest = std::max(farthest, target_at(schema, part, robot.random_action(rng)).p_RT.norm());
  return farthest;
}

/// A point at least 20 mm from where any action brings the part, but within its reach: behind a
/// limit, or in a hollow. None if none is found.
std::optional<Eigen::Vector3d> hollow(const DenseSearch& dense, double reach_m, Rng& rng) {
  constexpr double kOff_m = 0.02;
  for (int n = 0; n < 1000; ++n) {
    const Eigen::Vector3d p_RT = random_vector(rng, 0, 0.9 * reach_m);
    if (dense.nearest_m(p_RT) > kOff_m) return p_RT;
  }
  return std::nullopt;
}

struct OutOfReach {
  Farther learned, true_arm, by_nr_jl, by_damped_nr_jl, by_lma;

  /// solve_pose() on one arm; the least distance that anything finds there.
  static double solve(const BodySchema& schema, int part, const Eigen::Vector3d& p_RT,
                      double nearest_m, Farther* farther) {
    const auto answer = [&](const Eigen::VectorXd& current) {
      return solve_pose(schema, part, {.p_RT = p_RT}, schema.signals, current, kOptions);
    };
    const Eigen::VectorXd centre = centre_of(schema.signals);
    const auto solution = farther->time.of([&] { return answer(centre); });
    const auto again = answer(solution.action);
    double moved = 0;
    for (std::size_t s = 0; s < schema.signals.size(); ++s) {
      const auto n = static_cast<Eigen::Index>(s);
      moved = std::max(moved, std::abs(again.action[n] - solution.action[n]) /
                                  (schema.signals[s].upper - schema.signals[s].lower));
    }
    farther->num_elsewhere = farther->num_elsewhere.value_or(0) + (moved > 0.1);
    farther->num_farther += again.error_m > solution.error_m + 1e-9;
    farther->by_m.push_back(solution.error_m);
    return std::min({nearest_m, solution.error_m, again.error_m});
  }
  void add(const BodySchema& schema, const DenseSearch& dense, const BodySchema& truth,
           const DenseSearch& true_dense, const KdlArm& kdl, int hand,
           const Eigen::Vector3d& p_RT) {
    const double nearest_m = solve(schema, hand, p_RT, dense.nearest_m(p_RT), &learned);
    learned.by_m.back() -= nearest_m;
    double true_m = solve(truth, hand, p_RT, true_dense.nearest_m(p_RT), &true_arm);
    const auto by_kdl = [&](const auto& nearest_m, Farther* farther) {
      farther->by_m.push_back(farther->time.of(nearest_m));
      true_m = std::min(true_m, farther->by_m.back());
    };
    by_kdl([&] { return kdl.nearest_by_nr_jl_m(p_RT, kOptions.damping_m, false); }, &by_nr_jl);
    by_kdl([&] { return kdl.nearest_by_nr_jl_m(p_RT, kBestDamping, true); }, &by_damped_nr_jl);
    by_kdl([&] { return kdl.nearest_by_lma_m(p_RT); }, &by_lma);
    for (Farther* farther : {&true_arm, &by_nr_jl, &by_damped_nr_jl, &by_lma})
      farther->by_m.back() -= true_m;
  }
  void print(const char* name) const {
    fmt::print(
        "\n| positions {} | number | within 1 mm of the nearest | farther, median [mm] | "
        "worst [mm] | ms of CPU, mean | asked again from there: elsewhere / farther |\n"
        "|---|---|---|---|---|---|---|\n{}{}{}{}{}",
        name, learned.row("learned arm"), true_arm.row("true arm"),
        by_nr_jl.row("true arm, KDL's NR_JL: the best last iterate"),
        by_damped_nr_jl.row(
            fmt::format("the same, damped everywhere by {} m/rad", kBestDamping).c_str()),
        by_lma.row("true arm, KDL's LMA: the best, moved to the limits"));
  }
  /// All are within 1 mm of the nearest point, and stay so.
  bool is_met() const {
    const auto is_near = [](double m) { return m < 1e-3; };
    return std::ranges::all_of(learned.by_m, is_near) &&
           std::ranges::all_of(true_arm.by_m, is_near) && learned.num_farther == 0 &&
           true_arm.num_farther == 0;
  }
};

}  // namespace

int main(int argc, char** argv) {
  int num_arms = 10, num_targets = 100, num_joints = 7, first_seed = 1;
  CLI::App app("Targets that solve_pose() reaches");
  app.add_option("--arms", num_arms, "Each learned from 100 samples")->check(CLI::PositiveNumber);
  app.add_option("--targets", num_targets, "An arm and kind")->check(CLI::PositiveNumber);
  app.add_option("--joints", num_joints, "Of each arm")->check(CLI::Range(1, 10));
  app.add_option("--seed", first_seed, "Of the first arm");
  CLI11_PARSE(app, argc, argv);

  Count positions, poses, positions_of_kdl, poses_of_kdl;
  OutOfReach beyond, hollows;
  int num_not_learned = 0;
  for (int seed = first_seed; seed < first_seed + num_arms; ++seed) {
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
    const KdlArm kdl(robot.true_edge(base, hand), robot.signals);
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
      poses_of_kdl.add([&] { return kdl.reaches(X); });
      positions_of_kdl.add([&] { return kdl.reaches(X.translation().eval()); });
    }
    const DenseSearch dense(schema, hand, rng), true_dense(truth, hand, rng);
    const double reach_m = reach_of(schema, hand, robot, rng);
    for (int n = 0; n < num_targets; ++n) {
      beyond.add(schema, dense, truth, true_dense, kdl, hand,
                 random_vector(rng, 1.2 * reach_m, 2 * reach_m));
      if (const auto p_RT = hollow(dense, reach_m, rng))
        hollows.add(schema, dense, truth, true_dense, kdl, hand, *p_RT);
    }
  }
  fmt::print("| targets | number | reached | ms of CPU, mean | largest |\n|---|---|---|---|---|\n");
  fmt::print("{}{}{}{}", positions.row("positions"),
             positions_of_kdl.row("positions, KDL on the true arm"), poses.row("full poses"),
             poses_of_kdl.row("full poses, KDL on the true arm"));
  beyond.print("beyond reach");
  hollows.print("within reach, but not reached: behind limits, in hollows");
  fmt::print("\n{} of {} arms were not learned.\n", num_not_learned, num_arms);
  const bool is_met = num_not_learned == 0 && positions.reaches(0.999, positions_of_kdl) &&
                      poses.reaches(0.99, poses_of_kdl) && beyond.is_met() && hollows.is_met();
  return is_met ? 0 : 1;
}
