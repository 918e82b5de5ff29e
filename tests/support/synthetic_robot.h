#pragma once

#include <cmath>
#include <map>
#include <ostream>
#include <random>
#include <set>
#include <string>
#include <vector>

#include "common/schema/body_schema.h"
#include "common/schema/sample.h"
#include "tests/support/chain_judgement.h"

namespace bodyschema::test {

using Rng = std::mt19937_64;

double uniform(Rng& rng, double low, double high);
double gaussian(Rng& rng);
Vector6d gaussian6(Rng& rng);
Eigen::Matrix3d random_rotation(Rng& rng);
/// A vector of uniform direction, its length uniform in [min_m, max_m].
Eigen::Vector3d random_vector(Rng& rng, double min_m, double max_m);
/// Uniform rotation, translation of a length in [min_m, max_m].
Pose random_pose(Rng& rng, double min_m, double max_m);
/// Within the signals' limits.
Eigen::VectorXd random_action(const std::vector<Signal>& signals, Rng& rng);
/// ∂pose/∂q of `predict`, 6×|q|, right perturbation, by central differences.
template <typename Predict>
Eigen::MatrixXd numeric_jacobian(const Predict& predict, const Eigen::VectorXd& q,
                                 double h = 1e-6) {
  Eigen::MatrixXd J(6, q.size());
  const Pose inverse = predict(q).inverse();
  for (Eigen::Index n = 0; n < q.size(); ++n) {
    const Eigen::VectorXd step = h * Eigen::VectorXd::Unit(q.size(), n);
    J.col(n) = (log(inverse * predict(q + step)) - log(inverse * predict(q - step))) / (2 * h);
  }
  return J;
}

/// A screw edge of these signals, all its parameters, their covariance and its residuals random.
Edge random_edge(int from, int to, const std::vector<int>& signals, Rng& rng);

/// A body part with the joint that carries it: X_PB(q) = X_before · Exp(screw · θ) · X_after with
/// θ = turn_or_slide · (q − zero). `signal` −1: fixed.
struct TrueLink {
  int part = 0;
  int parent = -1;  ///< part id; −1: this is the base, fixed in front of the camera
  Pose X_before = Pose::Identity();
  Pose X_after = Pose::Identity();
  int signal = -1;
  double turn = 0;   ///< [rad per command unit] about the joint's z axis
  double slide = 0;  ///< [m per command unit] along it
  double zero = 0;   ///< command at which the joint is at rest [command units]
  double wear = 0;   ///< the joint goes by wear · sin(3q) farther [command units]
  int also = -1;     ///< another signal that moves the joint: also_gain times as far
  double also_gain = 0;
  Vector6d sag = Vector6d::Zero();  ///< its load is bent by Exp(sag · q²)
  bool hidden = false;
};

/// Ground truth that no learner sees.
struct SyntheticRobot {
  std::string name;
  std::vector<Signal> signals;
  std::vector<TrueLink> links;  ///< parents before children
  /// Commands are bent: joints go to θ = q + bend · sin(3q) [command units].
  double bend = 0;
  Pose X_CR = Pose::Identity();

  std::map<int, Pose> poses_in_camera(const Eigen::VectorXd& action) const;
  /// The chain of joints between two parts, without noise; of straight commands.
  Edge true_edge(int from, int to) const;
  /// The signal of every moving joint on the path between two parts, in the order of the path.
  std::vector<int> path_joints(int part_a, int part_b) const;
  /// Signals of the joints on the path between two parts.
  std::set<int> path_signals(int part_a, int part_b) const;
  std::vector<int> visible_parts() const;
  Eigen::VectorXd random_action(Rng& rng) const { return test::random_action(signals, rng); }
};

/// The robot as a schema without noise, with gains and offsets as learned ones have them.
BodySchema true_schema(const SyntheticRobot& robot);

enum class Regime {
  kFree,     ///< exact
  kChapter,  ///< 25.4 mm and 6.1° per axis
  kTag,      ///< lateral 0.8, depth 2.8 mm, tilt 0.67°, in-plane 0.3°; 3 % flips, 15 % missing
  kTagIso,   ///< 3 mm and 1° per axis; 3 % outliers: 70 % flips, 30 % anywhere
};
const char* name_of(Regime regime);
/// Standard deviations per axis of the regime, averaged over the axes; for kFree the floor.
Noise nominal_noise(Regime regime);

struct ObservationOptions {
  Regime regime = Regime::kFree;
  bool with_covariances = false;  ///< else all zero
  bool with_other_hypothesis = false;
  /// A part is seen only while its marker faces the camera within this angle [rad]. Each part has
  /// one, turned to the camera when all signals are at mid-range. π: from everywhere.
  double max_view_angle_rad = M_PI;
};
/// The observable parts whose marker faces the camera.
std::set<int> facing_parts(const SyntheticRobot& robot, const Eigen::VectorXd& action,
                           double max_view_angle_rad);

ActionPoseSample observe(const SyntheticRobot& robot, const Eigen::VectorXd& action,
                         const ObservationOptions& options, std::int64_t sample_index, Rng& rng);
std::vector<ActionPoseSample> babble(const SyntheticRobot& robot, int num_samples,
                                     const ObservationOptions& options, Rng& rng);

/// A part that is at X_CB, seen in Gaussian noise, without a covariance.
PartObservation seen_at(int part, const Pose& X_CB, const Noise& noise, Rng& rng);

/// As if `parts` had been seen without their orientations.
std::vector<ActionPoseSample> with_positions_alone(std::vector<ActionPoseSample> samples,
                                                   const std::set<int>& parts);

/// The chapter's robots, random geometry. "a": 2-DOF, 5 parts (Fig. 3); "b": two parts on a joint
/// of two axes that cross at a right angle (Fig. 6); "c": 4-DOF, 5 parts (Fig. 7); "co": c with
/// part 3 hidden (Fig. 8); "d": 7-DOF, 10 parts, part 4 hidden, 1.3 m long, two hinged fingers on
/// one signal (Fig. 11); "dP": d with sliding fingers.
/// @throws std::invalid_argument of another name.
SyntheticRobot chapter_robot(const std::string& name, Rng& rng);

struct RandomTreeOptions {
  int num_parts = 9;
  int num_hidden = 1;
  int limb_length = 0;  ///< parts of each chain that hangs on the root; 0: branches anywhere
  bool adjacent_hidden = false;  ///< two hidden parts in a row: an edge of three signals
  double share_prismatic = 0.15;
  double share_helical = 0.05;
  double share_fixed = 0.15;
  double share_parallel = 0.15;  ///< axis parallel to the parent's
  bool shared_signal = true;     ///< the last two joints follow one signal
  bool idle_signal = true;       ///< one more signal that moves nothing
};
/// A random tree with branches; command gains 0.5 to 2 of either sign, offsets.
SyntheticRobot random_tree(const RandomTreeOptions& options, Rng& rng);

/// Right: spans the visible parts, every edge's signals are exactly those on the true path between
/// its two parts, long edges are right (judge_chain), and the number of signals over all edges is
/// minimal. Incomplete: not spanning, or long edges leave an order open, and the rest is right.
/// Wrong: all else.
Rightness judge(const BodySchema& schema, const SyntheticRobot& truth);
bool is_right(const BodySchema& schema, const SyntheticRobot& truth);

/// Of a chain: from now on all parts between the root and the last one are hidden.
void hide_all_but_ends(SyntheticRobot* robot, std::vector<ActionPoseSample>* samples);

/// Columns t, q1..qm, part, x, y, z, qw, qx, qy, qz; metres, unit quaternions, which are empty
/// where positions alone are known.
void write_csv(const std::vector<ActionPoseSample>& samples, std::ostream& out);
/// The inverse; rows of one t make one sample.
std::vector<ActionPoseSample> read_csv(std::istream& in, int* num_signals);

}  // namespace bodyschema::test
