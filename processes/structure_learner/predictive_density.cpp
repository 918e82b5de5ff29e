#include "processes/structure_learner/predictive_density.h"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <limits>

#include "common/estimation/chi_square.h"

namespace bodyschema {

double PrincipalResidual::squared_distance(double noise) const {
  return (squares.array() / (noise + variances.array())).sum();
}

double PrincipalResidual::log_density(double noise) const {
  const auto log_det = [&](double f) { return (f + variances.array()).log().sum(); };
  return -0.5 *
         std::min(squared_distance(noise) + log_det(noise), 2 * kOutlierThreshold + log_det(1));
}

PrincipalResidual principal_residual(const Vector6d& residual, const Matrix6d& S) {
  const Eigen::SelfAdjointEigenSolver<Matrix6d> axes(S);
  return {(axes.eigenvectors().transpose() * residual).cwiseAbs2(), axes.eigenvalues().cwiseMax(0)};
}

double best_noise(const std::vector<PrincipalResidual>& residuals) {
  double best = 1, best_density = -std::numeric_limits<double>::infinity();
  for (double noise = kLeastNoise; noise <= kMostNoise; noise *= 1.1) {
    double density = 0;
    for (const PrincipalResidual& r : residuals) density += r.log_density(noise);
    if (density <= best_density) continue;
    best_density = density;
    best = noise;
  }
  return best;
}

}  // namespace bodyschema
