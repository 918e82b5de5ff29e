#pragma once

#include <Eigen/Core>
#include <functional>

namespace bodyschema {

/// The value of a smooth function at x; its gradient too, where that is not null.
using Objective = std::function<double(const Eigen::VectorXd& x, Eigen::VectorXd* gradient)>;

struct BoxMinimum {
  Eigen::VectorXd x;
  double value = 0;
  int num_evaluations = 0;
};

/// A local minimum of `objective` in the box lower ≤ x ≤ upper, by projected BFGS: variables that
/// stand at a bound and push against it rest, the others take a quasi-Newton step of at most
/// `max_step` a variable, projected onto the box and halved until it decreases the value (Nocedal
/// and Wright, "Numerical Optimization", 6.1 and 16.7). Meant for a handful of variables. It ends
/// when the model promises less than `tolerance`, when rounding hides all progress, or after
/// `max_iterations`; the value is never above that at the start. Deterministic.
/// @throws std::invalid_argument if the sizes differ, lower > upper, or the objective is not finite
/// at the start.
BoxMinimum minimize_in_box(const Objective& objective, const Eigen::VectorXd& start,
                           const Eigen::VectorXd& lower, const Eigen::VectorXd& upper,
                           double tolerance, double max_step, int max_iterations);

}  // namespace bodyschema
