#pragma once

#include <Eigen/Core>
#include <map>
#include <memory>
#include <optional>
#include <vector>

#include "common/geometry/pose.h"
#include "common/schema/body_schema.h"

namespace bodyschema {

/// The way from the camera to a part at one sample: X_CB = X_CR ∏ X_edge, the root's pose and the
/// edges of screws read from parameter blocks, every other edge at its value.
class PartChain {
 public:
  /// `edges`: from the root outwards. `theta`: displacements of the signals. `first_play`: where
  /// the play of an edge's first joint is in the array of all joints' plays; empty where there is
  /// none.
  PartChain(const std::vector<const Edge*>& edges, const Eigen::VectorXd& theta,
            const std::map<const Edge*, int>& first_play = {});

  /// The root's pose and one for each edge that has a block.
  int num_blocks() const { return 1 + num_edge_blocks_; }

  using Jacobian = Eigen::Matrix<double, 6, Eigen::Dynamic>;
  /// X_CB · suffix from the blocks' values, the root's first. `jacobians`, if given, receives the
  /// derivatives by each block's whole tangent, right perturbation at the end.
  /// `play`: by how far each joint has gone beyond its command [command units], or null;
  /// `by_play`, of its size, receives the derivative.
  Pose pose(double const* const* blocks, const Pose& suffix, std::vector<Jacobian>* jacobians,
            const double* play = nullptr, Jacobian* by_play = nullptr) const;

  /// Whether an edge's values are in a block: it is of screws alone.
  static bool has_block(const Edge& edge) { return !edge.matrix_gp && !edge.residual_gp; }

 private:
  struct Link {
    bool has_block = true;
    std::vector<double> q;      ///< displacement of each joint
    std::vector<int> play;      ///< index of each joint's play, −1: none
    std::vector<double> gain;   ///< of each joint: displacement by command
    Pose X = Pose::Identity();  ///< the edge's pose, or its `right` where it has a block
  };
  std::vector<Link> links_;
  int num_edge_blocks_ = 0;
};

}  // namespace bodyschema
