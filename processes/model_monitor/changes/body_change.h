#pragma once

#include <compare>
#include <string>
#include <utility>
#include <vector>

#include "common/schema/body_schema.h"

namespace bodyschema {

/// What of a body may differ from its schema.
struct ElementId {
  enum class Kind {
    kCamera,  ///< the camera's pose; id: the root
    kJoint,   ///< the edge that leads to part `id`, with all its joints and links
    kTag      ///< the tags of part `id`, together
  };
  Kind kind = Kind::kJoint;
  int id = 0;  ///< of a part

  bool is_tag() const { return kind == Kind::kTag; }
  bool is_camera() const { return kind == Kind::kCamera; }
  bool operator==(const ElementId&) const = default;
  /// By parts, the tags of each last.
  auto operator<=>(const ElementId& other) const {
    return std::pair(id, kind) <=> std::pair(other.id, other.kind);
  }
};
/// The edge that leads to `part`; of the root the camera.
inline ElementId edge_element(int part, int root) {
  return {part == root ? ElementId::Kind::kCamera : ElementId::Kind::kJoint, part};
}
inline ElementId tag_element(int part) { return {ElementId::Kind::kTag, part}; }

/// How a body may differ from its schema in one place. θ: displacements (as a q + b is), transforms
/// as (translation [m], rotation vector [rad]) with T(θ) = (Exp(w), p).
struct BodyChange {
  enum class Form {
    kStored,       ///< a model of the history
    kStuck,        ///< the joint stands at a displacement: a = 0, b = θ
    kOffset,       ///< b + θ
    kGain,         ///< (1 + θ_0) a, b + θ_1
    kOtherSignal,  ///< the joint follows another signal
    kBent,         ///< T(θ) in a link: bent, a tool exchanged
    kBoth,         ///< T(θ_1) · Δ · T(θ_2)
    kRigid,        ///< no joint any more: T(θ) times the pose in mid-range
    kMarkerMoved,  ///< the marker of `part` is elsewhere on it by T(θ)
    kCamera,       ///< of the root: X_CR · T(θ)
    kNonlinear,    ///< a Gaussian process of one or two signals adds to the joint's displacement
    kResidual,     ///< Δ · Exp(ρ) with a Gaussian process ρ of one or two signals
    kFresh         ///< a constant pose and such a ρ: the edge is learned anew
  };
  Form form = Form::kBent;
  int part = 0;
  /// Where in the edge. kStuck, kOffset, kGain, kOtherSignal: the joint. kBent: the link, 0 before
  /// the first joint, d + 1 behind joint d.
  int at = 0;
  int signal = 0;          ///< kOtherSignal; the first input of a learned form
  bool small = false;      ///< a tenth as wide a prior: a little bent is likelier than broken
  int second_signal = -1;  ///< the other input of a learned form; −1: none
  /// Of the form's prior odds: of one place among those of the edge; of a learned form the
  /// proximity of the model's signals to those of the edge that stood, 0 … 1.
  double share = 1;

  /// The last three forms: functions and no parameters, so that FittedChange::origin holds the
  /// edge.
  bool is_learned() const { return form >= Form::kNonlinear; }
  /// Number of parameters θ.
  int size() const;
  /// log of the prior odds of this form against no change, before any data.
  double log_odds() const;
  /// Samples below which a form is not told from another.
  int fewest_samples() const;
  /// As in common/bus/cause_names.h.
  std::string cause(const BodySchema& schema) const;

  bool operator==(const BodyChange&) const = default;
};

/// The prior of θ: Gaussian, or uniform with this mean and this standard deviation.
struct ChangePrior {
  Eigen::VectorXd mean, sigma;
  bool is_uniform = false;

  /// Squared Mahalanobis distance of θ from the mean.
  double squared_distance(const Eigen::VectorXd& theta) const {
    return (theta - mean).cwiseQuotient(sigma).squaredNorm();
  }
  /// log of the density of θ times (2π)^(d/2).
  double log_density(const Eigen::VectorXd& theta) const;
};
ChangePrior prior_of(const BodyChange& change, const BodySchema& schema);

/// The schema with the change in it. Edges stay flat: left, joints, right. `covariance` of θ, if
/// not empty, adds to the covariances of the edges concerned.
/// @throws std::invalid_argument if the schema has no such place or θ has another size.
BodySchema changed(const BodySchema& schema, const BodyChange& change, const Eigen::VectorXd& theta,
                   const Eigen::MatrixXd& covariance = {});

/// All forms that a change of the element may have (kStored and what is learned apart).
std::vector<BodyChange> possible_changes(const BodySchema& schema, const ElementId& element);

/// T(θ) = (Exp(w), p) for θ = (p, w): independent of where the origin of rotation lies.
Pose transform(const Vector6d& theta);
/// ∂(right perturbation of T)/∂θ.
Matrix6d transform_jacobian(const Vector6d& theta);
/// θ of T.
Vector6d coordinates(const Pose& T);

/// The edge that leads to `part`; nullptr for the root and for unconnected parts.
const Edge* edge_to(const BodySchema& schema, int part);

}  // namespace bodyschema
