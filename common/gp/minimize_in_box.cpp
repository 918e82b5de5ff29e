#include "common/gp/minimize_in_box.h"

#include <Eigen/Cholesky>
#include <cmath>
#include <stdexcept>
#include <vector>

namespace bodyschema {

namespace {

/// BFGS: after a step `s` the gradient is larger by `y`. An empty Hessian is begun.
void update(const Eigen::VectorXd& s, const Eigen::VectorXd& y, Eigen::MatrixXd* hessian) {
  const double curvature = s.dot(y);
  if (!(curvature > 1e-10 * s.norm() * y.norm())) return;
  if (hessian->size() == 0)
    *hessian = y.squaredNorm() / curvature * Eigen::MatrixXd::Identity(s.size(), s.size());
  const Eigen::VectorXd Bs = *hessian * s;
  *hessian += y * y.transpose() / curvature - Bs * Bs.transpose() / s.dot(Bs);
}

}  // namespace

BoxMinimum minimize_in_box(const Objective& objective, const Eigen::VectorXd& start,
                           const Eigen::VectorXd& lower, const Eigen::VectorXd& upper,
                           double tolerance, double max_step, int max_iterations) {
  const Eigen::Index n = start.size();
  if (lower.size() != n || upper.size() != n || !(lower.array() <= upper.array()).all())
    throw std::invalid_argument("minimize_in_box: the box does not go with the start");
  const auto projected = [&](const Eigen::VectorXd& x) -> Eigen::VectorXd {
    return x.cwiseMax(lower).cwiseMin(upper);
  };

  BoxMinimum best{projected(start), 0, 1};
  Eigen::VectorXd gradient;
  best.value = objective(best.x, &gradient);
  if (!std::isfinite(best.value) || !gradient.allFinite())
    throw std::invalid_argument("minimize_in_box: the objective is not finite at the start");
  Eigen::MatrixXd hessian;  // BFGS approximation; empty before the first step
  for (int iteration = 0; iteration < max_iterations; ++iteration) {
    std::vector<Eigen::Index> free;
    for (Eigen::Index i = 0; i < n; ++i) {
      const bool rests = (best.x(i) <= lower(i) && gradient(i) >= 0) ||
                         (best.x(i) >= upper(i) && gradient(i) <= 0);
      if (!rests) free.push_back(i);
    }
    if (free.empty()) break;
    Eigen::VectorXd step = Eigen::VectorXd::Zero(n);
    if (hessian.size() == 0) {
      step(free) = -gradient(free);
    } else {
      // Any principal part of a positive definite matrix is one too.
      step(free) = -hessian(free, free).llt().solve(gradient(free));
    }
    const double largest = step.cwiseAbs().maxCoeff();
    if (!(largest > 0) || !std::isfinite(largest)) break;
    if (largest > max_step) step *= max_step / largest;
    if (-0.5 * gradient.dot(step) < tolerance) break;

    Eigen::VectorXd x, next_gradient;
    double value = 0;
    bool is_lower = false;
    for (int halvings = 0; halvings < 12 && !is_lower; ++halvings, step *= 0.5) {
      x = projected(best.x + step);
      ++best.num_evaluations;
      value = objective(x, nullptr);
      is_lower = std::isfinite(value) && value <= best.value + 1e-4 * gradient.dot(x - best.x) &&
                 value < best.value;
    }
    if (!is_lower) break;
    value = objective(x, &next_gradient);
    if (!next_gradient.allFinite()) break;
    update(x - best.x, next_gradient - gradient, &hessian);
    best.x = x;
    best.value = value;
    gradient = next_gradient;
  }
  return best;
}

}  // namespace bodyschema
