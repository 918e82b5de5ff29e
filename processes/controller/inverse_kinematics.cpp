#include "processes/controller/inverse_kinematics.h"

#include <Eigen/Cholesky>
#include <Eigen/QR>
#include <Eigen/SVD>
#include <algorithm>
#include <cmath>
#include <functional>
#include <limits>
#include <random>
#include <stdexcept>
#include <utility>

#include "common/kinematics/kinematic_tree.h"
#include "common/schema/standard_deviations.h"

namespace bodyschema {
namespace {

constexpr double kFarthestStep = 0.2;  // of a range; beyond it the linearisation says little
constexpr double kLeastDamping_m = 1e-4;
constexpr double kGreatestDamping_m = 1e3;
constexpr double kLeastProgress_m = 1e-8;
constexpr double kDifferent = 0.1;  // of a range
// Actions that are looked at, and how far beyond the limits they are drawn before they are moved to
// them: where a target is out of reach, some signals end there. Measured by `./run experiment
// reach`: of 1000 nearest points 4 are missed with 1000 actions and 0 of a range, 1 with 0.3, none
// with 1000 to 5000 actions and 0.5.
constexpr int kScattered = 3000;
constexpr double kBeyond = 0.5;            // of a range
constexpr double kRoom = 0.05;             // of a range, to a limit
constexpr double kWellConditioned = 0.05;  // smallest of largest singular value
constexpr double kFirstPostureStep = 0.1, kLeastPostureStep = 0.005;  // of a range

/// Signals as shares of their ranges, 0..1.
struct Scale {
  Eigen::ArrayXd lower, upper, range;

  explicit Scale(const std::vector<Signal>& limits) : lower(limits.size()), upper(limits.size()) {
    for (std::size_t i = 0; i < limits.size(); ++i) {
      lower[static_cast<Eigen::Index>(i)] = limits[i].lower;
      upper[static_cast<Eigen::Index>(i)] = limits[i].upper;
    }
    range = upper - lower;
  }
  /// Never beyond a limit, not by rounding either: a driver refuses that.
  Eigen::VectorXd action(const Eigen::VectorXd& u) const {
    return (lower + range * u.array()).max(lower).min(upper);
  }
  Eigen::VectorXd share(const Eigen::VectorXd& action) const {
    return (range > 0).select((action.array() - lower) / range, 0);
  }
};

Eigen::VectorXd clamped(const Eigen::VectorXd& u) { return u.cwiseMax(0.0).cwiseMin(1.0); }

/// Δu = Jᵀ (J Jᵀ + λ² I)⁻¹ e over the signals that are free: one at its limit that would be pushed
/// outwards is held there and the others take over its share.
Eigen::VectorXd damped_step(Eigen::MatrixXd J, const Eigen::VectorXd& e, double damping_m,
                            const Eigen::VectorXd& u) {
  Eigen::VectorXd step = Eigen::VectorXd::Zero(u.size());
  for (Eigen::Index round = 0; round <= u.size(); ++round) {
    Eigen::MatrixXd A = J * J.transpose();
    A.diagonal().array() += damping_m * damping_m;
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

/// What is left to a target, in three rows [m], or in six with the rotation [m, weighted].
class Residual {
 public:
  Residual(const PoseTarget& target, const InverseKinematicsOptions& options)
      : target_(target), options_(options), rows_(target.q_RT ? 6 : 3) {}

  Eigen::VectorXd operator()(const Pose& X_RB) const {
    Eigen::VectorXd e(rows_);
    e.head<3>() = target_.p_RT - X_RB.translation();
    if (target_.q_RT) {
      const Eigen::AngleAxisd left(target_.q_RT->normalized() * X_RB.linear().transpose());
      e.tail<3>() = options_.metres_per_radian * left.angle() * left.axis();
    }
    return e;
  }
  /// Of −e.
  Eigen::MatrixXd jacobian(const Eigen::MatrixXd& pose_jacobian) const {
    Eigen::MatrixXd J = pose_jacobian.topRows(rows_);
    if (rows_ == 6) J.bottomRows<3>() *= options_.metres_per_radian;
    return J;
  }
  double angle_rad(const Eigen::VectorXd& e) const {
    return rows_ == 6 ? e.tail<3>().norm() / options_.metres_per_radian : 0;
  }
  bool is_within_tolerance(const Eigen::VectorXd& e) const {
    return e.head<3>().norm() <= options_.tolerance_m && angle_rad(e) <= options_.tolerance_rad;
  }

 private:
  const PoseTarget& target_;
  const InverseKinematicsOptions& options_;
  const Eigen::Index rows_;
};

/// From one start, until it converges or no step helps.
Eigen::VectorXd converge(const KinematicPath& path, const Scale& scale, const Residual& residual,
                         const InverseKinematicsOptions& options, Eigen::VectorXd u) {
  Eigen::VectorXd error = residual(path.predict(scale.action(u)));
  double damping_m = options.damping_m;
  for (int i = 0; i < options.max_iterations && damping_m < kGreatestDamping_m &&
                  !residual.is_within_tolerance(error);
       ++i) {
    const Eigen::MatrixXd J =
        residual.jacobian(pose_jacobian(path, scale.action(u))) * scale.range.matrix().asDiagonal();
    const Eigen::VectorXd next = clamped(u + damped_step(J, error, damping_m, u));
    const Eigen::VectorXd next_error = residual(path.predict(scale.action(next)));
    if (next_error.norm() < error.norm() - kLeastProgress_m) {
      u = next;
      error = next_error;
      damping_m = std::max(kLeastDamping_m, 0.3 * damping_m);
    } else {
      damping_m *= 4;
    }
  }
  return u;
}

/// posture_cost() in shares.
class Posture {
 public:
  Posture(const KinematicPath& path, const Scale& scale, const Residual& residual,
          const std::vector<Signal>& covered, double uncertain_m)
      : path_(path),
        scale_(scale),
        residual_(residual),
        uncertain_m_(uncertain_m),
        lower_(covered.size()),
        upper_(covered.size()) {
    for (std::size_t i = 0; i < covered.size(); ++i) {
      lower_[static_cast<Eigen::Index>(i)] = covered[i].lower;
      upper_[static_cast<Eigen::Index>(i)] = covered[i].upper;
    }
    lower_ = clamped(scale.share(lower_));
    upper_ = clamped(scale.share(upper_));
  }

  /// Derivative of the residual's negative by the shares.
  Eigen::MatrixXd jacobian(const Eigen::VectorXd& u) const {
    return residual_.jacobian(pose_jacobian(path_, scale_.action(u))) *
           scale_.range.matrix().asDiagonal();
  }
  double cost(const Eigen::VectorXd& u) const { return cost_of_room(u) + cost_of_doubt(u); }
  /// Down the null space of J.
  Eigen::VectorXd descent(const Eigen::VectorXd& u) const {
    constexpr double kDifference = 1e-5;
    // Where the part is known well it is so nearby, too: that takes the most time.
    const bool is_in_doubt = cost_of_doubt(u) > 0;
    const auto cost_at = [&](const Eigen::VectorXd& at) {
      return cost_of_room(at) + (is_in_doubt ? cost_of_doubt(at) : 0);
    };
    const double here = cost_at(u);
    Eigen::VectorXd gradient(u.size());
    for (Eigen::Index i = 0; i < u.size(); ++i) {
      Eigen::VectorXd there = u;
      there[i] += kDifference;
      gradient[i] = (cost_at(there) - here) / kDifference;
    }
    const Eigen::MatrixXd J = jacobian(u);
    return J.completeOrthogonalDecomposition().solve(J * gradient) - gradient;
  }

 private:
  double cost_of_room(const Eigen::VectorXd& u) const {
    const Eigen::MatrixXd J = jacobian(u);
    const Eigen::Array<bool, Eigen::Dynamic, 1> moves =
        J.colwise().squaredNorm().transpose().array() > 0;
    const Eigen::ArrayXd lacking = (lower_ - u).cwiseMax(u - upper_).array() / kRoom + 1;
    double sum = moves.select(lacking.max(0).square(), 0).sum();
    if (const Eigen::Index rank = std::min<Eigen::Index>(J.rows(), moves.count()); rank > 0) {
      const Eigen::VectorXd singular = J.jacobiSvd().singularValues();
      const double condition = singular[rank - 1] / std::max(singular[0], 1e-12);
      sum += std::pow(std::max(0.0, 1 - condition / kWellConditioned), 2);
    }
    return sum;
  }
  double cost_of_doubt(const Eigen::VectorXd& u) const {
    const double sd_m =
        deviations_of(path_.covariance(scale_.action(u), Variance::kFirstOrder)).position_m;
    return std::pow(std::max(0.0, sd_m / uncertain_m_ - 1), 2);
  }

  const KinematicPath& path_;
  const Scale& scale_;
  const Residual& residual_;
  const double uncertain_m_;
  Eigen::VectorXd lower_, upper_;
};

/// A solution with less of posture_cost(), as near the target as is asked.
Eigen::VectorXd settled(const KinematicPath& path, const Scale& scale, const Residual& residual,
                        const InverseKinematicsOptions& options, const Posture& posture,
                        Eigen::VectorXd u) {
  double cost = posture.cost(u), step = kFirstPostureStep;
  for (int i = 0; i < options.posture_steps && cost > 0 && step > kLeastPostureStep; ++i) {
    const Eigen::VectorXd descent = posture.descent(u);
    const double largest = descent.cwiseAbs().maxCoeff();
    if (largest < 1e-9) break;
    const Eigen::VectorXd next =
        converge(path, scale, residual, options, clamped(u + step / largest * descent));
    const double next_cost = posture.cost(next);
    if (next_cost < cost &&
        residual.is_within_tolerance(residual(path.predict(scale.action(next))))) {
      u = next;
      cost = next_cost;
    } else {
      step /= 2;
    }
  }
  return u;
}

/// Start n of the first half: the first is `u`, the others ever farther from it, the same in every
/// run.
Eigen::VectorXd start_near(const Eigen::VectorXd& u, int n) {
  if (n == 0) return u;
  std::mt19937_64 engine(static_cast<std::uint64_t>(n));
  std::uniform_real_distribution<double> unit(0, 1);
  const double spread = std::min(1.0, 0.25 * n);
  Eigen::VectorXd start = u;
  for (double& value : start) value += spread * (unit(engine) - value);
  return start;
}

/// Those of kScattered actions, the same in every run, that leave the least, the best first.
std::vector<Eigen::VectorXd> scattered_starts(const KinematicPath& path, const Scale& scale,
                                              const Residual& residual, int count) {
  std::mt19937_64 engine(0);
  std::uniform_real_distribution<double> wide(-kBeyond, 1 + kBeyond);
  std::vector<std::pair<double, Eigen::VectorXd>> starts(kScattered);
  for (auto& [left, u] : starts) {
    u.resize(scale.range.size());
    for (double& value : u) value = std::clamp(wide(engine), 0.0, 1.0);
    left = residual(path.predict(scale.action(u))).norm();
  }
  count = std::min(count, kScattered);
  std::ranges::partial_sort(starts, starts.begin() + count, {},
                            [](const auto& s) { return s.first; });
  std::vector<Eigen::VectorXd> best;
  for (int n = 0; n < count; ++n)
    best.push_back(std::move(starts[static_cast<std::size_t>(n)].second));
  return best;
}

/// solve_pose() within `limits`.
InverseKinematicsSolution solve_within(const KinematicPath& path, const PoseTarget& target,
                                       const std::vector<Signal>& limits,
                                       const std::vector<Signal>& covered,
                                       const Eigen::VectorXd& current,
                                       const InverseKinematicsOptions& options,
                                       const std::function<bool(const Eigen::VectorXd&)>& may_be) {
  const Scale scale(limits);
  const Residual residual(target, options);
  const Posture posture(path, scale, residual, covered, options.uncertain_m);
  const Eigen::VectorXd u_current = clamped(scale.share(current));
  const double infinity = std::numeric_limits<double>::infinity();
  InverseKinematicsSolution best{scale.action(u_current), infinity, target.q_RT ? infinity : 0,
                                 false};
  double least = infinity;
  const int num_near = (options.max_starts + 1) / 2;
  std::vector<Eigen::VectorXd> scattered;
  const int num_starts = std::min(options.max_starts, num_near + kScattered);
  for (int n = 0; n < num_starts && !best.is_within_tolerance; ++n) {
    if (n == num_near) scattered = scattered_starts(path, scale, residual, num_starts - num_near);
    const auto start =
        n < num_near ? start_near(u_current, n) : scattered[static_cast<std::size_t>(n - num_near)];
    Eigen::VectorXd u = converge(path, scale, residual, options, start);
    if (!may_be(scale.action(u))) continue;
    if (residual.is_within_tolerance(residual(path.predict(scale.action(u))))) {
      const Eigen::VectorXd better = settled(path, scale, residual, options, posture, u);
      if (may_be(scale.action(better))) u = better;
    }
    const Eigen::VectorXd error = residual(path.predict(scale.action(u)));
    const bool is_within_tolerance = residual.is_within_tolerance(error);
    if (!is_within_tolerance && !(error.norm() < least)) continue;
    // Nearer by less than the tolerance is no reason to go elsewhere.
    least = error.norm() - (n == 0 ? options.tolerance_m : 0);
    best = {scale.action(u), error.head<3>().norm(), residual.angle_rad(error),
            is_within_tolerance};
  }
  return best;
}

}  // namespace

std::vector<Signal> covered_limits(const BodySchema& schema, std::vector<Signal> limits) {
  for (std::size_t i = 0; i < limits.size(); ++i) {
    const Signal::Range covered = schema.signals[i].known_range();
    const double lower = limits[i].lower, upper = limits[i].upper;
    limits[i].lower = std::clamp(covered.lower, lower, upper);
    limits[i].upper = std::clamp(covered.upper, lower, upper);
  }
  return limits;
}

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

Eigen::MatrixXd pose_jacobian(const KinematicPath& path, const Eigen::VectorXd& action) {
  PoseJacobian J;
  const Pose X_RB = path.predict(action, &J);
  J.topRows<3>() = X_RB.linear() * J.topRows<3>();
  J.bottomRows<3>() = X_RB.linear() * J.bottomRows<3>();
  return J;
}

double posture_cost(const BodySchema& schema, int part, bool with_rotation,
                    const std::vector<Signal>& limits, const Eigen::VectorXd& action,
                    const InverseKinematicsOptions& options) {
  const auto path = KinematicPath::between(schema, schema.root, part);
  if (!path) throw std::invalid_argument("the part has no way to the root");
  PoseTarget target;
  if (with_rotation) target.q_RT = Eigen::Quaterniond::Identity();
  const Scale scale(limits);
  const Residual residual(target, options);
  return Posture(*path, scale, residual, covered_limits(schema, limits), options.uncertain_m)
      .cost(scale.share(action));
}

InverseKinematicsSolution solve_pose(const BodySchema& schema, int part, const PoseTarget& target,
                                     const std::vector<Signal>& limits,
                                     const Eigen::VectorXd& current,
                                     const InverseKinematicsOptions& options,
                                     const std::vector<Eigen::VectorXd>& avoided) {
  const auto path = KinematicPath::between(schema, schema.root, part);
  if (!path) throw std::invalid_argument("the part has no way to the root");
  if (target.q_RT && !schema.has_rotation(part))
    throw std::invalid_argument("of the part positions alone are known, no orientation");
  if (limits.size() != schema.signals.size() ||
      current.size() != static_cast<Eigen::Index>(limits.size())) {
    throw std::invalid_argument("limits and action must have one value per signal");
  }
  const Scale ranges(limits);
  const auto may_be = [&](const Eigen::VectorXd& action) {
    return std::ranges::none_of(avoided, [&](const Eigen::VectorXd& other) {
      return (ranges.share(other) - ranges.share(action)).cwiseAbs().maxCoeff() < kDifferent;
    });
  };
  const std::vector<Signal> covered = covered_limits(schema, limits);
  const auto range = [](const Signal& signal) { return std::pair(signal.lower, signal.upper); };
  if (!std::ranges::equal(covered, limits, {}, range, range)) {
    const auto solution = solve_within(*path, target, covered, covered, current, options, may_be);
    if (solution.is_within_tolerance) return solution;
  }
  return solve_within(*path, target, limits, covered, current, options, may_be);
}

}  // namespace bodyschema
