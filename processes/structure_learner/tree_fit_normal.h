#pragma once

#include <Eigen/Cholesky>
#include <algorithm>
#include <optional>
#include <vector>

#include "common/estimation/cholesky.h"
#include "processes/structure_learner/tree_fit.h"

namespace bodyschema {

/// Gauss–Newton quantities, all twists in the camera's frame.
struct TreeFit::Normal {
  Eigen::MatrixXd H;
  Eigen::VectorXd g;
  std::vector<int> offset;           // of a node's parameters; the root's 6 come first if it rests
  std::vector<ParameterJacobian> S;  // at(frame, node): 6 × parameters of its edge
  std::vector<Matrix6d> I;           // at(frame, node): information of the markers from there on
  std::vector<Vector6d> gradient;
  std::vector<Matrix6d> own_I;  // of the node's own marker
  std::vector<Vector6d> own_gradient;
  std::vector<Matrix6d> inverse_total;  // a frame: I of the root, inverted
  double weighted = 0, weights = 0;     // sums of w² d² over the markers, of w over the residuals
  int num_residuals = 0;
  double scale = 1;  // variance of the weighted residuals over what the weights say

  double noise_scale() const { return std::max(scale, 0.25); }

  // 1/√ of the diagonal; 0 for parameters that are held.
  static Eigen::VectorXd unit_of(const Eigen::MatrixXd& H) {
    return H.diagonal().unaryExpr([](double x) { return x > 0 ? 1 / std::sqrt(x) : 0.0; });
  }
  // H⁻¹; std::nullopt where there is nothing to invert. The gauge directions of the screws' frames
  // have no information: a ridge leaves them at rest.
  std::optional<Eigen::MatrixXd> inverse() const {
    if (H.rows() == 0) return std::nullopt;
    const Eigen::VectorXd unit = unit_of(H);
    Eigen::MatrixXd scaled = unit.asDiagonal() * H * unit.asDiagonal();
    scaled.diagonal().array() += 1e-9;
    const Cholesky<Eigen::MatrixXd> cholesky(scaled);
    if (!cholesky.is_positive()) return std::nullopt;
    const Eigen::MatrixXd identity = Eigen::MatrixXd::Identity(H.rows(), H.rows());
    return unit.asDiagonal() * cholesky.solve(identity) * unit.asDiagonal();
  }
};

}  // namespace bodyschema
