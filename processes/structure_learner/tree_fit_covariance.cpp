#include <Eigen/Eigenvalues>
#include <cmath>
#include <map>

#include "processes/structure_learner/tree_fit.h"
#include "processes/structure_learner/tree_fit_normal.h"

namespace bodyschema {
namespace {

Matrix6d positive_part(const Matrix6d& matrix) {
  const Eigen::SelfAdjointEigenSolver<Matrix6d> eigen(0.5 * (matrix + matrix.transpose()));
  return eigen.eigenvectors() * eigen.eigenvalues().cwiseMax(0).asDiagonal() *
         eigen.eigenvectors().transpose();
}

}  // namespace

std::optional<TreeFit::Covariance> TreeFit::covariance(const Matrix6d& systematic) const {
  const Normal normal = normal_equations();
  const auto size = normal.H.rows();
  if (size == 0) return std::nullopt;
  const int n = static_cast<int>(nodes_.size());
  Eigen::MatrixXd H = normal.H;
  // A screw frame may turn about its axis and slide along it: these directions get the variance
  // of a direction that is known well, and no prediction depends on them.
  for (int k = 1; k < n; ++k)
    for (int d = 0; d < nodes_[k].model.num_joints; ++d)
      for (const int component : {2, 5}) {
        Vector6d before = Vector6d::Zero();
        before(component) = 1;
        const Vector6d after = -adjoint(nodes_[k].model.A[d + 1].inverse()) * before;
        Eigen::VectorXd gauge = Eigen::VectorXd::Zero(size);
        gauge.segment<6>(normal.offset[k] + 8 * d) = before;
        gauge.segment<6>(normal.offset[k] + 8 * (d + 1)) = after;
        const double information =
            gauge.dot(normal.H.diagonal().cwiseProduct(gauge)) / std::pow(gauge.squaredNorm(), 2);
        H += information * gauge * gauge.transpose();
      }
  // What the data hardly determine (where the axis of a sliding joint lies) stays finite in float.
  H.diagonal() *= 1 + 1e-7;
  const Eigen::VectorXd unit = H.diagonal().cwiseMax(1e-300).cwiseSqrt().cwiseInverse();
  const Eigen::LLT<Eigen::MatrixXd> llt(unit.asDiagonal() * H * unit.asDiagonal());
  if (llt.info() != Eigen::Success) return std::nullopt;

  // Covariance of the score Σ Jᵀ W e. What was added to H is a measurement like others.
  Eigen::MatrixXd score = H - normal.H;
  for (int k = 0; k < n; ++k) {
    std::vector<int> path;  // of nodes whose parameters move this one
    std::vector<int> rows;  // and these parameters
    for (int e = k; e >= 0; e = nodes_[e].parent) {
      if (e == 0 && !root_rests_) break;
      path.push_back(e);
      const int count = e == 0 ? 6 : nodes_[e].model.num_parameters();
      for (int p = 0; p < count; ++p) rows.push_back(normal.offset[e] + p);
    }
    std::map<int, int> views;  // frames of each
    for (const PairFrame& frame : data_[k].frames) ++views[frame.view];
    std::map<int, Eigen::MatrixXd> common;  // of views with several frames
    Eigen::MatrixXd own(rows.size(), 6 * data_[k].size());
    for (int t = 0; t < num_frames(); ++t) {
      const int frame = frame_index_[at(t, k)];
      if (frame < 0) continue;
      const FrameFit& fit = fits_[at(t, k)];
      const Matrix6d& whitening = data_[k].hypotheses[fit.hypothesis].whitening;
      // Jᵀ W L of the measurement's covariance L Lᵀ.
      const Matrix6d whitened = robust_weight(fit.squared_distance) *
                                adjoint(poses_[at(t, k)].inverse()).transpose() *
                                whitening.transpose();
      auto column = own.middleCols<6>(6 * frame);
      Eigen::Index row = 0;
      for (const int e : path) {
        const ParameterJacobian& S = normal.S[at(t, e)];
        column.middleRows(row, S.cols()).noalias() = S.transpose().lazyProduct(whitened);
        row += S.cols();
      }
      const int view = data_[k].frames[frame].view;
      if (views.at(view) == 1) continue;
      const Matrix6d shared = kViewShare * Matrix6d::Identity() +
                              (1 - kViewShare) * whitening * systematic * whitening.transpose();
      const Matrix6d L = shared.llt().matrixL();
      common.try_emplace(view, Eigen::MatrixXd::Zero(column.rows(), 6)).first->second += column * L;
      column *= std::sqrt(1 - kViewShare);
    }
    Eigen::MatrixXd of_node = own * own.transpose();
    for (const auto& [view, G] : common) of_node += G * G.transpose();
    score(rows, rows) += of_node;
  }
  const Eigen::MatrixXd inverse = unit.asDiagonal() * llt.solve(Eigen::MatrixXd(unit.asDiagonal()));
  const Eigen::MatrixXd joint = inverse * score * inverse;

  Covariance result;
  result.models.resize(n);
  if (root_rests_) result.root = joint.topLeftCorner<6, 6>();
  for (int k = 1; k < n; ++k) {
    const int p = nodes_[k].model.num_parameters();
    result.models[k] = joint.block(normal.offset[k], normal.offset[k], p, p);
  }
  // Where a part's frame is off, the edge to it is off by as much as those from it, the other way.
  result.frames.assign(n, Matrix6d::Zero());
  std::vector<int> children(n, 0);
  for (int k = 1; k < n; ++k) {
    const int parent = nodes_[k].parent;
    if (parent == 0 && !root_rests_) continue;
    const auto p = normal.S[at(0, parent)].cols(), c = normal.S[at(0, k)].cols();
    const Eigen::MatrixXd cross = joint.block(normal.offset[parent], normal.offset[k], p, c);
    Matrix6d sum = Matrix6d::Zero();
    for (int t = 0; t < num_frames(); ++t) {
      const Matrix6d to_parent = adjoint(poses_[at(t, parent)].inverse());
      sum -= to_parent * normal.S[at(t, parent)] * cross * normal.S[at(t, k)].transpose() *
             to_parent.transpose();
    }
    result.frames[parent] += sum / num_frames();
    ++children[parent];
  }
  for (int k = 0; k < n; ++k)
    if (children[k] > 0) result.frames[k] = positive_part(result.frames[k] / children[k]);
  return result;
}

}  // namespace bodyschema
