#include "processes/structure_learner/axis_screen.h"

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>

namespace bodyschema {

using Eigen::Matrix3d;
using Eigen::Vector3d;

AxisFit AxisScreen::fit(int signal, double turn, int rounds) {
  const std::size_t n = rotations_.size();
  for (std::size_t t = 0; t < n; ++t) {
    const double angle = turn * actions_(samples_[t], signal);
    phi_[t] << 1, std::cos(angle), std::sin(angle);
  }
  std::fill(weights_.begin(), weights_.end(), inverse_variance_);
  AxisFit result;
  for (int round = 0; round < rounds; ++round) {
    Matrix3d gram = Matrix3d::Zero();
    Eigen::Matrix<double, 3, 9> G = Eigen::Matrix<double, 3, 9>::Zero();
    double total = 0;
    for (std::size_t t = 0; t < n; ++t) {
      const double w = weights_[t];
      const Vector3d wphi = w * phi_[t];
      gram.noalias() += wphi * phi_[t].transpose();
      const Eigen::Map<const Eigen::Matrix<double, 1, 9>> r(rotations_[t].data());
      G.noalias() += wphi * r;
      total += w;
    }
    gram.diagonal().array() += 1e-9 * total;
    const Eigen::LLT<Matrix3d> llt(gram);
    const Eigen::Matrix<double, 3, 9> solved = llt.solve(G);  // Gram⁻¹ Σ w φ ⊗ R
    // M = Σ w RᵀR − Σ_l G_lᵀ (Gram⁻¹ G)_l, and RᵀR = 1.
    Matrix3d M = total * Matrix3d::Identity();
    for (int l = 0; l < 3; ++l) {
      const Eigen::Matrix<double, 1, 9> g_row = G.row(l), s_row = solved.row(l);
      const Eigen::Map<const Matrix3d> G_l(g_row.data()), S_l(s_row.data());
      M.noalias() -= G_l.transpose() * S_l;
    }
    M = (0.5 * (M + M.transpose())).eval();
    Eigen::SelfAdjointEigenSolver<Matrix3d> eigen;
    eigen.computeDirect(M);
    result.axis = eigen.eigenvectors().col(0);
    // C = (Σ w R u φᵀ) Gram⁻¹, column l from the l-th block of `solved`.
    Matrix3d C;
    for (int l = 0; l < 3; ++l) {
      const Eigen::Matrix<double, 1, 9> s_row = solved.row(l);
      C.col(l) = Eigen::Map<const Matrix3d>(s_row.data()) * result.axis;
    }
    double score = 0;
    for (std::size_t t = 0; t < n; ++t) {
      const double e2 =
          (rotations_[t] * result.axis - C * phi_[t]).squaredNorm() * inverse_variance_;
      weights_[t] = inverse_variance_ / (1 + e2 / 2);
      score += std::log1p(e2 / 2);
    }
    result.score = score / n;
  }
  return result;
}

}  // namespace bodyschema
