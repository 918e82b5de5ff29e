#include "processes/controller/inverse_kinematics.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>
#include <random>
#include <stdexcept>

#include "common/kinematics/kinematic_tree.h"

namespace bodyschema {
namespace {

constexpr double kFarthestStep = 0.2;  // of a range; beyond it the linearisation says little
constexpr double kLeastDamping_m = 1e-4;
constexpr double kGreatestDamping_m = 1e3;
constexpr double kLeastProgress_m = 1e-8;
constexpr double kDifferent = 0.1;  // of a range

/// Signals as shares of their ranges, 0..1.
struct Scale {
  Eigen::ArrayXd lower, range;

  explicit Scale(const std::vector<Signal>& limits) : lower(limits.size()), range(limits.size()) {
    for (std::size_t i = 0; i < limits.size(); ++i) {
      lower[static_cast<Eigen::Index>(i)] = limits[i].lower;
      range[static_cast<Eigen::Index>(i)] = limits[i].upper - limits[i].lower;
    }
  }
  Eigen::VectorXd action(const Eigen::VectorXd& u) const { return lower + range * u.array(); }
  Eigen::VectorXd share(const Eigen::VectorXd& action) const {
    return (action.array() - lower) / range;
  }
};

Eigen::VectorXd clamped(const Eigen::VectorXd& u) { return u.cwiseMax(0.0).cwiseMin(1.0); }

/// Δu = Jᵀ (J Jᵀ + λ² I)⁻¹ e over the signals that are free: one at its limit that would be pushed
/// outwards is held there and the others take over its share.
Eigen::VectorXd damped_step(Eigen::MatrixXd J, const Eigen::Vector3d& e, double damping_m,
                            const Eigen::VectorXd& u) {
  Eigen::VectorXd step = Eigen::VectorXd::Zero(u.size());
  for (Eigen::Index round = 0; round <= u.size(); ++round) {
    const Eigen::Matrix3d A =
        J * J.transpose() + damping_m * damping_m * Eigen::Matrix3d::Identity();
    step = J.transpose() * A.ldlt().solve(e);
    bool is_inside = true;
    for (Eigen::Index i = 0; i < u.size(); ++i) {
      if ((u[i] <= 0 && step[i] < 0) || (u[i] >= 1 && step[i] > 0)) {
        J.col(i).setZero();
        is_inside = false;
      }
    }
    if (is_inside) break;
  }
  const double largest = step.cwiseAbs().maxCoeff();
  return largest > kFarthestStep ? step * (kFarthestStep / largest) : step;
}

}  // namespace

std::optional<BodySchema> chain_to(const BodySchema& schema, int part) {
  const KinematicTree tree(schema.edges, schema.root);
  const int end = tree.node_of(part);
  if (end < 0) return std::nullopt;
  BodySchema chain = schema;
  chain.edges.clear();
  for (const int node : tree.path_to(end)) {
    chain.edges.push_back(schema.edges[tree.nodes()[node].edge]);
    chain.edges.back().parameter_covariance.resize(0, 0);
  }
  return chain;
}

Eigen::MatrixXd position_jacobian(const KinematicPath& path, const Eigen::VectorXd& action) {
  PoseJacobian J_B;
  const Pose X_RB = path.predict(action, &J_B);
  return X_RB.linear() * J_B.topRows<3>();
}

InverseKinematicsSolution solve_position(const BodySchema& schema, int part,
                                         const Eigen::Vector3d& p_RT,
                                         const std::vector<Signal>& limits,
                                         const Eigen::VectorXd& current,
                                         const InverseKinematicsOptions& options,
                                         const std::vector<Eigen::VectorXd>& avoided) {
  const auto path = KinematicPath::between(schema, schema.root, part);
  if (!path) throw std::invalid_argument("the part has no way to the root");
  if (limits.size() != schema.signals.size() ||
      current.size() != static_cast<Eigen::Index>(limits.size())) {
    throw std::invalid_argument("limits and action must have one value per signal");
  }
  const Scale scale(limits);
  const auto error_at = [&](const Eigen::VectorXd& u) -> Eigen::Vector3d {
    return p_RT - path->predict(scale.action(u)).translation();
  };
  const auto is_avoided = [&](const Eigen::VectorXd& u) {
    return std::any_of(avoided.begin(), avoided.end(), [&](const Eigen::VectorXd& action) {
      return (scale.share(action) - u).cwiseAbs().maxCoeff() < kDifferent;
    });
  };

  const Eigen::VectorXd u_current = clamped(scale.share(current));
  InverseKinematicsSolution best;
  best.error_m = std::numeric_limits<double>::infinity();
  for (int start = 0; start < options.max_starts; ++start) {
    Eigen::VectorXd u = u_current;
    if (start > 0) {
      std::mt19937_64 engine(static_cast<std::uint64_t>(start));
      std::uniform_real_distribution<double> unit(0, 1);
      const double spread = std::min(1.0, 0.25 * start);
      for (double& value : u) value += spread * (unit(engine) - value);
    }
    Eigen::Vector3d error = error_at(u);
    double damping_m = options.damping_m;
    for (int i = 0; i < options.max_iterations && damping_m < kGreatestDamping_m &&
                    error.norm() > options.tolerance_m;
         ++i) {
      const Eigen::MatrixXd J =
          position_jacobian(*path, scale.action(u)) * scale.range.matrix().asDiagonal();
      const Eigen::VectorXd next = clamped(u + damped_step(J, error, damping_m, u));
      const Eigen::Vector3d next_error = error_at(next);
      if (next_error.norm() < error.norm() - kLeastProgress_m) {
        u = next;
        error = next_error;
        damping_m = std::max(kLeastDamping_m, 0.3 * damping_m);
      } else {
        damping_m *= 4;
      }
    }
    if (is_avoided(u)) continue;
    const bool is_within = error.norm() <= options.tolerance_m;
    if (error.norm() < best.error_m) best = {scale.action(u), error.norm(), is_within};
    if (is_within) break;
  }
  if (best.action.size() == 0) best.action = scale.action(u_current);
  return best;
}

}  // namespace bodyschema
