#pragma once

#include <optional>
#include <vector>

#include "common/estimation/measurement_model.h"
#include "common/schema/body_schema.h"
#include "common/schema/sample.h"

namespace bodyschema {

/// Covariance of an edge's prediction, right perturbation: to first order, and the scatter of its
/// joints; where it has a residual GP, which is too sure of itself where it was not trained, plus
/// what its left-out blocks showed.
Matrix6d model_covariance(const Edge& edge, const Eigen::VectorXd& theta);

/// What may be wrong with the schema at one instant. Nodes are the places of parts in
/// TreeFilter::parts(); "the edge of a node" is the one that leads to it from its parent, for the
/// root the camera's.
struct Alternative {
  int inflated_edge =
      -1;  ///< this edge is uncertain by `inflation` standard deviations of a marker
  double inflation = 0;
  std::vector<int> cut_edges = {};  ///< these edges say nothing
  int detached_node = -1;           ///< the marker of this node is not where it was
};

/// The pose of a part as everything but one element of the schema knows it, as if measured.
struct VirtualMeasurement {
  Pose z = Pose::Identity();
  Matrix6d covariance = Matrix6d::Zero();  ///< right perturbation
};

/// Likelihood of one instant's observations under a body schema: a Kalman filter along the tree.
///
/// The belief on a part's pose in the camera's frame (mean X, covariance P, right perturbation)
/// starts at the root with X_CR and goes outwards: X ← X·Δ_e(q), P ← F P Fᵀ + Σ_e(q) with F =
/// Ad(Δ⁻¹) and Σ_e = model_covariance(). A visible marker y has the density
///   (1 − ρ) N(ξ; 0, S) + ρ g(ξ),   ξ = log(X⁻¹ y), S = P + Σ_y,
/// with an outlier density g shaped as the outliers of planar markers are: flips, tilts of unknown
/// direction, wide errors and a floor. (With a uniform g every flip of a leaf's marker would speak
/// for a broken edge.) Misreadings are expected again (MeasurementModel::misread). A second reading
/// counts as one in ten. Where the first term is the larger one the marker corrects the belief.
/// What a branch learns goes back to its parent by the smoother's gain P Fᵀ P_child⁻¹, so that
/// siblings profit from each other.
class TreeFilter {
 public:
  /// Parts that are not connected to the root take no part. Edges that are kInvalid are cut.
  TreeFilter(const BodySchema& schema, const MeasurementModel& measurement);

  int num_nodes() const { return static_cast<int>(nodes_.size()); }
  /// Part id by node; node 0 is the root, parents come before children.
  int part(int node) const { return nodes_[node].part; }
  int parent(int node) const { return nodes_[node].parent; }
  /// Index into BodySchema::edges; −1 for the root.
  int edge(int node) const { return nodes_[node].edge; }
  const std::vector<int>& children(int node) const { return nodes_[node].children; }
  /// −1 if the part is not connected to the root.
  int node_of(int part) const;

  /// One instant, with all that does not depend on an alternative. Keeps no reference to `sample`.
  struct Instant {
    struct Seen {
      /// A position alone is turned as the schema predicts: MeasurementModel::reading().
      Pose X_CB;
      Matrix6d covariance;
      int num_residuals = 6;
      std::optional<Pose> X_CB_other;
      Matrix6d covariance_other;  ///< of X_CB_other, where there is one
    };
    std::vector<Pose> delta;          ///< by node: pose in the parent (root: in the camera)
    std::vector<Matrix6d> transport;  ///< Ad(delta⁻¹)
    std::vector<Matrix6d> edge_covariance;
    std::vector<std::optional<Seen>> seen;
  };
  /// @throws std::invalid_argument if the action does not have one value per signal.
  Instant prepare(const ActionPoseSample& sample) const;

  struct Judgement {
    double log_likelihood = 0;  ///< times MeasurementModel::worth
    /// By node: squared Mahalanobis distance of the marker from the belief that met it; −1 unseen.
    /// Of a position alone as_of_six().
    std::vector<double> squared_distance;
    /// By node: −1 unseen, 0 taken for an outlier, 1 believed.
    std::vector<int> believed;
  };
  Judgement judge(const Instant& instant, const Alternative& alternative = {}) const;
  /// That of a sample, without alternatives.
  double log_likelihood(const ActionPoseSample& sample) const {
    return judge(prepare(sample)).log_likelihood;
  }

  /// The pose of `node` in its parent (root: in the camera), from the markers on either side of its
  /// edge alone. std::nullopt if a side saw nothing.
  std::optional<VirtualMeasurement> measure_edge(const Instant& instant, int node) const;
  /// The pose of the node's marker in the part, as all other markers know the part.
  std::optional<VirtualMeasurement> measure_marker(const Instant& instant, int node) const;

 private:
  struct Node {
    int part = 0;
    int parent = -1;
    int edge = -1;
    bool is_cut = false;
    std::vector<Pose> misread;
    std::vector<int> children;
  };
  struct Belief {
    Pose X = Pose::Identity();
    Matrix6d P = Matrix6d::Zero();
  };
  class Walk;

  const BodySchema schema_;
  const MeasurementModel measurement_;
  std::vector<Node> nodes_;
};

/// log N(ξ; 0, S) in six dimensions; −∞ if S is not positive definite.
double log_normal_density(const Vector6d& xi, const Matrix6d& S);

/// Density of a pose anywhere in the room: 1/(8π² V), V = 8 m³.
double log_flat_density();

}  // namespace bodyschema
