#include "processes/model_monitor/body_change.h"

#include <algorithm>
#include <cmath>
#include <set>
#include <stdexcept>

namespace bodyschema {
namespace {

using Form = BodyChange::Form;

Edge* edge_to(BodySchema* schema, int part) {
  for (Edge& edge : schema->edges)
    if (edge.to == part) return &edge;
  return nullptr;
}

void make_room(Edge* edge) {
  const auto size = 6 + 8 * static_cast<Eigen::Index>(edge->joints.size());
  if (edge->parameter_covariance.rows() != size)
    edge->parameter_covariance = Eigen::MatrixXd::Zero(size, size);
}

/// Adds a right perturbation of `left`, or of the last X_after (`last`).
void add_uncertainty(Edge* edge, bool last, const Matrix6d& covariance) {
  make_room(edge);
  const Eigen::Index at =
      last && !edge->joints.empty() ? 8 * static_cast<Eigen::Index>(edge->joints.size()) : 0;
  edge->parameter_covariance.block<6, 6>(at, at) += covariance;
}

void multiply_right(Edge* edge, const Vector6d& theta, const Matrix6d* covariance) {
  edge->right = edge->right * transform(theta);
  if (!covariance) return;
  const Matrix6d J = adjoint(edge->right) * transform_jacobian(theta);
  add_uncertainty(edge, true, J * *covariance * J.transpose());
}

void multiply_left(Edge* edge, const Vector6d& theta, const Matrix6d* covariance) {
  if (covariance) {
    const Matrix6d J = adjoint(edge->left.inverse()) * transform_jacobian(theta);
    add_uncertainty(edge, false, J * *covariance * J.transpose());
  }
  edge->left = transform(theta) * edge->left;
}

/// Uncertainty of a joint's displacement: a right perturbation of its X_after.
void add_displacement_variance(Edge* edge, int joint, double variance) {
  make_room(edge);
  const ScrewJoint& j = edge->joints[static_cast<std::size_t>(joint)];
  const Vector6d along = displacement_twist(j);
  const Eigen::Index at = 8 + 8 * static_cast<Eigen::Index>(joint);
  edge->parameter_covariance.block<6, 6>(at, at) += variance * along * along.transpose();
}

double range(const BodySchema& schema, int signal) {
  const Signal& s = schema.signals.at(static_cast<std::size_t>(signal));
  return std::max(s.upper - s.lower, 1e-9);
}

}  // namespace

Pose transform(const Vector6d& theta) {
  Pose T = Pose::Identity();
  T.linear() = exp_so3(theta.tail<3>());
  T.translation() = theta.head<3>();
  return T;
}

Matrix6d transform_jacobian(const Vector6d& theta) {
  Vector6d rotation = Vector6d::Zero();
  rotation.tail<3>() = theta.tail<3>();
  Matrix6d J = Matrix6d::Zero();
  J.topLeftCorner<3, 3>() = exp_so3(theta.tail<3>()).transpose();
  J.bottomRightCorner<3, 3>() =
      right_jacobian_inverse(rotation).bottomRightCorner<3, 3>().inverse();
  return J;
}

Vector6d coordinates(const Pose& T) {
  Vector6d theta;
  theta << T.translation(), log_so3(T.linear());
  return theta;
}

Vector6d displacement_twist(const ScrewJoint& joint) {
  Vector6d screw = Vector6d::Zero();
  screw(2) = joint.slide;
  screw(5) = joint.turn;
  return adjoint(joint.X_after.inverse()) * screw;
}

const Edge* edge_to(const BodySchema& schema, int part) {
  return edge_to(const_cast<BodySchema*>(&schema), part);
}

int BodyChange::size() const {
  switch (form) {
    case Form::kStored:
    case Form::kOtherSignal:
    case Form::kNonlinear:
    case Form::kResidual:
    case Form::kFresh:
      return 0;
    case Form::kStuck:
    case Form::kOffset:
      return 1;
    case Form::kGain:
      return 2;
    case Form::kBoth:
      return 12;
    default:
      return 6;
  }
}

double BodyChange::log_odds() const {
  if (small) return -3.5;
  const double complexity = second_signal >= 0 ? 6 : 3;
  switch (form) {
    case Form::kStored:
      return -1;
    case Form::kStuck:
      return -2;
    case Form::kOffset:
      return -3;
    case Form::kRigid:
      return -4;
    case Form::kGain:
      return -5;
    case Form::kBoth:
    case Form::kOtherSignal:
      return -6;
    case Form::kNonlinear:
    case Form::kResidual:
      return -5 - complexity + std::log(proximity);
    case Form::kFresh:
      return -10 - complexity + std::log(proximity);
    default:
      return -2.5;
  }
}

int BodyChange::fewest_samples() const {
  switch (form) {
    case Form::kStored:
    case Form::kStuck:
    case Form::kOffset:
      return 1;
    case Form::kBoth:
      return 3;
    case Form::kNonlinear:
    case Form::kResidual:
      return 5;
    case Form::kFresh:
      return 8;
    default:
      return 2;
  }
}

std::string BodyChange::cause(const BodySchema& schema) const {
  switch (form) {
    case Form::kStored:
      return part == schema.root ? "camera_moved" : "stored";
    case Form::kStuck:
      return "joint_stuck";
    case Form::kOffset:
      return "joint_offset";
    case Form::kGain:
      return "joint_gain";
    case Form::kRigid:
      return "rigid";
    case Form::kMarkerMoved:
      return "marker_moved";
    case Form::kOtherSignal:
      return "other_signal";
    case Form::kNonlinear:
      return "joint_nonlinear";
    case Form::kResidual:
    case Form::kFresh:
      return "new_model";
    default:
      return part == schema.root ? "camera_moved" : "geometry";
  }
}

Eigen::VectorXd prior_sigma(const BodyChange& change, const BodySchema& schema) {
  Eigen::VectorXd sigma(change.size());
  const Edge* edge = edge_to(schema, change.part);
  // Of the displacement a q + b; what a stuck joint's was is not known.
  const auto joint_range = [&] {
    const ScrewJoint& joint = edge->joints.at(static_cast<std::size_t>(change.joint));
    return range(schema, joint.signal) * (joint.gain != 0 ? std::abs(joint.gain) : 1);
  };
  switch (change.form) {
    case Form::kStuck:
      sigma << joint_range() / std::sqrt(12);
      break;
    case Form::kOffset:
      sigma << 0.3 * joint_range();
      break;
    case Form::kGain:
      sigma << 1, 0.3 * joint_range();
      break;
    case Form::kRigid:
      sigma << 0.5, 0.5, 0.5, 1.5, 1.5, 1.5;
      break;
    case Form::kBoth:
      sigma << 0.2, 0.2, 0.2, 0.7, 0.7, 0.7, 0.2, 0.2, 0.2, 0.7, 0.7, 0.7;
      break;
    default:
      if (change.size() == 6) sigma << 0.3, 0.3, 0.3, 1, 1, 1;
  }
  if (change.small) sigma *= 0.1;
  return sigma;
}

Eigen::VectorXd prior_mean(const BodyChange& change, const BodySchema& schema) {
  Eigen::VectorXd mean = Eigen::VectorXd::Zero(change.size());
  if (change.form == Form::kStuck) {
    const ScrewJoint& j =
        edge_to(schema, change.part)->joints.at(static_cast<std::size_t>(change.joint));
    const Signal& s = schema.signals.at(static_cast<std::size_t>(j.signal));
    mean(0) = j.gain * 0.5 * (s.lower + s.upper) + j.offset;
  }
  return mean;
}

BodySchema changed(const BodySchema& schema, const BodyChange& change, const Eigen::VectorXd& theta,
                   const Eigen::MatrixXd& covariance) {
  if (theta.size() != change.size()) throw std::invalid_argument("wrong number of parameters");
  BodySchema result = schema;
  if (change.form == Form::kStored || change.is_learned()) return result;
  const bool is_unsure = covariance.size() > 0;
  Matrix6d first, second;
  if (is_unsure && change.size() >= 6) first = covariance.topLeftCorner<6, 6>();
  if (is_unsure && change.size() == 12) second = covariance.bottomRightCorner<6, 6>();
  const Matrix6d* of_first = is_unsure ? &first : nullptr;

  const auto move_camera = [&](const Vector6d& t) {
    result.X_CR = result.X_CR * transform(t);
    if (!is_unsure) return;
    const Matrix6d J = transform_jacobian(t);
    result.X_CR_covariance += J * first * J.transpose();
  };
  if (change.form == Form::kMarkerMoved) {
    Edge* in = edge_to(&result, change.part);
    if (in) {
      multiply_right(in, theta, of_first);
    } else if (change.part == schema.root) {
      move_camera(theta);
    } else {
      throw std::invalid_argument("part " + std::to_string(change.part) + " is not connected");
    }
    // What hangs on the part stays where it is.
    for (Edge& out : result.edges)
      if (out.from == change.part) out.left = transform(theta).inverse() * out.left;
    return result;
  }
  Edge* edge = edge_to(&result, change.part);
  if (!edge) {
    if (change.part != schema.root || change.size() != 6)
      throw std::invalid_argument("no edge leads to part " + std::to_string(change.part));
    move_camera(theta);
    return result;
  }
  const auto joint = [&]() -> ScrewJoint& {
    return edge->joints.at(static_cast<std::size_t>(change.joint));
  };
  switch (change.form) {
    case Form::kStuck:
      joint().gain = 0;
      joint().offset = theta(0);
      if (is_unsure) add_displacement_variance(edge, change.joint, covariance(0, 0));
      break;
    case Form::kOffset:
      joint().offset += theta(0);
      if (is_unsure) add_displacement_variance(edge, change.joint, covariance(0, 0));
      break;
    case Form::kGain:
      if (is_unsure) {
        // Of the gain: as an uncertainty of slide and turn.
        make_room(edge);
        const Eigen::Vector2d along(joint().slide, joint().turn);
        const double share = 1 / std::max(std::abs(1 + theta(0)), 0.1);
        const Eigen::Index at = 6 + 8 * static_cast<Eigen::Index>(change.joint);
        edge->parameter_covariance.block<2, 2>(at, at) +=
            share * share * covariance(0, 0) * along * along.transpose();
        add_displacement_variance(edge, change.joint, covariance(1, 1));
      }
      joint().gain *= 1 + theta(0);
      joint().offset += theta(1);
      break;
    case Form::kOtherSignal:
      joint().signal = change.signal;
      break;
    case Form::kLeft:
      multiply_left(edge, theta, of_first);
      break;
    case Form::kRight:
      multiply_right(edge, theta, of_first);
      break;
    case Form::kBoth:
      multiply_left(edge, theta.head<6>(), of_first);
      multiply_right(edge, theta.tail<6>(), is_unsure ? &second : nullptr);
      break;
    case Form::kRigid: {
      edge->left = edge->predict(schema.displacements(mid_range(schema.signals)));
      edge->right = Pose::Identity();
      edge->joints.clear();
      edge->matrix_gp.reset();
      edge->residual_gp.reset();
      edge->parameter_covariance = Eigen::MatrixXd::Zero(6, 6);
      multiply_right(edge, theta, of_first);
      break;
    }
    default:
      throw std::invalid_argument("not a change of an edge");
  }
  return result;
}

std::vector<BodyChange> possible_changes(const BodySchema& schema, int part, bool marker) {
  std::vector<BodyChange> result;
  if (marker) {
    for (const bool small : {false, true})
      result.push_back({Form::kMarkerMoved, part, 0, 0, small});
    return result;
  }
  const Edge* edge = edge_to(schema, part);
  if (!edge) {
    if (part == schema.root)
      for (const bool small : {false, true}) result.push_back({Form::kRight, part, 0, 0, small});
    return result;
  }
  for (int joint = 0; joint < static_cast<int>(edge->joints.size()); ++joint) {
    const ScrewJoint& j = edge->joints[static_cast<std::size_t>(joint)];
    result.push_back({Form::kStuck, part, joint});
    if (j.gain == 0) continue;  // it is stuck: elsewhere is all that it can be
    for (const bool small : {false, true}) result.push_back({Form::kOffset, part, joint, 0, small});
    result.push_back({Form::kGain, part, joint});
    for (int s = 0; s < static_cast<int>(schema.signals.size()); ++s)
      if (s != j.signal) result.push_back({Form::kOtherSignal, part, joint, s});
  }
  for (const bool small : {false, true}) {
    result.push_back({Form::kRight, part, 0, 0, small});
    if (!edge->joints.empty()) result.push_back({Form::kLeft, part, 0, 0, small});
  }
  if (!edge->joints.empty()) {
    result.push_back({Form::kBoth, part});
    result.push_back({Form::kRigid, part});
  }
  return result;
}

double structural_proximity(const std::vector<int>& signals, const std::vector<int>& other) {
  const std::set<int> a(signals.begin(), signals.end()), b(other.begin(), other.end());
  std::set<int> all = a;
  all.insert(b.begin(), b.end());
  const double num_shared = static_cast<double>(a.size() + b.size() - all.size());
  return (2 + num_shared) / (2 + static_cast<double>(all.size()));
}

}  // namespace bodyschema
