#pragma once

#include <functional>
#include <optional>
#include <vector>

#include "processes/model_monitor/changes/body_change.h"
#include "processes/model_monitor/changes/change_size.h"

namespace bodyschema {

/// The pose of one place at one instant.
struct PlaceMeasurement {
  Eigen::VectorXd displacements;           ///< of all signals
  Pose z = Pose::Identity();               ///< as everything but the place's own model knows it
  Matrix6d covariance = Matrix6d::Zero();  ///< right perturbation
  Pose X = Pose::Identity();               ///< by the place's own model; of a marker the identity
  std::vector<Pose> links = {};            ///< link_poses() of that model
};

using ChangeJacobian = Eigen::Matrix<double, 6, Eigen::Dynamic>;
/// The pose of a changed place at a measurement. With a Jacobian, 6×d, also how it moves with θ:
/// X ← X · Exp(J dθ).
using PlacePrediction = std::function<Pose(const PlaceMeasurement&, ChangeJacobian*)>;

/// What the forms of change of one kind do to a schema. This base: they have no parameters and
/// leave the schema as it is.
class ChangeFamily {
 public:
  virtual ~ChangeFamily() = default;

  /// Whether the schema has what changes.
  virtual bool is_possible(const BodySchema&, const BodyChange&) const { return true; }
  /// As prior_of(), whatever BodyChange::small.
  virtual ChangePrior prior(const BodySchema&, const BodyChange&) const { return {}; }
  /// Values of θ from which the most probable one is sought.
  virtual std::vector<Eigen::VectorXd> starts(const BodySchema&, const BodyChange&,
                                              const std::vector<PlaceMeasurement>&) const {
    return {};
  }
  /// As changed(), in place.
  virtual void apply(const BodyChange&, const Eigen::VectorXd& /*theta*/,
                     const Eigen::MatrixXd& /*covariance*/, BodySchema*) const {}
  virtual PlacePrediction prediction(const BodySchema&, const BodyChange&,
                                     const Eigen::VectorXd& /*theta*/) const {
    return [](const PlaceMeasurement& m, ChangeJacobian*) { return m.X; };
  }
  /// As size_of(), of a change that is possible.
  virtual ChangeSize size(const BodySchema&, const BodyChange&, const Eigen::VectorXd& /*theta*/,
                          const Eigen::MatrixXd& /*covariance*/) const {
    return {};
  }
};

/// Transforms in the links of an edge; a base for all that moves poses.
class Geometry : public ChangeFamily {
 public:
  bool is_possible(const BodySchema& schema, const BodyChange& change) const override;
  ChangePrior prior(const BodySchema& schema, const BodyChange& change) const override;
  /// What each of the newest measurements alone says.
  std::vector<Eigen::VectorXd> starts(
      const BodySchema& schema, const BodyChange& change,
      const std::vector<PlaceMeasurement>& measurements) const override;
  void apply(const BodyChange& change, const Eigen::VectorXd& theta,
             const Eigen::MatrixXd& covariance, BodySchema* schema) const override;
  PlacePrediction prediction(const BodySchema& schema, const BodyChange& change,
                             const Eigen::VectorXd& theta) const override;
  /// How far what follows the place went with all signals in mid-range.
  ChangeSize size(const BodySchema& schema, const BodyChange& change, const Eigen::VectorXd& theta,
                  const Eigen::MatrixXd& covariance) const override;
};

/// A row of the table of forms (body_change.cpp).
struct ChangeForm {
  const ChangeFamily& family;
  const char* cause;
  int size;  ///< number of parameters
  double log_odds;
  int fewest_samples;
  /// Transforms: [m], [rad]. Joints: of the displacement, as a share of its range; of the gain.
  double sigma[2];
};
const ChangeForm& form_of(const BodyChange& change);
/// log odds of every form with BodyChange::small: behind those of a large one.
constexpr double kSmallLogOdds = -3.5;
constexpr double kSmallWidth = 0.1;  ///< in widths of a large one
/// log odds that one input of a learned function costs.
constexpr double kInputLogOdds = -3;

const ChangeFamily& joint_family();
const ChangeFamily& geometry_family();
const ChangeFamily& marker_family();
const ChangeFamily& camera_family();

/// @throws std::invalid_argument if there is none.
Edge& edge_at(BodySchema* schema, int part);
/// A constant pose instead of the edge's model.
void make_constant(const Pose& X, Edge* edge);
/// Adds to the covariance of the edge's parameters (ScrewChainLayout) from `at` on.
void add_covariance(const Eigen::MatrixXd& covariance, int at, Edge* edge);
Vector6d screw_twist(const ScrewJoint& joint);
/// What a joint's displacement does to its X_after, as a right perturbation of that.
Vector6d displacement_twist(const ScrewJoint& joint);
/// Where a change of each link stands, of an edge with the pose X: with T in link d the pose is
/// X_d · T · X_d⁻¹ · X. X_0 is the identity, that of an inner link the frame of the joint that it
/// carries, the last one X. Of a rigid edge, or none, X alone.
std::vector<Pose> link_poses(const Edge* edge, const Eigen::VectorXd& displacements, const Pose& X);
/// The signal of the joint that carries a link of an edge of several joints; −1: none does, or
/// there is one joint.
int carrying_signal(const Edge* edge, int link);

/// The link that differs between two models of an edge, if it is one.
std::optional<int> link_difference(const Edge& old, const Edge& now);
/// What became of a joint, if one joint and nothing else differs between two models of an edge.
std::optional<FoundDifference> joint_difference(const BodySchema& before, const Edge& old,
                                                const Edge& now);

}  // namespace bodyschema
