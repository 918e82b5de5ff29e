#include "processes/model_monitor/changes/body_change.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "common/kinematics/screw_chain.h"
#include "processes/model_monitor/changes/change_family.h"

namespace bodyschema {

/// The table of priors, in the order of BodyChange::Form: cause, number of parameters, log odds,
/// fewest samples, widths. All chosen.
///
/// Log odds of the form against no change, where one is suspected: what was there before, breaks
/// often or has few numbers comes first; what contains another form comes after it. A sample is
/// worth several nats, so they decide while there are few. The joints of an edge share the odds of
/// one joint, its links those of two.
/// Fewest samples: as many as determine θ with something left to judge it by.
/// Widths: a transform goes about as far as a link is long, those of kBoth together as far as one
/// (0.3 m / √2), one in a joint's stead also as far as that went; a displacement goes by a third of
/// its range, a gain to nothing or its double.
const ChangeForm& form_of(const BodyChange& change) {
  static const ChangeFamily stored, learned;  // these have no parameters
  static const ChangeForm forms[] = {
      {stored, "stored", 0, -1, 1, {}},
      {joint_family(), "joint_stuck", 1, -2, 1, {}},  // anywhere within the limits
      {joint_family(), "joint_offset", 1, -3, 1, {0.3}},
      {joint_family(), "joint_gain", 2, -5, 2, {0.3, 1}},
      {joint_family(), "other_signal", 0, -6, 2, {}},
      {geometry_family(), "geometry", 6, -2.5, 2, {0.3, 1}},   // kBent
      {geometry_family(), "geometry", 12, -6, 3, {0.2, 0.7}},  // kBoth
      {geometry_family(), "rigid", 6, -4, 2, {0.5, 1.5}},
      {marker_family(), "marker_moved", 6, -2.5, 2, {0.3, 1}},
      {camera_family(), "camera_moved", 6, -2.5, 2, {0.3, 1}},
      {learned, "joint_nonlinear", 0, -5, 5, {}},
      {learned, "new_model", 0, -5, 5, {}},   // kResidual
      {learned, "new_model", 0, -10, 8, {}},  // kFresh
  };
  static_assert(std::size(forms) == static_cast<std::size_t>(BodyChange::Form::kFresh) + 1);
  return forms[static_cast<std::size_t>(change.form)];
}

int BodyChange::size() const { return form_of(*this).size; }

double BodyChange::log_odds() const {
  double log_odds = (small ? kSmallLogOdds : form_of(*this).log_odds) + std::log(share);
  if (is_learned()) log_odds += (second_signal >= 0 ? 2 : 1) * kInputLogOdds;
  return log_odds;
}

int BodyChange::fewest_samples() const { return form_of(*this).fewest_samples; }

std::string BodyChange::cause(const BodySchema& schema) const {
  const bool is_camera = form == Form::kStored && part == schema.root;
  return is_camera ? "camera_moved" : form_of(*this).cause;
}

double ChangePrior::log_density(const Eigen::VectorXd& theta) const {
  if (is_uniform) return 0.5 * std::log(2 * M_PI) - std::log(sigma(0) * std::sqrt(12.0));
  return -0.5 * squared_distance(theta) - sigma.array().log().sum();
}

ChangePrior prior_of(const BodyChange& change, const BodySchema& schema) {
  ChangePrior prior = form_of(change).family.prior(schema, change);
  if (change.small) prior.sigma *= kSmallWidth;
  return prior;
}

BodySchema changed(const BodySchema& schema, const BodyChange& change, const Eigen::VectorXd& theta,
                   const Eigen::MatrixXd& covariance) {
  if (theta.size() != change.size()) throw std::invalid_argument("wrong number of parameters");
  BodySchema result = schema;
  form_of(change).family.apply(change, theta, covariance, &result);
  return result;
}

std::vector<BodyChange> possible_changes(const BodySchema& schema, const ElementId& element) {
  using Form = BodyChange::Form;
  const int part = element.id;
  std::vector<BodyChange> result;
  const auto add = [&](Form form, int at, double share, int signal = 0) {
    result.push_back({form, part, at, signal});
    result.back().share = share;
  };
  const auto add_both_sizes = [&](Form form, int at = 0, double share = 1) {
    add(form, at, share);
    add(form, at, share);
    result.back().small = true;
  };
  const Edge* edge = edge_to(schema, part);
  if (element.is_tag()) add_both_sizes(Form::kMarkerMoved);
  if (!element.is_tag() && !edge && part == schema.root) add_both_sizes(Form::kCamera);
  if (element.is_tag() || !edge) return result;
  const int num_joints = static_cast<int>(edge->joints.size());
  for (int d = 0; d < num_joints; ++d) {
    const ScrewJoint& j = edge->joints[static_cast<std::size_t>(d)];
    const double share = 1.0 / num_joints;
    add(Form::kStuck, d, share);
    if (j.gain == 0) continue;  // it is stuck: elsewhere is all that it can be
    add_both_sizes(Form::kOffset, d, share);
    add(Form::kGain, d, share);
    for (int s = 0; s < static_cast<int>(schema.signals.size()); ++s)
      if (s != j.signal) add(Form::kOtherSignal, d, share, s);
  }
  for (int link = num_joints; link >= 0; --link)
    add_both_sizes(Form::kBent, link, std::min(1.0, 2.0 / (num_joints + 1)));
  if (num_joints == 0) return result;
  result.push_back({Form::kBoth, part});
  result.push_back({Form::kRigid, part});
  return result;
}

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

const Edge* edge_to(const BodySchema& schema, int part) {
  for (const Edge& edge : schema.edges)
    if (edge.to == part) return &edge;
  return nullptr;
}

Edge& edge_at(BodySchema* schema, int part) {
  for (Edge& edge : schema->edges)
    if (edge.to == part) return edge;
  throw std::invalid_argument("no edge leads to part " + std::to_string(part));
}

void make_constant(const Pose& X, Edge* edge) {
  edge->left = X;
  edge->right = Pose::Identity();
  edge->joints.clear();
  edge->matrix_gp.reset();
  edge->residual_gp.reset();
  edge->parameter_covariance = Eigen::MatrixXd::Zero(6, 6);
}

void add_covariance(const Eigen::MatrixXd& covariance, int at, Edge* edge) {
  const int size = ScrewChainLayout::size(static_cast<int>(edge->joints.size()));
  if (edge->parameter_covariance.rows() != size)
    edge->parameter_covariance = Eigen::MatrixXd::Zero(size, size);
  edge->parameter_covariance.block(at, at, covariance.rows(), covariance.cols()) += covariance;
}

Vector6d screw_twist(const ScrewJoint& joint) {
  Vector6d screw = Vector6d::Zero();
  screw(2) = joint.slide;
  screw(5) = joint.turn;
  return screw;
}

Vector6d displacement_twist(const ScrewJoint& joint) {
  return adjoint(joint.X_after.inverse()) * screw_twist(joint);
}

std::vector<Pose> link_poses(const Edge* edge, const Eigen::VectorXd& displacements,
                             const Pose& X) {
  std::vector<Pose> poses;
  Pose at = edge ? edge->left : Pose::Identity();
  for (std::size_t d = 0; edge && d < edge->joints.size(); ++d) {
    const ScrewJoint& joint = edge->joints[d];
    poses.push_back(d == 0 ? Pose::Identity() : at);
    const double q = joint.gain * displacements(joint.signal) + joint.offset;
    Screw{joint.slide, joint.turn}.append_motion(q, at.linear(), at.translation());
    at = at * joint.X_after;
  }
  poses.push_back(X);
  return poses;
}

}  // namespace bodyschema
