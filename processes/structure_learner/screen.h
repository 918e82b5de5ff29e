#pragma once

#include <vector>

#include "processes/structure_learner/local_model.h"

namespace bodyschema {

/// Relative motions log(z_s⁻¹ z_t) of a pair between instants s and t. They do not depend on any
/// signal, so one set serves every hypothesis on the pair.
struct RelativeMotions {
  struct Motion {
    int sample_s = 0;
    int sample_t = 0;
    Vector6d log = Vector6d::Zero();
  };
  std::vector<Motion> motions;
  /// Typical standard deviations of z per axis, to weigh metres against radians.
  double sigma_m = 1;
  double sigma_rad = 1;
};

/// Up to `max_motions` of the instants' pairs, evenly chosen, rotations below 2.4 rad only (the
/// logarithm is ambiguous at π).
RelativeMotions relative_motions(const PairData& pair, int max_motions);

/// A closed-form start and how well it already fits an even subset of the frames.
struct Start {
  LocalModel model;
  double score = 0;   ///< mean robust cost a frame: smaller is better
  double median = 0;  ///< of the squared distances: outliers do not count
};

/// Frames on which a start is judged.
inline constexpr int kStartFrames = 48;
/// How well a model fits an even choice of so many frames.
Start judged_start(const LocalModel& model, const PairData& pair, const NormalizedActions& actions,
                   int max_frames = kStartFrames);

/// Score of a rigid start beyond which no rigid model is valid.
inline constexpr double kMaxRigidStartCost = 20;

/// k = 0: the best of a few single readings.
Start screen_rigid(const PairData& pair, const NormalizedActions& actions);

/// k = 1, all signals: log(z_s⁻¹ z_t) = ξ (q_t − q_s) holds exactly for every screw, so ξ follows
/// from an L1 regression. Best signal first, of many signals the eight most promising; `score` is
/// the mean regression error in standard deviations.
struct ScrewRegression {
  int signal = 0;
  Vector6d xi = Vector6d::Zero();  ///< in frame j, per half range
  double score = 0;
};
std::vector<ScrewRegression> screen_one_joint(const RelativeMotions& motions,
                                              const NormalizedActions& actions);

/// The start that belongs to a regression.
Start one_joint_start(const ScrewRegression& regression, const PairData& pair,
                      const NormalizedActions& actions, double sigma_rad);

/// k = 2: the most promising starts over all ordered pairs of signals, best first.
///
/// Two turning joints a, b with general axes: R_t = R_0 R_z(α) R_1 R_z(β) R_2. With u = R_2ᵀ e_z,
/// the vector R_t u depends on α alone, R_t u = C (1, cos α, sin α)ᵀ, so u is the smallest
/// eigenvector of a 3×3 matrix and its residual judges signal a without b; R_tᵀ v judges b alike.
/// Then four cases of sign, R_1 by averaging, translations by linear least squares. The rotation
/// about one fixed axis, or about none, leaves u undetermined: parallel turning joints, one turning
/// and one sliding joint in either order, and two sliding joints have starts of their own.
///
/// `turns[s]` are the joint ranges [rad per half range] to assume for signal s. Where several are
/// to be tried for one and they go beyond π, about a single axis too joints may turn more than once
/// (turn_scan.h).
std::vector<Start> screen_two_joints(const PairData& pair, const NormalizedActions& actions,
                                     const RelativeMotions& motions,
                                     const std::vector<std::vector<double>>& turns, int max_starts);

/// The smallest joint that is looked for [rad per half range]: about 35° over the range that a
/// signal took. (The smallest of the rigs, arm7's fingers, turn by 46°.)
inline constexpr double kLeastTurn = 0.3;
/// Ranges that cover joints from there to 320° where nothing is known of a signal.
std::vector<double> default_turns();
/// Those, and ranges of joints that turn more than once (kMostTurn).
std::vector<double> wide_turns();

}  // namespace bodyschema
