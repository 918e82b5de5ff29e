#pragma once

#include <string>
#include <vector>

#include "common/schema/body_schema.h"

namespace bodyschema {

/// Where a body may differ from its schema: the edge that leads to `part` (for the root the
/// camera's), or the part's marker.
struct Place {
  int part = 0;
  bool marker = false;
  auto operator<=>(const Place&) const = default;
};

/// How a body may differ from its schema in one place.
struct BodyChange {
  enum class Form {
    kStored,       ///< a model of the history
    kStuck,        ///< the joint stands at a displacement: a = 0, b = θ
    kOffset,       ///< b + θ
    kGain,         ///< (1 + θ_0) a, b + θ_1
    kLeft,         ///< T(θ) · Δ: what carries the joint was bent
    kRight,        ///< Δ · T(θ): what the joint carries was bent, a tool exchanged
    kBoth,         ///< T(θ_1) · Δ · T(θ_2)
    kRigid,        ///< no joint any more: T(θ) times the pose in mid-range
    kMarkerMoved,  ///< the marker of `part` is elsewhere on it by T(θ)
    kOtherSignal,  ///< the joint follows another signal
    kNonlinear,    ///< a Gaussian process of one or two signals adds to the joint's displacement
    kResidual,     ///< Δ · Exp(ρ) with a Gaussian process ρ of one or two signals
    kFresh         ///< a constant pose and such a ρ: the edge is learned anew
  };
  Form form = Form::kRight;
  int part = 0;
  int joint = 0;       ///< of the edge: for kStuck, kOffset, kGain, kOtherSignal
  int signal = 0;      ///< kOtherSignal; of what is learned the first input
  bool small = false;  ///< a tenth as wide a prior: what is bent a little is likelier than a break
  int second_signal = -1;  ///< of what is learned the other input, if not −1
  double proximity = 1;    ///< of the model's signals to those of the edge that stood, 0 … 1

  /// The last three forms: functions and no parameters, so that FittedChange::origin holds the
  /// edge.
  bool is_learned() const { return form >= Form::kNonlinear; }

  /// Number of parameters θ: displacements (as a q + b is), transforms as (translation [m],
  /// rotation vector [rad]) with T = (Exp(w), p).
  int size() const;
  /// log of the prior odds of this form against no change, before any data.
  double log_odds() const;
  /// Samples below which a form is not told from another.
  int fewest_samples() const;
  /// "joint_stuck", "joint_offset", "joint_gain", "joint_nonlinear", "geometry", "new_model",
  /// "marker_moved", "camera_moved", …
  std::string cause(const BodySchema& schema) const;

  bool operator==(const BodyChange&) const = default;
};

/// Standard deviations of the Gaussian prior of θ about 0 (kStuck: about mid-range; it is uniform
/// within the limits there, and its standard deviation is that of the uniform one).
Eigen::VectorXd prior_sigma(const BodyChange& change, const BodySchema& schema);
/// Centre of that prior.
Eigen::VectorXd prior_mean(const BodyChange& change, const BodySchema& schema);

/// The schema with the change in it. Edges stay flat: left, joints, right. `covariance` of θ, if
/// not empty, adds to the covariances of the edges concerned.
/// @throws std::invalid_argument if the schema has no such place or θ has another size.
BodySchema changed(const BodySchema& schema, const BodyChange& change, const Eigen::VectorXd& theta,
                   const Eigen::MatrixXd& covariance = {});

/// T(θ) = (Exp(w), p) for θ = (p, w): independent of where the origin of rotation lies.
Pose transform(const Vector6d& theta);
/// ∂(right perturbation of T)/∂θ.
Matrix6d transform_jacobian(const Vector6d& theta);
/// θ of T.
Vector6d coordinates(const Pose& T);

/// What a joint's displacement does to its X_after, as a right perturbation of that.
Vector6d displacement_twist(const ScrewJoint& joint);

/// The edge that leads to `part`; nullptr for the root and for unconnected parts.
const Edge* edge_to(const BodySchema& schema, int part);

/// All forms that a change of the place may have (kStored and what is learned apart).
std::vector<BodyChange> possible_changes(const BodySchema& schema, int part, bool marker);

/// The ratio of shared to all nodes of the Bayesian networks of two local models of one pair of
/// parts: (2 + |Q₁ ∩ Q₂|) / (2 + |Q₁ ∪ Q₂|).
double structural_proximity(const std::vector<int>& signals, const std::vector<int>& other);

}  // namespace bodyschema
