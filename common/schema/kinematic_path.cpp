#include "common/schema/kinematic_path.h"

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <map>
#include <stdexcept>

namespace bodyschema {
namespace {

struct EdgeStep {
  const Edge* edge;
  bool is_forward;
};

/// Breadth first; works for edges in any order.
std::optional<std::vector<EdgeStep>> edges_between(const std::vector<Edge>& edges, int from,
                                                   int to) {
  std::map<int, EdgeStep> reached_by{{from, {nullptr, true}}};
  std::vector<int> queue{from};
  for (std::size_t head = 0; head < queue.size() && !reached_by.count(to); ++head) {
    for (const Edge& edge : edges) {
      const bool is_forward = edge.from == queue[head];
      if (!is_forward && edge.to != queue[head]) continue;
      const int other = is_forward ? edge.to : edge.from;
      if (reached_by.emplace(other, EdgeStep{&edge, is_forward}).second) queue.push_back(other);
    }
  }
  if (!reached_by.count(to)) return std::nullopt;
  std::vector<EdgeStep> path;
  for (int part = to; part != from;) {
    path.push_back(reached_by.at(part));
    part = path.back().is_forward ? path.back().edge->from : path.back().edge->to;
  }
  std::reverse(path.begin(), path.end());
  return path;
}

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
  const auto edges = edges_between(schema.edges, from, to);
  if (!edges) return std::nullopt;
  KinematicPath path;
  path.signals_ = schema.signals;
  for (const auto& [edge, is_forward] : *edges) {
    const auto start = schema.frame_covariances.find(is_forward ? edge->from : edge->to);
    path.legs_.push_back({*edge, is_forward});
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
  Pose offset = Pose::Identity();
  offset.linear() =
      Eigen::AngleAxisd(sense * joint.turn * joint.offset, Eigen::Vector3d::UnitZ()).matrix();
  offset.translation().z() = sense * joint.slide * joint.offset;
  append(offset);
  const double rate = sense * joint.gain;
  if (rate == 0) return;
  steps_.push_back(
      {.signal = joint.signal, .slide = rate * joint.slide, .turn = rate * joint.turn});
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
      // X · Exp(ŝθ) without the product: z stays, x and y turn about it.
      const double theta = signals_[step.signal].displacement(action(step.signal));
      const double c = std::cos(step.turn * theta), s = std::sin(step.turn * theta);
      p += step.slide * theta * R.col(2);
      const Eigen::Vector3d x = R.col(0);
      R.col(0) = c * x + s * R.col(1);
      R.col(1) = c * R.col(1) - s * x;
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
      // Exp(ŝθ) commutes with ŝ, so it drops out; of Ad(X⁻¹) only translation along and rotation
      // about z are needed.
      const Eigen::Vector3d z = R.row(2).transpose();
      const Eigen::Vector3d lever = p.x() * R.row(1).transpose() - p.y() * R.row(0).transpose();
      J.col(step->signal).head<3>() += rate * (step->slide * z + step->turn * lever);
      J.col(step->signal).tail<3>() += rate * step->turn * z;
      const double c = std::cos(step->turn * theta), s = std::sin(step->turn * theta);
      const Eigen::RowVector3d x = R.row(0);
      R.row(0) = c * x - s * R.row(1);
      R.row(1) = s * x + c * R.row(1);
      p = Eigen::Vector3d(c * p.x() - s * p.y(), s * p.x() + c * p.y(),
                          p.z() + step->slide * theta);
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
    Matrix6d covariance = variance == Variance::kFirstOrder ? leg.edge.prediction_covariance(theta)
                                                            : leg.edge.empirical_covariance();
    if (!leg.is_forward) {
      covariance = turned(covariance, X);
      X = X.inverse();
    }
    if (leg.start && variance == Variance::kFirstOrder) {
      sum = without(sum, *leg.start);
      covariance = turned(without(turned(covariance, X), *leg.start), X.inverse());
    }
    sum = turned(sum, X.inverse()) + covariance;
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
  constexpr double kOutlier = 20.06;             // χ²₆(.9973)
  constexpr double kDeviationOfMedian = 1.4826;  // of a normal distribution
  constexpr std::size_t kFewest = 7;
  std::vector<Vector6d> residuals;
  for (const ActionPoseSample& sample : samples) {
    const PartObservation* a = sample.find(from);
    const PartObservation* b = sample.find(to);
    if (a && b)
      residuals.push_back(log(path.predict(sample.action).inverse() * a->X_CB.inverse() * b->X_CB));
  }
  if (residuals.size() < kFewest) return std::nullopt;
  Matrix6d covariance = Matrix6d::Zero();
  std::vector<double> sizes(residuals.size());
  for (int axis = 0; axis < 6; ++axis) {
    for (std::size_t t = 0; t < residuals.size(); ++t) sizes[t] = std::abs(residuals[t](axis));
    const auto middle = sizes.begin() + static_cast<std::ptrdiff_t>(sizes.size() / 2);
    std::nth_element(sizes.begin(), middle, sizes.end());
    covariance(axis, axis) = std::pow(kDeviationOfMedian * *middle, 2);
  }
  std::vector<Vector6d> inliers, before;
  for (int step = 0; step < 20; ++step) {
    const Eigen::LDLT<Matrix6d> ldlt(covariance);
    inliers.clear();
    for (const Vector6d& r : residuals)
      if (r.dot(ldlt.solve(r)) <= kOutlier) inliers.push_back(r);
    if (inliers.size() < kFewest) return std::nullopt;
    if (inliers == before) break;
    covariance = empirical_covariance(inliers);
    before = inliers;
  }
  return covariance;
}

}  // namespace bodyschema
