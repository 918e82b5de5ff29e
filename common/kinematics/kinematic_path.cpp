#include "common/kinematics/kinematic_path.h"

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "common/estimation/chi_square.h"
#include "common/estimation/quantile.h"
#include "common/kinematics/kinematic_tree.h"

namespace bodyschema {
namespace {

/// Rigid or screws and nothing else.
bool is_screw_chain(const Edge& edge) { return !edge.matrix_gp && !edge.residual_gp; }

/// Covariance in the frame that `X` ends in, of the inverse: (X exp ε)⁻¹ = X⁻¹ exp(−Ad(X) ε).
Matrix6d turned(const Matrix6d& covariance, const Pose& X) {
  const Matrix6d A = adjoint(X);
  return A * covariance * A.transpose();
}

/// covariance − shared, or as much of `shared` less as leaves a covariance.
Matrix6d without(const Matrix6d& covariance, const Matrix6d& shared) {
  const Matrix6d rest = covariance - shared;
  if (Eigen::LLT<Matrix6d>(rest).info() == Eigen::Success) return rest;
  const Eigen::LLT<Matrix6d> llt(covariance);
  if (llt.info() != Eigen::Success) return covariance;
  const Matrix6d whitened =
      llt.matrixL().solve(llt.matrixL().solve(shared).transpose());  // L⁻¹ F L⁻ᵀ
  const double most =
      Eigen::SelfAdjointEigenSolver<Matrix6d>(whitened, Eigen::EigenvaluesOnly).eigenvalues()(5);
  return covariance - shared / std::max(most, 1.0);
}

}  // namespace

std::optional<KinematicPath> KinematicPath::between(const BodySchema& schema, int from, int to) {
  const KinematicTree tree(schema.edges, from);
  const int end = tree.node_of(to);
  if (end < 0) return std::nullopt;
  KinematicPath path;
  path.signals_ = schema.signals;
  for (const int node : tree.path_to(end)) {
    const bool is_forward = tree.nodes()[node].is_forward;
    const Edge* const edge = &schema.edges[tree.nodes()[node].edge];
    const auto start = schema.frame_covariances.find(is_forward ? edge->from : edge->to);
    path.legs_.push_back({*edge, is_forward, std::nullopt, schema.noise});
    if (path.legs_.size() > 1 && start != schema.frame_covariances.end())
      path.legs_.back().start = start->second;
    if (!is_screw_chain(*edge)) {
      path.steps_.push_back({.leg = static_cast<int>(path.legs_.size()) - 1});
    } else if (is_forward) {
      path.append(edge->left);
      for (const ScrewJoint& joint : edge->joints) {
        path.append(joint, 1);
        path.append(joint.X_after);
      }
      path.append(edge->right);
    } else {
      path.append(edge->right.inverse());
      for (auto joint = edge->joints.rbegin(); joint != edge->joints.rend(); ++joint) {
        path.append(joint->X_after.inverse());
        path.append(*joint, -1);
      }
      path.append(edge->left.inverse());
    }
  }
  return path;
}

void KinematicPath::append(const Pose& constant) {
  Pose& X = steps_.empty() ? X_before_ : steps_.back().X_after;
  X = X * constant;
}

void KinematicPath::append(const ScrewJoint& joint, double sense) {
  if (joint.signal < 0 || joint.signal >= num_signals())
    throw std::invalid_argument("a joint follows signal " + std::to_string(joint.signal) +
                                " and the schema has " + std::to_string(num_signals()));
  Pose& X = steps_.empty() ? X_before_ : steps_.back().X_after;
  Screw{joint.slide, joint.turn}.append_motion(sense * joint.offset, X.linear(), X.translation());
  const double rate = sense * joint.gain;
  if (rate == 0) return;
  steps_.push_back({.signal = joint.signal, .screw = {rate * joint.slide, rate * joint.turn}});
}

void KinematicPath::check_size(Eigen::Index num_values) const {
  if (num_values != static_cast<Eigen::Index>(signals_.size()))
    throw std::invalid_argument("action has " + std::to_string(num_values) + " values, not " +
                                std::to_string(signals_.size()));
}

Eigen::VectorXd KinematicPath::displacements(
    const Eigen::Ref<const Eigen::VectorXd>& action) const {
  Eigen::VectorXd theta = action;
  for (std::size_t s = 0; s < signals_.size(); ++s)
    theta(static_cast<Eigen::Index>(s)) =
        signals_[s].displacement(action(static_cast<Eigen::Index>(s)));
  return theta;
}

Pose KinematicPath::predict(const Eigen::Ref<const Eigen::VectorXd>& action) const {
  check_size(action.size());
  return predict_unchecked(action);
}

Pose KinematicPath::predict_unchecked(const Eigen::Ref<const Eigen::VectorXd>& action) const {
  Eigen::Matrix3d R = X_before_.linear();
  Eigen::Vector3d p = X_before_.translation();
  for (const Step& step : steps_) {
    if (step.leg < 0) {
      step.screw.append_motion(signals_[step.signal].displacement(action(step.signal)), R, p);
    } else {
      const Leg& leg = legs_[step.leg];
      Pose X = leg.edge.predict(displacements(action));
      if (!leg.is_forward) X = X.inverse();
      p += R * X.translation();
      R = (R * X.linear()).eval();
    }
    p.noalias() += R * step.X_after.translation();
    R = (R * step.X_after.linear()).eval();
  }
  Pose X_AB;
  X_AB.linear() = R;
  X_AB.translation() = p;
  X_AB.makeAffine();
  return X_AB;
}

Pose KinematicPath::predict(const Eigen::Ref<const Eigen::VectorXd>& action,
                            PoseJacobian* jacobian) const {
  check_size(action.size());
  PoseJacobian& J = *jacobian;
  J.setZero(6, action.size());
  // The suffix X: what lies between the step and B. From the last step to the first.
  Eigen::Matrix3d R = Eigen::Matrix3d::Identity();
  Eigen::Vector3d p = Eigen::Vector3d::Zero();
  for (auto step = steps_.rbegin(); step != steps_.rend(); ++step) {
    p = (step->X_after.linear() * p + step->X_after.translation()).eval();
    R = (step->X_after.linear() * R).eval();
    if (step->leg < 0) {
      const Signal& signal = signals_[step->signal];
      const double theta = signal.displacement(action(step->signal));
      const double rate = signal.displacement_rate(action(step->signal));
      // Exp(ŝθ) commutes with ŝ, so it drops out.
      step->screw.add_twist_after(R, p, rate, J.col(step->signal));
      step->screw.prepend_motion(theta, R, p);
    } else {
      const Leg& leg = legs_[step->leg];
      const Eigen::VectorXd theta = displacements(action);
      Pose X = leg.edge.predict(theta), suffix;
      Eigen::MatrixXd of_leg = leg.edge.jacobian(theta);
      if (!leg.is_forward) {
        of_leg = -adjoint(X) * of_leg;
        X = X.inverse();
      }
      for (int s = 0; s < num_signals(); ++s)
        of_leg.col(s) *= signals_[s].displacement_rate(action(s));
      suffix.linear() = R;
      suffix.translation() = p;
      suffix.makeAffine();
      J += adjoint(suffix.inverse()) * of_leg;
      p = (X.linear() * p + X.translation()).eval();
      R = (X.linear() * R).eval();
    }
  }
  Pose X_AB;
  X_AB.linear() = X_before_.linear() * R;
  X_AB.translation() = X_before_.linear() * p + X_before_.translation();
  X_AB.makeAffine();
  return X_AB;
}

Matrix6d KinematicPath::covariance(const Eigen::Ref<const Eigen::VectorXd>& action,
                                   Variance variance) const {
  check_size(action.size());
  const Eigen::VectorXd theta = displacements(action);
  Matrix6d sum = Matrix6d::Zero();
  for (const Leg& leg : legs_) {
    Pose X = leg.edge.predict(theta);
    Matrix6d covariance = variance == Variance::kEmpirical ? leg.edge.empirical_covariance()
                                                           : leg.edge.prediction_covariance(theta);
    Matrix6d scatter = Matrix6d::Zero();
    if (variance == Variance::kOneAction)
      scatter = leg.edge.scatter_covariance(theta) + leg.edge.unexplained_covariance(X, leg.noise);
    if (!leg.is_forward) {
      covariance = turned(covariance, X);
      scatter = turned(scatter, X);
      X = X.inverse();
    }
    if (leg.start && variance != Variance::kEmpirical) {
      sum = without(sum, *leg.start);
      covariance = turned(without(turned(covariance, X), *leg.start), X.inverse());
    }
    sum = turned(sum, X.inverse()) + covariance + scatter;
  }
  return sum;
}

std::vector<Pose> KinematicPath::predict_trajectory(const Eigen::MatrixXd& actions) const {
  check_size(actions.rows());
  std::vector<Pose> result;
  result.reserve(actions.cols());
  for (const auto& action : actions.colwise()) result.push_back(predict_unchecked(action));
  return result;
}

std::vector<PosePrediction> KinematicPath::predict_trajectory(const Eigen::MatrixXd& actions,
                                                              Variance variance) const {
  check_size(actions.rows());
  std::vector<PosePrediction> result;
  result.reserve(actions.cols());
  for (const auto& action : actions.colwise())
    result.push_back({predict_unchecked(action), covariance(action, variance)});
  return result;
}

std::vector<PoseJacobian> KinematicPath::jacobian_trajectory(const Eigen::MatrixXd& actions) const {
  check_size(actions.rows());
  std::vector<PoseJacobian> result(actions.cols());
  for (Eigen::Index t = 0; t < actions.cols(); ++t) predict(actions.col(t), &result[t]);
  return result;
}

std::optional<Matrix6d> empirical_covariance(const KinematicPath& path, int from, int to,
                                             const std::vector<ActionPoseSample>& samples) {
  constexpr std::size_t kFewest = 7;
  std::vector<Vector6d> residuals;
  for (const ActionPoseSample& sample : samples) {
    const PartObservation* a = sample.find(from);
    const PartObservation* b = sample.find(to);
    if (a && b && a->has_rotation && b->has_rotation)
      residuals.push_back(log(path.predict(sample.action).inverse() * a->X_CB.inverse() * b->X_CB));
  }
  if (residuals.size() < kFewest) return std::nullopt;
  Matrix6d covariance = Matrix6d::Zero();
  std::vector<double> sizes(residuals.size());
  for (int axis = 0; axis < 6; ++axis) {
    for (std::size_t t = 0; t < residuals.size(); ++t) sizes[t] = std::abs(residuals[t](axis));
    covariance(axis, axis) = std::pow(upper_median(sizes), 2) / chi_square_median(1);
  }
  std::vector<Vector6d> inliers, before;
  for (int step = 0; step < 20; ++step) {
    const Eigen::LDLT<Matrix6d> ldlt(covariance);
    inliers.clear();
    for (const Vector6d& r : residuals)
      if (r.dot(ldlt.solve(r)) <= kOutlierThreshold) inliers.push_back(r);
    if (inliers.size() < kFewest) return std::nullopt;
    if (inliers == before) break;
    covariance = empirical_covariance(inliers);
    before = inliers;
  }
  return covariance;
}

}  // namespace bodyschema
