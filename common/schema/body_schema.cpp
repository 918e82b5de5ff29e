#include "common/schema/body_schema.h"

#include <algorithm>
#include <stdexcept>

namespace bodyschema {
namespace {

// Exp of the screw (0, 0, slide, 0, 0, turn) scaled by the joint's displacement.
Pose screw_motion(const ScrewJoint& joint, double displacement) {
  Pose X = Pose::Identity();
  X.linear() =
      Eigen::AngleAxisd(joint.turn * displacement, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  X.translation().z() = joint.slide * displacement;
  return X;
}

double screw_displacement(const ScrewJoint& joint, const Eigen::VectorXd& theta) {
  if (joint.signal < 0 || joint.signal >= theta.size())
    throw std::invalid_argument("action has no signal " + std::to_string(joint.signal));
  return joint.gain * theta(joint.signal) + joint.offset;
}

// Exp(ρ(θ)) · right, and how the pose moves with ρ: Exp(ρ + δ) = Exp(ρ) · Exp(J_r(ρ) δ).
struct Residual {
  Residual(const ResidualGp& gp, const Eigen::VectorXd& theta, const Pose& right) {
    const Vector6d rho = gp.mean(theta);
    suffix = exp(rho) * right;
    by_mean = adjoint(right.inverse()) * right_jacobian_inverse(rho).inverse();
  }
  Pose suffix;
  Matrix6d by_mean;
};

// One step along a path: an edge, walked forwards or backwards.
struct Step {
  const Edge* edge;
  bool forward;
};

// The path from part `from` to part `to`, or std::nullopt. Works for edges in any order.
std::optional<std::vector<Step>> path_between(const std::vector<Edge>& edges, int from, int to) {
  std::map<int, Step> reached_by;  // part → the step that reached it
  std::vector<int> frontier{from};
  std::map<int, int> predecessor{{from, from}};
  while (!frontier.empty() && !predecessor.count(to)) {
    std::vector<int> next;
    for (const int part : frontier) {
      for (const Edge& edge : edges) {
        const bool forward = edge.from == part;
        if (!forward && edge.to != part) continue;
        const int other = forward ? edge.to : edge.from;
        if (!predecessor.emplace(other, part).second) continue;
        reached_by.emplace(other, Step{&edge, forward});
        next.push_back(other);
      }
    }
    frontier = std::move(next);
  }
  if (!predecessor.count(to)) return std::nullopt;
  std::vector<Step> path;
  for (int part = to; part != from; part = predecessor.at(part))
    path.push_back(reached_by.at(part));
  std::reverse(path.begin(), path.end());
  return path;
}

}  // namespace

const char* Edge::kind() const {
  if (matrix_gp) return "matrix_gp";
  if (residual_gp) return "screw_gp";
  return joints.empty() ? "rigid" : "screw";
}

std::vector<int> Edge::signals() const {
  if (matrix_gp) return matrix_gp->signals();
  std::vector<int> result;
  for (const ScrewJoint& joint : joints)
    if (std::find(result.begin(), result.end(), joint.signal) == result.end())
      result.push_back(joint.signal);
  if (residual_gp)
    for (const int signal : residual_gp->signals())
      if (std::find(result.begin(), result.end(), signal) == result.end()) result.push_back(signal);
  return result;
}

Pose Edge::predict(const Eigen::VectorXd& theta) const {
  if (matrix_gp) return left * matrix_gp->predict(theta) * right;
  Pose X = left;
  for (const ScrewJoint& joint : joints)
    X = X * screw_motion(joint, screw_displacement(joint, theta)) * joint.X_after;
  if (residual_gp) X = X * exp(residual_gp->mean(theta));
  return X * right;
}

Eigen::MatrixXd Edge::jacobian(const Eigen::VectorXd& theta) const {
  if (matrix_gp) return adjoint(right.inverse()) * matrix_gp->jacobian(theta);
  Eigen::MatrixXd J = Eigen::MatrixXd::Zero(6, theta.size());
  Pose suffix = right;  // what follows the joint's own motion, which commutes with its screw
  if (residual_gp) {
    const Residual residual(*residual_gp, theta, right);
    J = residual.by_mean * residual_gp->mean_gradient(theta);
    suffix = residual.suffix;
  }
  for (auto joint = joints.rbegin(); joint != joints.rend(); ++joint) {
    const double displacement = screw_displacement(*joint, theta);
    suffix = joint->X_after * suffix;
    const Matrix6d A = adjoint(suffix.inverse());
    J.col(joint->signal) += joint->gain * (joint->slide * A.col(2) + joint->turn * A.col(5));
    suffix = screw_motion(*joint, displacement) * suffix;
  }
  return J;
}

Matrix6d Edge::prediction_covariance(const Eigen::VectorXd& theta) const {
  if (matrix_gp) {
    const Matrix6d A = adjoint(right.inverse());
    return A * matrix_gp->prediction_covariance(theta) * A.transpose();
  }
  Matrix6d of_residual = Matrix6d::Zero();
  Pose after_joints = right;
  if (residual_gp) {
    const Residual residual(*residual_gp, theta, right);
    of_residual =
        residual.by_mean * residual_gp->variance(theta).asDiagonal() * residual.by_mean.transpose();
    after_joints = residual.suffix;
  }
  const Eigen::Index size = 6 + 8 * static_cast<Eigen::Index>(joints.size());
  if (parameter_covariance.rows() != size || parameter_covariance.cols() != size)
    return of_residual;
  // ∂(right perturbation of the prediction)/∂parameters, from the last parameter to the first.
  Eigen::MatrixXd G(6, size);
  Pose suffix = after_joints;
  for (std::size_t d = joints.size(); d-- > 0;) {
    const ScrewJoint& joint = joints[d];
    const double displacement = screw_displacement(joint, theta);
    const Eigen::Index column = 6 + 8 * static_cast<Eigen::Index>(d);
    G.middleCols<6>(column + 2) = adjoint(suffix.inverse());
    suffix = joint.X_after * suffix;
    const Matrix6d A = adjoint(suffix.inverse());
    G.col(column) = displacement * A.col(2);
    G.col(column + 1) = displacement * A.col(5);
    suffix = screw_motion(joint, displacement) * suffix;
  }
  G.leftCols<6>() = adjoint(suffix.inverse());
  return G * parameter_covariance * G.transpose() + of_residual;
}

bool BodySchema::has_part(int part) const {
  return std::find(parts.begin(), parts.end(), part) != parts.end();
}

std::vector<int> BodySchema::unused_signals() const {
  std::vector<bool> used(signals.size(), false);
  for (const Edge& edge : edges)
    for (const int signal : edge.signals())
      if (signal >= 0 && signal < static_cast<int>(used.size())) used[signal] = true;
  std::vector<int> result;
  for (std::size_t s = 0; s < used.size(); ++s)
    if (!used[s]) result.push_back(static_cast<int>(s));
  return result;
}

Eigen::VectorXd BodySchema::displacements(const Eigen::VectorXd& action) const {
  if (action.size() != static_cast<Eigen::Index>(signals.size()))
    throw std::invalid_argument("action has " + std::to_string(action.size()) + " values, not " +
                                std::to_string(signals.size()));
  Eigen::VectorXd theta = action;
  for (std::size_t s = 0; s < signals.size(); ++s) {
    theta(static_cast<Eigen::Index>(s)) =
        signals[s].displacement(action(static_cast<Eigen::Index>(s)));
  }
  return theta;
}

std::optional<PosePrediction> BodySchema::predict(int from, int to,
                                                  const Eigen::VectorXd& action) const {
  const Eigen::VectorXd theta = displacements(action);
  const auto path = path_between(edges, from, to);
  if (!path) return std::nullopt;
  PosePrediction result;
  for (const Step& step : *path) {
    Pose X = step.edge->predict(theta);
    Matrix6d covariance = step.edge->prediction_covariance(theta);
    if (!step.forward) {
      // (X exp ε)⁻¹ = X⁻¹ exp(−Ad(X) ε)
      const Matrix6d A = adjoint(X);
      covariance = A * covariance * A.transpose();
      X = X.inverse();
    }
    const Matrix6d A = adjoint(X.inverse());
    result.covariance = A * result.covariance * A.transpose() + covariance;
    result.X_AB = result.X_AB * X;
  }
  return result;
}

std::map<int, Pose> BodySchema::predict_all(const Eigen::VectorXd& action) const {
  const Eigen::VectorXd theta = displacements(action);
  std::map<int, Pose> X_RB;
  if (root < 0) return X_RB;
  X_RB.emplace(root, Pose::Identity());
  // Edges come ordered from the root outwards; the loop repeats only if somebody reordered them.
  for (bool grown = true; grown;) {
    grown = false;
    for (const Edge& edge : edges) {
      const auto from = X_RB.find(edge.from);
      const auto to = X_RB.find(edge.to);
      if ((from == X_RB.end()) == (to == X_RB.end())) continue;
      const Pose X = edge.predict(theta);
      if (to == X_RB.end())
        X_RB.emplace(edge.to, from->second * X);
      else
        X_RB.emplace(edge.from, to->second * X.inverse());
      grown = true;
    }
  }
  return X_RB;
}

std::optional<Eigen::MatrixXd> BodySchema::jacobian(int from, int to,
                                                    const Eigen::VectorXd& action) const {
  const Eigen::VectorXd theta = displacements(action);
  const auto path = path_between(edges, from, to);
  if (!path) return std::nullopt;
  Eigen::MatrixXd J = Eigen::MatrixXd::Zero(6, action.size());
  for (const Step& step : *path) {
    Pose X = step.edge->predict(theta);
    Eigen::MatrixXd J_edge = step.edge->jacobian(theta);
    if (!step.forward) {
      J_edge = -adjoint(X) * J_edge;
      X = X.inverse();
    }
    J = adjoint(X.inverse()) * J + J_edge;
  }
  for (std::size_t s = 0; s < signals.size(); ++s) {
    const auto column = static_cast<Eigen::Index>(s);
    J.col(column) *= signals[s].displacement_rate(action(column));
  }
  return J;
}

}  // namespace bodyschema
