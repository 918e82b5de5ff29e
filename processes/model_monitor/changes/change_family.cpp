#include "processes/model_monitor/changes/change_family.h"

#include <stdexcept>

#include "common/kinematics/screw_chain.h"

namespace bodyschema {

/// The table of priors, in the order of BodyChange::Form: cause, number of parameters, log odds,
/// fewest samples, widths. All chosen.
///
/// Log odds of the form against no change, where one is suspected: what was there before, breaks
/// often or is told by few numbers comes first; what contains another form comes after it, as the
/// evidence charges only for the width of θ. A sample is worth several nats, so that they decide
/// while there are few.
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
      {geometry_family(), "geometry", 6, -2.5, 2, {0.3, 1}},   // kLeft
      {geometry_family(), "geometry", 6, -2.5, 2, {0.3, 1}},   // kRight
      {geometry_family(), "geometry", 12, -6, 3, {0.2, 0.7}},  // kBoth
      {geometry_family(), "rigid", 6, -4, 2, {0.5, 1.5}},
      {marker_family(), "marker_moved", 6, -2.5, 2, {0.3, 1}},
      {camera_family(), "camera_moved", 6, -2.5, 2, {0.3, 1}},
      {learned, "joint_nonlinear", 0, -5, 5, {}},
      {learned, "new_model", 0, -5, 5, {}},   // kResidual
      {learned, "new_model", 0, -10, 8, {}},  // kFresh
  };
  return forms[static_cast<std::size_t>(change.form)];
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

Vector6d displacement_twist(const ScrewJoint& joint) {
  Vector6d screw = Vector6d::Zero();
  screw(2) = joint.slide;
  screw(5) = joint.turn;
  return adjoint(joint.X_after.inverse()) * screw;
}

}  // namespace bodyschema
