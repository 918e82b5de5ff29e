#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <optional>
#include <vector>

#include "common/geometry/angle.h"
#include "common/kinematics/kinematic_path.h"

namespace bodyschema {

struct InverseKinematicsOptions {
  double tolerance_m = 0;  ///< a solution is this near the target
  double damping_m = 0;    ///< λ of the first step [m per whole range of a signal]
  int max_iterations = 0;  ///< of one start
  int max_starts = 0;      ///< the first from the current action, the others seeded
  double tolerance_rad = 0.001;
  double metres_per_radian = 0.2;  ///< what an error of rotation weighs beside one of position
  int posture_steps = 20;          ///< at most, in the null space of a solution; 0: as it is found
  double uncertain_m = 0.005;      ///< standard deviation of a position that is too much
};

/// Where no controller.yaml says otherwise and time does not matter.
inline constexpr InverseKinematicsOptions kThoroughInverseKinematics{
    .tolerance_m = 1e-4,
    .damping_m = 0.05,
    .max_iterations = 100,
    .max_starts = 100,
    .tolerance_rad = 0.01 * kDegree};

/// Of a part, in the root's frame.
struct PoseTarget {
  Eigen::Vector3d p_RT = Eigen::Vector3d::Zero();  ///< [m]
  std::optional<Eigen::Quaterniond> q_RT = {};     ///< unit; std::nullopt: however it is turned
};

struct InverseKinematicsSolution {
  Eigen::VectorXd action;  ///< within the limits, command units
  /// What remains by the schema; of a position alone error_rad is 0.
  double error_m = 0, error_rad = 0;
  bool is_within_tolerance = false;
};

/// The limits, no wider than what the samples covered that the schema rests on.
std::vector<Signal> covered_limits(const BodySchema& schema, std::vector<Signal> limits);

/// The edges from the root to one part and nothing else, without covariances. std::nullopt if the
/// part has no way to the root.
std::optional<BodySchema> chain_to(const BodySchema& schema, int part);

/// 6×m derivative of a part's pose in the root's frame R [m, rad per command unit]: of its origin,
/// and its angular velocity, both along the axes of R (those of the path's Jacobian, a right
/// perturbation, are along the part's).
Eigen::MatrixXd pose_jacobian(const KinematicPath& path, const Eigen::VectorXd& action);

/// How badly an action is chosen, 0 where it is well: the sum of squares of how far each signal
/// that moves the part is beyond a twentieth of its range from the limits and from what the
/// schema's samples covered [twentieths], of what the part's Jacobian in signals scaled by their
/// ranges (6 rows if `with_rotation`, metres_per_radian) falls short of a reciprocal condition
/// number of 0.05 [shares of it], and of what the part's position is uncertain by beyond
/// uncertain_m [shares of it; the standard deviation per axis, of first order].
double posture_cost(const BodySchema& schema, int part, bool with_rotation,
                    const std::vector<Signal>& limits, const Eigen::VectorXd& action,
                    const InverseKinematicsOptions& options);

/// An action that brings `part` to the target: damped least squares (Nakamura and Hanafusa 1986;
/// Buss 2004) of |Δp|² + (w Δφ)², w = metres_per_radian, in signals scaled by their ranges, the
/// damping governed as Levenberg and Marquardt do, so that it grows where a singularity lets no
/// step succeed. A signal at its limit leaves the active set while the step would push it outwards.
/// Tried from `current`, then from starts ever farther from it, then from the best of 3000 actions
/// over the ranges and at their ends, until one converges; start n is the same in every run. A
/// solution then moves in its null space (Liégeois 1977) as long as posture_cost() falls. All this
/// first within what the schema's samples covered, then within the limits. With `avoided` the
/// solution is another than those: at least a tenth of one signal's range away from each. If none
/// converges, the nearest approach, that from `current` if no other is nearer by tolerance_m; if
/// all are avoided, `current` with an infinite error.
///
/// Never NaN. `current` beyond the limits is moved to them. @throws std::invalid_argument if sizes
/// differ, the part has no way to the root, or an orientation is asked of a part of which positions
/// alone are known.
InverseKinematicsSolution solve_pose(const BodySchema& schema, int part, const PoseTarget& target,
                                     const std::vector<Signal>& limits,
                                     const Eigen::VectorXd& current,
                                     const InverseKinematicsOptions& options,
                                     const std::vector<Eigen::VectorXd>& avoided = {});

}  // namespace bodyschema
