#pragma once

#include <Eigen/Core>
#include <optional>
#include <vector>

#include "common/kinematics/kinematic_path.h"

namespace bodyschema {

struct InverseKinematicsOptions {
  double tolerance_m = 0;  ///< a solution is this near the target
  double damping_m = 0;    ///< λ of the first step [m per whole range of a signal]
  int max_iterations = 0;  ///< of one start
  int max_starts = 0;      ///< the first from the current action, the others seeded
};

struct InverseKinematicsSolution {
  Eigen::VectorXd action;  ///< within the limits, command units
  double error_m = 0;      ///< distance that remains by the schema
  bool is_within_tolerance = false;
};

/// The edges from the root to one part and nothing else, without covariances. std::nullopt if the
/// part has no way to the root.
std::optional<BodySchema> chain_to(const BodySchema& schema, int part);

/// 3×m derivative of a part's origin in the root's frame R [m per command unit]: the upper rows of
/// the Jacobian of the path from the root are in the part's frame (right perturbation), here turned
/// by R_RB.
Eigen::MatrixXd position_jacobian(const KinematicPath& path, const Eigen::VectorXd& action);

/// An action that brings the origin of `part` to `p_RT` [m, root frame]: damped least squares
/// (Nakamura and Hanafusa 1986; Buss 2004) in signals scaled by their ranges, the damping governed
/// as Levenberg and Marquardt do, so that it grows where a singularity lets no step succeed. A
/// signal at its limit leaves the active set while the step would push it outwards. Tried from
/// `current`, then from starts ever farther from it, until one converges; start n is the same in
/// every run. With `avoided` the solution is another than those: at least a tenth of one signal's
/// range away from each. If none converges, the nearest approach; if all are avoided, `current`
/// with an infinite error.
///
/// Never NaN. `current` beyond the limits is moved to them. @throws std::invalid_argument if sizes
/// differ or the part has no way to the root.
InverseKinematicsSolution solve_position(const BodySchema& schema, int part,
                                         const Eigen::Vector3d& p_RT,
                                         const std::vector<Signal>& limits,
                                         const Eigen::VectorXd& current,
                                         const InverseKinematicsOptions& options,
                                         const std::vector<Eigen::VectorXd>& avoided = {});

}  // namespace bodyschema
